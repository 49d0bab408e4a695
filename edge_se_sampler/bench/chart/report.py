"""The chart's README.md, pictures, and table of methods for other texts."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.baselines.results import read_baselines
from edge_se_sampler.bench.chart.figures import draw_chart, draw_scenes
from edge_se_sampler.bench.chart.summary import (
    END,
    always_better,
    by_variant,
    comparable,
    differences,
    mean_psnr_at,
    moments_of,
    psnr_over_time,
    runs_on,
    scenes_of,
)
from edge_se_sampler.bench.chart.trials import ChartSettings
from edge_se_sampler.bench.chart.variants import COMPARISONS, GROUPS, RECOMMENDED, TOP, VARIANTS
from edge_se_sampler.bench.outcomes import FAILURE_RULE, failed
from edge_se_sampler.bench.report import fill_template
from edge_se_sampler.bench.runner import Run, read_result
from edge_se_sampler.bench.tables import decimals, describe_command, markdown_table
from edge_se_sampler.engine.figures import save_figure

COLUMNS = {3: "3 s", 7: "7 s", 20: "20 s", 60: "60 s", END: "end"}
"""Moments that tables have columns for, if trainings are so long."""
Baselines = Mapping[str, list[Run]]
"""Label of another program -> its runs."""


def draw(folder: Path, workplace: Path | None) -> None:
    """Draw the pictures for which there are enough runs."""
    del workplace
    result, baselines, _ = _read(folder)
    runs, settings = result["runs"], ChartSettings(**result["settings"])
    if len(comparable(by_variant(runs, TOP))) > 1:
        save_figure(draw_chart(runs, baselines, settings), folder / "chart.png")
    if runs:
        save_figure(draw_scenes(runs, baselines, settings), folder / "scenes.png")


def describe(folder: Path) -> str:
    """The README.md; remarks by hand, which no number of the result shows, are in notes.md."""
    result, baselines, baseline_results = _read(folder)
    runs, settings, notes = result["runs"], ChartSettings(**result["settings"]), folder / "notes.md"
    return fill_template(
        __file__,
        folder,
        **result["settings"],
        unit=settings.unit,
        number=len(runs),
        failure_rule=FAILURE_RULE,
        **{group: _describe_group(runs, group, baselines) for group in GROUPS},
        comparisons=_compare_pairs(runs),
        envelope=_describe_envelope(runs),
        every_scene=_compare_scenes(runs, baselines),
        notes=notes.read_text(encoding="utf-8").strip() if notes.exists() else "",
        reproduce=describe_command(*baseline_results, result),
    )


def tables(folder: Path) -> dict[str, str]:
    """methods: PSNR of methods and baselines after some seconds and at the end, and failures."""
    result, baselines, _ = _read(folder)
    return {"methods": _group_table(result["runs"], "methods", baselines, costs=False)}


def _read(folder: Path) -> tuple[dict[str, Any], Baselines, Iterable[dict[str, Any]]]:
    """The result, the baselines' runs, and their results."""
    result = read_result(folder / "result.json")
    baselines = read_baselines(folder, ChartSettings(**result["settings"]))
    return result, {label: baseline["runs"] for label, baseline in baselines.items()}, baselines.values()


def _comparable_with_group(runs: list[Run], group: str) -> dict[str, list[Run]]:
    return comparable(by_variant(runs, TOP if group in TOP else [group]))


def _list_scenes(compared: Mapping[str, list[Run]]) -> str:
    return ", ".join(scenes_of(chain(*compared.values()))) or "no scene and seed that all have"


def _describe_group(runs: list[Run], group: str, baselines: Baselines) -> str:
    """A group's table, and on which scenes it compares; empty if none of the group was trained."""
    if not any(VARIANTS[run["variant"]].group == group for run in runs):
        return ""
    return f"On {_list_scenes(_comparable_with_group(runs, group))}:\n\n{_group_table(runs, group, baselines)}"


def _group_table(runs: list[Run], group: str, baselines: Baselines, costs: bool = True) -> str:
    """A group's variants, and baselines beside methods: PSNR, failures and costs."""
    compared = _comparable_with_group(runs, group)
    moments = [seconds for seconds in moments_of(runs) if seconds in COLUMNS]
    shown = {
        VARIANTS[n].label: found for n, found in compared.items() if VARIANTS[n].group == group or n == RECOMMENDED
    }
    if group == "methods":
        scenes = scenes_of(chain(*compared.values()))
        shown |= {label: found for label, all_runs in baselines.items() if (found := runs_on(all_runs, scenes))}
    rows = []
    for label, found in shown.items():
        psnr = [decimals(mean_psnr_at(found, seconds)) for seconds in moments]
        rows.append([label, *psnr, _failures(found), *(_cost_fields(found) if costs else ())])
    head = ["", *(COLUMNS[seconds] for seconds in moments), "failed"]
    return markdown_table([*head, *(("ms a step", "queries a step", "memory") if costs else ())], rows)


def _compare_pairs(runs: list[Run]) -> str:
    """The pairs of variants that tell what one thing is worth, over all scenes that both were trained on."""
    moments = [seconds for seconds in moments_of(runs) if seconds in COLUMNS]
    trained, rows = by_variant(runs), []
    for (first, second), what in COMPARISONS.items():
        compared = comparable({name: trained.get(name, []) for name in (first, second)})
        if compared:
            ahead = [differences(compared[first], compared[second], seconds) for seconds in moments]
            pair = f"{VARIANTS[first].full_label} − {VARIANTS[second].full_label}"
            pairs = str(len(compared[first]))
            rows.append([what, pair, ", ".join(ahead[-1]), pairs, *map(_describe_difference, ahead)])
    head = ["what", "difference", "scenes", "pairs of trainings", *(COLUMNS[seconds] for seconds in moments)]
    return markdown_table(head, rows) if rows else ""


def _describe_difference(by_scene: Mapping[str, float]) -> str:
    if not by_scene:
        return "–"
    mean = f"{statistics.mean(by_scene.values()):+.2f}"
    return mean if len(by_scene) == 1 else f"{mean} [{min(by_scene.values()):+.2f}, {max(by_scene.values()):+.2f}]"


def _describe_envelope(runs: list[Run]) -> str:
    """Which variant is best when, and by how much."""
    compared = comparable(by_variant(runs))
    if len(compared) < 2:
        return ""
    label, rows = VARIANTS[RECOMMENDED].label, []
    for seconds, psnr in psnr_over_time(runs).items():
        if psnr:
            best = max(psnr, key=psnr.__getitem__)
            gap = psnr[best] - psnr[RECOMMENDED] if RECOMMENDED in psnr else None
            moment = "end" if seconds == END else f"{seconds} s"
            rows.append([moment, VARIANTS[best].full_label, decimals(psnr[best]), decimals(gap)])
    better = ", ".join(VARIANTS[name].full_label for name in always_better(runs)) or "none"
    table = markdown_table(["after", "best", "PSNR", f"{label} below it"], rows)
    return f"On {_list_scenes(compared)}; ahead of {label} at every evaluation: {better}.\n\n{table}"


def _compare_scenes(runs: list[Run], baselines: Baselines) -> str:
    """PSNR at the end on each scene, of variants and baselines that were trained on all of them."""
    scenes = scenes_of(runs)
    by_label = {VARIANTS[name].full_label: found for name, found in by_variant(runs).items()} | dict(baselines)
    complete = {label: on_all for label, found in by_label.items() if (on_all := runs_on(found, scenes))}
    if len(scenes) < 2 or not complete:
        return ""
    rows = []
    for label, found in comparable(complete).items():
        fields = []
        for scene in scenes:
            of_scene = runs_on(found, [scene])
            psnr = mean_psnr_at(of_scene, END)
            any_failed = any("outcome" in run and failed(run) for run in of_scene)
            fields.append(f"({decimals(psnr)})" if any_failed else decimals(psnr))
        least = min(run["curve"][-1][-1] for run in found)
        rows.append([label, *fields, decimals(mean_psnr_at(found, END)), f"{least:.2f}", _failures(found)])
    return markdown_table(["", *scenes, "mean", "least", "failed"], rows)


def _failures(runs: list[Run]) -> str:
    return f"{sum(map(failed, runs))} of {len(runs)}" if all("outcome" in run for run in runs) else "–"


def _cost_fields(runs: list[Run]) -> list[str]:
    """Milliseconds and queries a step, and memory; not known of baselines."""
    if not all("queries" in run for run in runs):
        return ["–", "–", "–"]
    step = statistics.median(1000 * (run["seconds"] - run["ready_seconds"]) / run["steps"] for run in runs)
    queries = statistics.median(run["queries"] / run["steps"] for run in runs)
    memory = statistics.median(run["peak_bytes"] for run in runs) / 2**20
    return [f"{step:.1f}", f"{queries:,.0f}", f"{memory:,.0f} MiB"]
