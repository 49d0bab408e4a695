"""README.md and picture of the ways of choosing pixels."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.outcomes import FAILURE_RULE
from edge_se_sampler.bench.report import (
    decimals,
    describe_command,
    describe_errors,
    fill_template,
    markdown_table,
    read_notes,
)
from edge_se_sampler.bench.results import Run, read_result
from edge_se_sampler.bench.strategies.claims import CLAIMS
from edge_se_sampler.bench.strategies.figures import draw_differences
from edge_se_sampler.bench.strategies.summary import (
    METRICS,
    Comparison,
    Panel,
    Verdict,
    best_at_equal_seconds,
    captures_of,
    compare,
    cost_of_a_step,
    count_failures,
    panels_of,
    strategies_of,
)
from edge_se_sampler.bench.strategies.trials import PLANS, STRATEGIES, UNIFORM
from edge_se_sampler.engine.figures import save_figure

VERDICTS: dict[Verdict | None, str] = {
    "better": "better",
    "worse": "worse",
    "same": "not distinguishable",
    None: "no verdict (too few seeds)",
}
"""In words; the first that a strategy has anywhere says whether to use it, there alone if it is worse elsewhere."""
ANSWERS: dict[Verdict | None, str] = {"better": "yes, ", "worse": "no, ", "same": "no need, ", None: ""}

MODELS = {
    "nerf": "the original NeRF, size tiny",
    "lean": "`lean-nerf`",
    "lean-no-masks": "`lean-nerf` on images without alpha, composited on white",
    "nerfacto": "nerfstudio 1.1.5's, much smaller than its own settings and, but for captures, at learning rates of "
    "3e-3, inside nerfstudio",
}
"""What is trained, in words."""
EQUAL = {"seconds": "at equal CPU seconds", "steps": "at equal steps"}
"""What a plan compares at, in words."""


def draw(folder: Path, workplace: Path | None) -> None:
    del workplace
    runs = read_result(folder / "result.json")["runs"]
    if {run["strategy"] for run in runs} - {UNIFORM}:
        save_figure(draw_differences(runs, labels_of(runs)), folder / "chart.png")


def describe(folder: Path) -> str:
    """The README.md of a folder with a result.json."""
    result = read_result(folder / "result.json")
    runs, settings = result["runs"], result["settings"]
    return fill_template(
        __file__,
        folder,
        nerf=settings["nerf"],
        lean=settings["lean"],
        failure_rule=FAILURE_RULE,
        scenes=_list_scenes(runs),
        models=_list_models(runs, settings),
        plans=" and ".join(text for plan, text in EQUAL.items() if any(run["plan"] == plan for run in runs)),
        claims=table_of_claims(runs),
        best=_table_of_best(runs),
        panels="\n\n".join(f"### {label}\n\n{_table_of(runs, panel)}" for panel, label in labels_of(runs).items()),
        errors=describe_errors(result),
        notes=read_notes(folder),
        reproduce=describe_command(result),
    )


def tables(folder: Path) -> dict[str, str]:
    """Tables that other texts show, by name."""
    return {"strategies": table_of_claims(read_result(folder / "result.json")["runs"])}


def labels_of(runs: list[Run]) -> dict[Panel, str]:
    """Panel -> its model, its captures, if it is of such, the size of its images, and whether they are centered."""
    labels = {}
    for panel in panels_of(runs):
        width, height = panel.size
        size = f"{width} px" if width == height else f"{width} x {height} px"
        parts = [panel.model, *captures_of(run for run in runs if Panel.of(run) == panel), size]
        labels[panel] = ", ".join(parts + ["off center"] * (panel.placement == "shifted"))
    return labels


def _list_scenes(runs: list[Run]) -> str:
    captures = captures_of(runs)
    objects = sorted({run["scene"] for run in runs}.difference(captures))
    parts = [" and ".join(objects)] * bool(objects) + [f"captures: {' and '.join(captures)}"] * bool(captures)
    return "; ".join(parts)


def _list_models(runs: list[Run], settings: dict[str, dict[str, Any]]) -> str:
    """A line for each model that was trained: what it is, and for how long."""
    lines = []
    for model, text in MODELS.items():
        plans = {run["plan"] for run in runs if run["model"] == model}
        length = settings["lean" if model.startswith("lean") else "nerf"]
        lengths = [
            f"{length[plan]} {unit}" for plan, unit in {"seconds": "s", "steps": "steps"}.items() if plan in plans
        ]
        if lengths:
            lines.append(f"- `{model}`: {text}; {' or '.join(lengths)}")
    return "\n".join(lines)


def table_of_claims(runs: list[Run]) -> str:
    """A line a strategy: what is claimed, what was seen, when to use it."""
    rows = [
        [
            name,
            STRATEGIES[name].description if name in STRATEGIES else "–",
            f"{CLAIMS[name].text} ({CLAIMS[name].source})" if name in CLAIMS else "–",
            _describe_differences(runs, name),
            describe_use(runs, name),
        ]
        for name in strategies_of(runs)
        if name != UNIFORM
    ]
    return markdown_table(["", "draws", "claimed", "seen at equal CPU seconds, dB", "use it"], rows)


def describe_use(runs: list[Run], strategy: str) -> str:
    """The verdicts at equal seconds in words: where it is better than uniform pixels, and where worse."""
    found = _compare_everywhere(runs, strategy)
    where: dict[Verdict | None, list[str]] = {
        v: [label for label, comparison in found.items() if comparison.verdict == v] for v in VERDICTS
    }
    judged: list[Verdict | None] = [verdict for verdict in VERDICTS if where[verdict]]
    if not judged:
        return "–"
    texts = [
        f"{VERDICTS[verdict]}: {_name_panels(where[verdict], list(found))}"
        if verdict in ("better", "worse")
        else f"{VERDICTS[verdict]} in {len(where[verdict])} of {len(found)}"
        for verdict in judged
    ]
    answer = "only where it is " if {"better", "worse"} <= set(judged) else ANSWERS[judged[0]]
    return answer + "; ".join(texts)


def _name_panels(some: list[str], compared: list[str]) -> str:
    """Of those labels the models, each with its panels; without them where they are all of several compared ones."""
    places, of_all = _group_by_model(some), _group_by_model(compared)
    return ", ".join(
        model if len(found) == len(of_all[model]) > 1 else f"{model} ({'; '.join(found)})"
        for model, found in places.items()
    )


def _group_by_model(labels: list[str]) -> dict[str, list[str]]:
    """Model -> the rest of its panels' labels."""
    groups: dict[str, list[str]] = {}
    for label in labels:
        model, _, place = label.partition(", ")
        groups.setdefault(model, []).append(place)
    return groups


def _compare_everywhere(runs: list[Run], strategy: str) -> dict[str, Comparison]:
    """Label of a panel -> what a strategy is there at equal seconds, where it was compared."""
    found = {label: compare(runs, panel, strategy, "seconds") for panel, label in labels_of(runs).items()}
    return {label: comparison for label, comparison in found.items() if comparison and comparison.differences}


def _describe_differences(runs: list[Run], strategy: str) -> str:
    """Of every model the least and the greatest difference of its panels, what a step costs, and failures."""
    parts = []
    for model in dict.fromkeys(panel.model for panel in panels_of(runs)):
        of_model = [run for run in runs if run["model"] == model]
        differences = [c.differences["psnr"] for c in _compare_everywhere(of_model, strategy).values()]
        if not differences:
            continue
        ends = dict.fromkeys(_signed(value) for value in (min(differences), max(differences)))
        panels = panels_of(of_model)
        costs = [cost for panel in panels if (cost := cost_of_a_step(runs, panel, strategy)) is not None]
        by_seconds = [run for run in of_model if run["plan"] == "seconds"]
        failures = sum(count_failures(by_seconds, panel, strategy)[0] for panel in panels)
        text = f"{model} {' to '.join(ends)}"
        text += f", a step x{statistics.mean(costs):.2f}" if costs else ""
        parts.append(text + (f", {failures} failed" if failures else ""))
    return "; ".join(parts) or "–"


def _table_of_best(runs: list[Run]) -> str:
    """Of every panel the best at equal seconds, if any was compared."""
    rows = []
    for panel, label in labels_of(runs).items():
        if (best := best_at_equal_seconds(runs, panel)) is not None:
            rows.append([label, best, *_judge(compare(runs, panel, best, "seconds"))])
    return markdown_table(["", "best", "minus uniform", "verdict"], rows) if rows else ""


def _judge(comparison: Comparison | None) -> tuple[str, str]:
    """Difference and verdict."""
    if comparison is None or not comparison.differences:
        return "–", "–"
    return _signed(comparison.differences["psnr"]), VERDICTS[comparison.verdict]


def _table_of(runs: list[Run], panel: Panel) -> str:
    """Strategies by what was measured under both plans."""
    columns = ["PSNR (spread)", "minus uniform", "object", "edges"]
    head = ["", *(f"{plan}: {column}" for plan in PLANS for column in columns), "a step costs", "failed"]
    rows = []
    for name in strategies_of(run for run in runs if Panel.of(run) == panel):
        cost = cost_of_a_step(runs, panel, name)
        failures, trainings = count_failures(runs, panel, name)
        measured = [text for plan in PLANS for text in _show(compare(runs, panel, name, plan))]
        rows.append([name, *measured, "–" if cost is None else f"x{cost:.2f}", f"{failures} of {trainings}"])
    return markdown_table(head, rows)


def _show(comparison: Comparison | None) -> list[str]:
    """PSNR with its spread, and differences by metric; that of PSNR in bold where it is beyond the spread."""
    if comparison is None:
        return ["–"] * (1 + len(METRICS))
    spread = "" if comparison.spread is None else f" ({decimals(comparison.spread)})"
    found = comparison.differences
    texts = [_signed(found[metric]) if metric in found else "–" for metric in METRICS]
    if comparison.verdict in ("better", "worse"):
        texts[0] = f"**{texts[0]}**"
    return [decimals(comparison.psnr) + spread, *texts]


def _signed(value: float) -> str:
    return f"{round(value, 2) + 0.0:+.2f}"  # no -0.00
