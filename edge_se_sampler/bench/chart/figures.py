"""Pictures of the chart: PSNR over training time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from edge_se_sampler.bench.chart.summary import by_variant, comparable, mean_psnr_at, runs_on, scenes_of
from edge_se_sampler.bench.chart.trials import EVAL_SECONDS, ChartSettings
from edge_se_sampler.bench.chart.variants import RECOMMENDED, TOP, VARIANTS
from edge_se_sampler.bench.outcomes import failed
from edge_se_sampler.bench.results import Run
from edge_se_sampler.engine.figures import require_pyplot, style_axes


def draw_chart(runs: list[Run], baselines: Mapping[str, list[Run]], settings: ChartSettings) -> Any:
    """PSNR over training time of the methods and their error sources, bands over seeds; baselines (label -> runs)
    dotted."""
    figure, axis = require_pyplot().subplots(figsize=(8.8, 5.2), layout="constrained")
    compared = comparable(by_variant(runs, TOP))
    scenes = scenes_of(next(iter(compared.values())))
    styles = _styles(compared)
    for name, found in compared.items():
        failures = sum(map(failed, found))
        label = VARIANTS[name].label + (f", {failures} of {len(found)} failed" if failures else "")
        _draw_curve(axis, found, label=label, **styles[name])
    for i, (label, all_runs) in enumerate(baselines.items(), 4):
        if found := runs_on(all_runs, scenes):
            _draw_curve(axis, found, label=label, color=f"C{i % 10}", linestyle=":")
    axis.set(xlabel=f"training time [{settings.unit}]", ylabel="test PSNR [dB]")
    axis.set_title(f"scenes: {', '.join(scenes)}; bands: least to greatest of the seeds", fontsize=9)
    _set_time_axis(axis)
    figure.legend(fontsize=8, frameon=False, loc="outside right upper")
    return figure


def draw_scenes(runs: list[Run], baselines: Mapping[str, list[Run]], settings: ChartSettings) -> Any:
    """The methods, or what there is if there are none: a panel a scene, a line a seed; failed ones end in a cross."""
    scenes = scenes_of(runs)
    columns = min(4, len(scenes))
    rows = -(-len(scenes) // columns)
    figure, axes = require_pyplot().subplots(
        rows, columns, figsize=(3.1 * columns, 2.7 * rows), squeeze=False, sharey=True, layout="constrained"
    )
    shown = by_variant(runs, ["methods"]) or by_variant(runs)
    styles = _styles(shown)
    for axis, scene in zip(axes.flat, scenes, strict=False):
        for name, found in shown.items():
            for run in (run for run in found if run["scene"] == scene):
                seconds, *_, psnr = zip(*run["curve"], strict=True)
                axis.plot(seconds, psnr, label=VARIANTS[name].full_label, **styles[name] | {"linewidth": 1.2})
                if failed(run):
                    axis.plot(seconds[-1], psnr[-1], "x", color=styles[name]["color"])
        for run in (run for found in baselines.values() for run in found if run["scene"] == scene):
            axis.plot(*zip(*run["curve"], strict=True), ":", label="other programs", color="black", linewidth=1)
        axis.set_title(scene)
        _set_time_axis(axis)
    for axis in axes.flat[len(scenes) :]:
        axis.set_visible(False)
    handles = {}
    for axis in axes.flat:
        handles |= {label: line for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    figure.suptitle(f"test PSNR [dB] over training time [{settings.unit}]", fontsize=10)
    return figure


def _styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """The recommended variant black and wide, methods solid, error sources dashed."""
    styles: dict[str, dict[str, Any]] = {RECOMMENDED: {"color": "black", "linewidth": 2.4, "zorder": 3}}
    for i, name in enumerate(name for name in names if name != RECOMMENDED):
        linestyle = "--" if VARIANTS[name].group == "errors" else "-"
        styles[name] = {"color": f"C{i % 10}", "linestyle": linestyle, "linewidth": 1.2}
    return styles


def _draw_curve(axis: Any, runs: list[Run], color: str, **style: Any) -> None:
    """The median over seeds, a mean over scenes, and the band from the least to the greatest seed."""
    first = max(run["curve"][0][0] for run in runs)
    last = max(first, min(run["curve"][-1][0] for run in runs))
    moments = sorted({first, *(seconds for seconds in EVAL_SECONDS if first < seconds < last), last})
    low, middle, high = ([mean_psnr_at(runs, t, over) for t in moments] for over in (np.min, np.median, np.max))
    axis.plot(moments, middle, color=color, **style)
    axis.fill_between(moments, low, high, color=color, alpha=0.12, linewidth=0)


def _set_time_axis(axis: Any) -> None:
    axis.set_xscale("log")
    style_axes(axis)
    ticks = [tick for tick in (1, 3, 10, 30, 100) if tick < 2 * axis.dataLim.x1]
    axis.set_xticks(ticks, [str(tick) for tick in ticks])
    axis.minorticks_off()
