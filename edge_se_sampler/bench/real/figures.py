"""Picture of the trainings on real scenes: PSNR over training time."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from itertools import chain
from typing import Any

from edge_se_sampler.bench.chart.summary import mean_psnr_at
from edge_se_sampler.bench.real.published import PUBLISHED
from edge_se_sampler.bench.real.summary import (
    BASELINE,
    UNIFORM,
    WITHOUT_MASKS,
    Trainings,
    by_program,
    is_published,
    label_of,
    name_of,
    panel_of,
    panels_of,
    psnr_by_budget,
    seconds_of,
)
from edge_se_sampler.bench.results import Run
from edge_se_sampler.engine.figures import require_pyplot, style_axes

TICKS = {10: "10 s", 60: "1 min", 180: "3 min", 600: "10 min", 3600: "1 h", 86400: "1 d"}
MARKS = "s^Dv*P"
LINES = {BASELINE: ("-", "black"), UNIFORM: ("-.", "C5"), WITHOUT_MASKS: ("--", "black")}
"""Style and color, by variant."""


def describe_lines(runs: list[Run], baselines: Mapping[str, Mapping[str, Any]]) -> str:
    """What a picture of trainings with time budgets shows, in words."""
    variants = {run["variant"] for run in runs}
    parts = {
        "lean-nerf (black)": BASELINE in variants,
        "without the masks' hull (dashed)": WITHOUT_MASKS in variants,
        "with uniform pixels (brown)": UNIFORM in variants,
        "other programs (dotted)": bool(baselines),
        "published results, on GPUs (gray marks)": any(map(is_published, panels_of(runs))),
    }
    shown = ", ".join(part for part, is_there in parts.items() if is_there)
    return f"Test PSNR in dB over training time: {shown}; bands: from the least to the greatest of the seeds"


def draw_chart(runs: list[Run], baselines: Mapping[str, Mapping[str, Any]]) -> Any:
    """A panel for every scene and size: lean-nerf black, a band over seeds, dashed without masks, brown with uniform
    pixels; other programs dotted; published results of GPUs as marks, where images have their size."""
    panels = panels_of(runs)
    beside = {panel: by_program(baselines, panel) for panel in panels}
    colors = {name: f"C{i}" for i, name in enumerate(dict.fromkeys(chain(*beside.values())))}
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    figure, axes = require_pyplot().subplots(
        rows, columns, figsize=(4.6 * columns, 3.2 * rows), squeeze=False, layout="constrained"
    )
    for axis, panel in zip(axes.flat, panels, strict=False):
        for variant in LINES:
            _draw_budgets(axis, [r for r in runs if panel_of(r) == panel and r["variant"] == variant])
        for name, trainings in beside[panel].items():
            for found in trainings:
                _draw_curve(axis, found, label=name, color=colors[name])
        if is_published(panel):
            _draw_published(axis, panel[0])
        axis.set_title(label_of(panel), fontsize=10)
        axis.set_xscale("log")
        style_axes(axis)
        axis.set_xticks(list(TICKS), list(TICKS.values()))
        axis.minorticks_off()
        low, high = axis.dataLim.intervalx
        axis.set_xlim(0.7 * low, 1.4 * high)
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    handles = {}
    for axis in axes.flat:
        handles |= {label: line for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(
        handles.values(), handles, loc="outside lower center", ncols=2, handlelength=3, fontsize=8, frameon=False
    )
    figure.suptitle("test PSNR [dB] over training time; bands: least to greatest of the seeds", fontsize=9)
    return figure


def _draw_budgets(axis: Any, runs: list[Run]) -> None:
    """The median over seeds at every time budget, each a training of its own."""
    if runs:
        by_seconds = {seconds_of(budget): psnr for budget, psnr in psnr_by_budget(runs).items()}
        medians = [statistics.median(psnr) for psnr in by_seconds.values()]
        linestyle, color = LINES[runs[0]["variant"]]
        style = {"color": color, "linewidth": 2, "marker": "o", "markersize": 4, "linestyle": linestyle, "zorder": 3}
        axis.plot(list(by_seconds), medians, label=name_of(runs[0]["variant"]), **style)
        low, high = ([over(psnr) for psnr in by_seconds.values()] for over in (min, max))
        axis.fill_between(list(by_seconds), low, high, color=color, alpha=0.12, linewidth=0)
        axis.vlines(list(by_seconds), low, high, color=color, alpha=0.3)  # a band at a single moment has no width


def _draw_curve(axis: Any, runs: Trainings, **style: Any) -> None:
    """The median over seeds where a program was looked at."""
    moments = [seconds for seconds, _ in runs[0]["curve"]]
    axis.plot(moments, [mean_psnr_at(runs, t) for t in moments], ":", marker=".", linewidth=1.6, **style)


def _draw_published(axis: Any, scene: str) -> None:
    for mark, published in zip(MARKS, PUBLISHED, strict=True):
        if scene in published.psnr:
            label = f"{published.method}, {published.training}"
            axis.plot(published.seconds, published.psnr[scene], mark, color="gray", markersize=6, label=label)
