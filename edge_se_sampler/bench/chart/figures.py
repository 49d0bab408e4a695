"""Pictures of the chart: PSNR over training time."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from edge_se_sampler.bench.baselines.results import name_of
from edge_se_sampler.bench.chart.summary import (
    baseline_runs,
    comparable_groups,
    mean_psnr_at,
    runs_of,
    scenes_of,
    upper_envelope,
)
from edge_se_sampler.bench.chart.trials import EVAL_SECONDS, ChartSettings
from edge_se_sampler.bench.chart.variants import GROUPS, RECOMMENDED, TOP, VARIANTS, Group
from edge_se_sampler.bench.outcomes import failed
from edge_se_sampler.bench.runner import Run
from edge_se_sampler.engine.figures import require_pyplot

RECOMMENDED_STYLE = ("black", "-")
Style = tuple[str, str]
"""Color and line style."""


def time_label(settings: ChartSettings) -> str:
    """What is meant by a second."""
    return "CPU seconds of training, one core" if settings.threads == 1 else f"seconds on {settings.threads} cores"


def draw_chart(runs: list[Run], baselines: Sequence[dict[str, Any]], settings: ChartSettings) -> Any:
    """PSNR over training time of the methods and their error sources, bands over seeds; baselines dotted; behind them
    a wide line along the best, named in the order of time."""
    figure, axis = require_pyplot().subplots(figsize=(8.8, 5.2))
    shown = comparable_groups(runs, TOP)
    for name, style in _styles(shown).items():
        _draw_curve(axis, shown[name], VARIANTS[name].label, style, name == RECOMMENDED)
    shown_runs = [run for of_variant in shown.values() for run in of_variant]
    for i, baseline in enumerate(baselines):
        if found := baseline_runs(baseline, shown_runs):
            label = f"{name_of(baseline)} ({baseline['settings']['program_version']})"
            _draw_curve(axis, found, label, (f"C{(i + 4) % 10}", ":"), False)
    envelope = upper_envelope(shown_runs)
    best = list(dict.fromkeys(VARIANTS[name].label for _, name, _, _ in envelope))
    axis.plot(
        [row[0] for row in envelope], [row[2] for row in envelope], color="0.85", lw=9, zorder=0,
        label=f"best: {', then '.join(best)}",
    )  # fmt: skip
    axis.set_ylabel("test PSNR [dB]")
    axis.set_title(f"scenes: {', '.join(scenes_of(shown_runs))}; bands: least to greatest of the seeds", fontsize=9)
    _finish(axis, time_label(settings))
    axis.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    figure.tight_layout()
    return figure


def draw_parts(runs: list[Run], groups: Sequence[Group], settings: ChartSettings) -> Any:
    """PSNR over training time of what is changed of the recommended method, a panel a group of changes."""
    figure, axes = require_pyplot().subplots(
        1, len(groups), figsize=(4.4 * len(groups), 6.4), sharey=True, squeeze=False
    )
    for axis, group in zip(axes[0], groups, strict=True):
        for i, (name, found) in enumerate(comparable_groups(runs, (group,)).items()):
            strong = name == RECOMMENDED
            style = RECOMMENDED_STYLE if strong else (f"C{i % 10}", "-" if i < 11 else "--")
            _draw_curve(axis, found, VARIANTS[name].label, style, strong)
        axis.set_title(GROUPS[group][0], fontsize=10)
        _finish(axis, time_label(settings))
        axis.legend(fontsize=7, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.14))
    axes[0, 0].set_ylabel("test PSNR [dB]")
    figure.tight_layout()
    return figure


def draw_scenes(runs: list[Run], baselines: Sequence[dict[str, Any]], settings: ChartSettings) -> Any:
    """The methods, or what there is if there are none: a panel a scene, a line a seed; failed ones end in a cross."""
    scenes = scenes_of(runs)
    columns = min(4, len(scenes))
    rows = -(-len(scenes) // columns)
    figure, axes = require_pyplot().subplots(
        rows, columns, figsize=(3.1 * columns, 2.7 * rows), squeeze=False, sharex=True, sharey=True
    )
    trained = [name for name in VARIANTS if runs_of(runs, name)]
    shown = [name for name in trained if VARIANTS[name].group == "methods"] or trained
    labelled: set[str] = set()

    def plot(axis: Any, run: Run, label: str, line: str, **style: Any) -> None:
        x, y = [row[0] for row in run["curve"]], [row[-1] for row in run["curve"]]
        axis.plot(x, y, line, label=None if label in labelled else label, **style)
        labelled.add(label)

    for axis, scene in zip(axes.ravel(), scenes, strict=False):
        for name, (color, line) in _styles(shown).items():
            for run in runs_of(runs, name, scene):
                plot(axis, run, VARIANTS[name].label, line, color=color, lw=1.6 if name == RECOMMENDED else 0.9)
                if failed(run):
                    axis.plot(run["curve"][-1][0], run["curve"][-1][-1], "x", color=color, ms=6)
        for run in (run for baseline in baselines for run in baseline["runs"] if run["scene"] == scene):
            plot(axis, run, "other programs", ":", color="black", lw=1)
        axis.set_title(scene)
        _finish(axis, "")
    for axis in axes.ravel()[len(scenes) :]:
        axis.set_visible(False)
    for axis in axes.ravel()[len(scenes) - columns : len(scenes)]:
        axis.tick_params(labelbottom=True)  # also above an empty panel
    figure.legend(loc="lower center", ncols=4, fontsize=8, frameon=False)
    figure.supylabel("test PSNR [dB]", fontsize=9)
    figure.supxlabel(time_label(settings), fontsize=9, y=0.1)
    figure.tight_layout(rect=(0, 0.1, 1, 1))
    return figure


def _styles(names: Collection[str]) -> dict[str, Style]:
    """The recommended variant black, methods solid, error sources dashed."""
    others = [name for name in names if name != RECOMMENDED]
    lines = ("--" if VARIANTS[name].group == "errors" else "-" for name in others)
    styles = {name: (f"C{i % 10}", line) for i, (name, line) in enumerate(zip(others, lines, strict=True))}
    return {name: styles.get(name, RECOMMENDED_STYLE) for name in names}


def _draw_curve(axis: Any, runs: list[Run], label: str, style: Style, strong: bool) -> None:
    """The median over seeds, a mean over scenes, and the band from the least to the largest seed."""
    first = max(run["curve"][0][0] for run in runs)
    last = max(first, min(run["curve"][-1][0] for run in runs))
    moments = sorted({first, *(seconds for seconds in EVAL_SECONDS if first < seconds < last), last})
    low, middle, high = ([mean_psnr_at(runs, t, over) for t in moments] for over in (np.min, np.median, np.max))
    failures = sum("outcome" in run and failed(run) for run in runs)  # baselines have no outcome
    label += f", {failures} of {len(runs)} failed" if failures else ""
    color, line = style
    axis.plot(moments, middle, line, color=color, lw=2.6 if strong else 1.3, label=label, zorder=3 if strong else 2)
    axis.fill_between(moments, low, high, color=color, alpha=0.12, lw=0)


def _finish(axis: Any, label: str) -> None:
    axis.set(xscale="log", xlabel=label)
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)
    ticks = [tick for tick in (1, 3, 10, 30, 100) if tick < 2 * axis.dataLim.x1]
    axis.set_xticks(ticks, [str(tick) for tick in ticks])
    axis.minorticks_off()
