"""The chart's README.md, pictures, and table of methods for other texts."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.baselines.results import name_of, read_baselines
from edge_se_sampler.bench.chart.figures import draw_chart, draw_parts, draw_scenes
from edge_se_sampler.bench.chart.summary import (
    END,
    always_better,
    baseline_runs,
    comparable,
    comparable_groups,
    differences,
    mean_psnr_at,
    runs_of,
    scenes_of,
    upper_envelope,
)
from edge_se_sampler.bench.chart.trials import ChartSettings
from edge_se_sampler.bench.chart.variants import COMPARISONS, GROUPS, RECOMMENDED, TOP, VARIANTS, Group
from edge_se_sampler.bench.outcomes import COLLAPSED_SHARE, MIN_GAIN, failed
from edge_se_sampler.bench.runner import Run, read_result
from edge_se_sampler.bench.tables import decimals, describe_machine, markdown_table
from edge_se_sampler.engine.figures import save_figure

CAPTIONS = {
    "chart": "Test PSNR against training time: methods, error sources (dashed) and other programs (dotted)",
    "scenes": "Test PSNR against training time on every scene, a line a seed; a cross: training failed",
    "parts": "lean-nerf with one thing changed at a time",
}
NOTES = "notes.md"
"""Remarks by hand, which no number of the result shows; appended to the README where there are any."""


def draw(folder: Path, workplace: Path | None) -> None:
    """Draw the pictures for which there are enough runs."""
    del workplace
    result, settings, baselines = _read(folder)
    runs = result["runs"]
    if not runs:
        return
    if len(comparable_groups(runs, TOP)) > 1:
        save_figure(draw_chart(runs, baselines, settings), folder / "chart.png")
    groups: list[Group] = [g for g in _groups(runs) if g not in TOP and len(comparable_groups(runs, [g])) > 1]
    if groups:
        save_figure(draw_parts(runs, groups, settings), folder / "parts.png")
    save_figure(draw_scenes(runs, baselines, settings), folder / "scenes.png")


def describe(folder: Path) -> str:
    """The README.md."""
    result, settings, baselines = _read(folder)
    runs = result["runs"]
    parts = ["# Speed against accuracy: test PSNR against training time", _describe_settings(runs, settings)]
    if runs:
        parts += _picture(folder, "chart")
        for group in _groups(runs):
            title, text = GROUPS[group]
            parts += [f"## {title}", text, _group_table(runs, group, baselines), *_describe_group(runs, group)]
        parts += [*_picture(folder, "parts"), *_describe_comparisons(runs), *_describe_envelope(runs)]
        parts += [*_describe_scenes(runs, baselines), *_picture(folder, "scenes")]
    if (folder / NOTES).exists():
        parts += ["## Remarks", (folder / NOTES).read_text(encoding="utf-8").strip()]
    commands = "\n".join(found["command"] for found in (*baselines, result))
    parts += [
        f"## Reproduce it\n\n```bash\n{commands}\n```",
        "`edge-se bench report` writes this page and its pictures again from the numbers alone.",
        f"Measured on: {describe_machine(result['machine'])}.",
    ]
    return "\n\n".join(parts) + "\n"


def tables(folder: Path) -> dict[str, str]:
    """methods: PSNR of methods and baselines after some seconds and at the end, and failures."""
    result, _, baselines = _read(folder)
    return {"methods": _group_table(result["runs"], "methods", baselines, costs=False)}


def _read(folder: Path) -> tuple[dict[str, Any], ChartSettings, list[dict[str, Any]]]:
    result = read_result(folder / "result.json")
    settings = ChartSettings(**result["settings"])
    return result, settings, read_baselines(folder, settings)


def _picture(folder: Path, name: str) -> list[str]:
    return [f"![{CAPTIONS[name]}]({name}.png)"] if (folder / f"{name}.png").exists() else []


def _groups(runs: list[Run]) -> list[Group]:
    """Groups that have runs; the recommended variant belongs to all of them."""
    return [group for group in GROUPS if any(VARIANTS[run["variant"]].group == group for run in runs)]


def _describe_settings(runs: list[Run], settings: ChartSettings) -> str:
    time = "CPU seconds on one core" if settings.threads == 1 else f"seconds on {settings.threads} cores"
    return (
        f"How good is a NeRF after how many seconds of training? {len(runs)} trainings of {settings.seconds:g} {time}, "
        f"on images of {settings.image_size} pixels a side. Training time runs from reading the data, the analysis of "
        "the scene included, to the end of a step; imports and evaluations are left out. Every training is planned "
        "(learning rate, phases) for the time that it has.\n\n"
        "Numbers are PSNR of the test views in dB: the mean over scenes of the median over seeds. Every table compares "
        "on the scenes and seeds that all of its rows have. *Failed*: nothing of the object was learnt (its error is "
        f"above {COLLAPSED_SHARE:.0%} of that of a plain background), or the PSNR is less than {MIN_GAIN:g} dB above a "
        "plain background's. *Queries*: points at which a network is evaluated. *Memory*: the peak above what imports "
        "take."
    )


def _group_table(runs: list[Run], group: Group, baselines: Sequence[dict[str, Any]], costs: bool = True) -> str:
    """A group's variants, and baselines beside methods: PSNR, failures and costs."""
    of_variant = comparable_groups(runs, TOP if group in TOP else [group])
    seconds = _column_seconds(runs)
    rows = [
        [VARIANTS[name].label, *_psnr_fields(found, seconds), _failures(found), *_cost_fields(found)]
        for name, found in of_variant.items()
        if VARIANTS[name].group == group or name == RECOMMENDED
    ]
    if group == "methods":
        all_runs = [run for found in of_variant.values() for run in found]
        for baseline in baselines:
            psnr = _psnr_fields(baseline_runs(baseline, all_runs), seconds)
            rows.append([f"{name_of(baseline)} ({baseline['settings']['program_version']})", *psnr, *"––––"])
    head = ["", *_seconds_head(seconds), "failed", "ms a step", "queries a step", "memory"]
    return markdown_table(head, rows) if costs else markdown_table(head[:-3], [row[:-3] for row in rows])


def _describe_group(runs: list[Run], group: Group) -> list[str]:
    """Which variants of a group are ahead of the recommended one at first, and which in the end."""
    first = _column_seconds(runs)[:1]
    of_variant = comparable_groups(runs, [group])
    reference = of_variant.pop(RECOMMENDED, None)
    if group in TOP or not (first and reference and of_variant):
        return []
    labels: dict[tuple[bool, ...], list[str]] = {}
    for name, found in of_variant.items():
        ahead = ((mean_psnr_at(found, t) or 0.0) > (mean_psnr_at(reference, t) or 0.0) for t in (*first, END))
        labels.setdefault(tuple(ahead), []).append(VARIANTS[name].label)
    words: dict[tuple[bool, ...], str] = {
        (True, True): "ahead",
        (True, False): "ahead, then behind",
        (False, True): "behind, then ahead",
    }
    listed = "; ".join(f"{words.get(key, 'behind')}: {', '.join(names)}" for key, names in sorted(labels.items()))
    return [f"Against {VARIANTS[RECOMMENDED].label}, after {first[0]} s and at the end: {listed}."]


def _describe_comparisons(runs: list[Run]) -> list[str]:
    """The pairs of variants that tell what one thing is worth, over all scenes that both were trained on."""
    seconds = [*_column_seconds(runs), END]
    rows = []
    for (first, second), what in COMPARISONS.items():
        ahead = [differences(runs, first, second, t) for t in seconds]
        if ahead[-1]:
            trained = len(comparable(runs, (first, second))[first])
            pair = f"{VARIANTS[first].full_label} − {VARIANTS[second].full_label}"
            rows.append([what, pair, f"{len(ahead[-1])}", f"{trained}", *map(_difference, ahead)])
    if not rows:
        return []
    head = ["what", "difference", "scenes", "pairs of trainings", *_seconds_head(seconds[:-1])]
    return [
        "## What one thing is worth",
        "Differences in dB between two variants on all scenes that both were trained on: the mean, and in brackets the "
        "least and the greatest of a scene.",
        markdown_table(head, rows),
    ]


def _difference(ahead: Mapping[str, float]) -> str:
    if not ahead:
        return "–"
    mean = f"{statistics.mean(ahead.values()):+.2f}"
    return mean if len(ahead) == 1 else f"{mean} [{min(ahead.values()):+.2f}, {max(ahead.values()):+.2f}]"


def _describe_envelope(runs: list[Run]) -> list[str]:
    """Which variant is best when."""
    if len(comparable_groups(runs)) < 2:
        return []
    label = VARIANTS[RECOMMENDED].label
    better = [VARIANTS[name].full_label for name in always_better(runs)]
    rows = [
        [f"{seconds} s", VARIANTS[name].full_label, decimals(psnr), decimals(gap)]
        for seconds, name, psnr, gap in upper_envelope(runs)
    ]
    return [
        "## Which variant is best when",
        f"The upper envelope of all variants. Ahead of {label} at every evaluation: {', '.join(better) or 'none'}.",
        markdown_table(["after", "best", "PSNR", f"{label} below it"], rows),
    ]


def _describe_scenes(runs: list[Run], baselines: Sequence[dict[str, Any]]) -> list[str]:
    """PSNR at the end on each scene, of variants and baselines that were trained on all of them."""
    scenes = scenes_of(runs)
    by_name = {v.full_label: runs_of(runs, name) for name, v in VARIANTS.items()}
    by_name |= {name_of(baseline): baseline["runs"] for baseline in baselines}
    complete = {name: found for name, found in by_name.items() if set(scenes_of(found)) >= set(scenes)}
    if len(scenes) < 2 or not complete:
        return []
    common = set.intersection(*({(r["scene"], r["seed"]) for r in found} for found in complete.values()))
    rows = []
    for name, found in complete.items():
        compared = [run for run in found if run["scene"] in scenes and (run["scene"], run["seed"]) in common]
        cells, psnr = [], []
        for of_scene in ([run for run in compared if run["scene"] == scene] for scene in scenes):
            psnr.append(statistics.median(run["curve"][-1][-1] for run in of_scene))
            any_failed = any("outcome" in run and failed(run) for run in of_scene)
            cells.append(f"({psnr[-1]:.2f})" if any_failed else f"{psnr[-1]:.2f}")
        least = min(run["curve"][-1][-1] for run in compared)
        rows.append([name, *cells, f"{statistics.mean(psnr):.2f}", f"{least:.2f}", _failures(compared)])
    return [
        "## Every scene",
        "PSNR at the end, on the scenes and seeds that all of these have; in brackets where a training failed. "
        "*Least*: of a single training.",
        markdown_table(["", *scenes, "mean", "least", "failed"], rows),
    ]


def _column_seconds(runs: list[Run]) -> list[int]:
    """Moments that tables have columns for."""
    return [seconds for seconds in (3, 7, 20, 60) if any(run["seconds"] > 1.05 * seconds for run in runs)]


def _seconds_head(seconds: Iterable[int | float]) -> list[str]:
    return [*(f"{t:g} s" for t in seconds), "end"]


def _psnr_fields(runs: list[Run], seconds: Sequence[float]) -> list[str]:
    return [decimals(mean_psnr_at(runs, t)) for t in (*seconds, END)]


def _failures(runs: list[Run]) -> str:
    return f"{sum(map(failed, runs))} of {len(runs)}" if all("outcome" in run for run in runs) else "–"


def _cost_fields(runs: list[Run]) -> list[str]:
    step = statistics.median(1000 * (run["seconds"] - run["ready_seconds"]) / run["steps"] for run in runs)
    queries = statistics.median(run["queries"] / run["steps"] for run in runs)
    memory = statistics.median(run["peak_bytes"] for run in runs) / 2**20
    return [f"{step:.1f}", f"{queries:,.0f}", f"{memory:,.0f} MiB"]
