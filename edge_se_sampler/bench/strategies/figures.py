"""Picture of the strategies: differences from uniform pixels at equal CPU seconds and at equal steps."""

from __future__ import annotations

from typing import Any

from edge_se_sampler.bench.results import Run
from edge_se_sampler.bench.strategies.summary import Panel, compare, panels_of, strategies_of
from edge_se_sampler.bench.strategies.trials import UNIFORM
from edge_se_sampler.engine.figures import require_pyplot, style_axes

STYLES = {
    "seconds": {"color": "C0", "marker": "o", "label": "equal CPU seconds"},
    "steps": {"color": "C1", "marker": "D", "label": "equal steps"},
}
COLUMNS = 4
LINEAR_LIMIT = 3
"""dB: with larger differences, those of trainings that failed, an axis is logarithmic beyond 1 dB."""


def draw_differences(runs: list[Run], labels: dict[Panel, str]) -> Any:
    """A part of the figure for every panel, a line for every strategy: the difference, and from the least to the
    greatest of its pairs; shaded: uniform pixels' own spread over seeds, to both sides."""
    panels = [panel for panel in panels_of(runs) if any(run["strategy"] != UNIFORM for run in _of(runs, panel))]
    names = [name for name in strategies_of(runs) if name != UNIFORM]
    columns = min(COLUMNS, max(1, len(panels)))
    rows = max(1, -(-len(panels) // columns))
    size = (1.6 + 2.6 * columns, 1.0 + rows * (0.7 + 0.22 * len(names)))
    figure, axes = require_pyplot().subplots(
        rows, columns, figsize=size, squeeze=False, sharey=True, layout="constrained"
    )
    for axis, panel in zip(axes.flat, panels, strict=False):
        for plan, offset in (("seconds", -0.15), ("steps", 0.15)):
            _draw_plan(axis, runs, panel, names, plan, offset)
        axis.axvline(0, color="black", linewidth=0.8)
        axis.set_title(labels[panel], fontsize=9)
        axis.set_yticks(range(len(names)), names, fontsize=8)
        axis.set_ylim(len(names) - 0.5, -0.5)
        if max(map(abs, axis.dataLim.intervalx)) > LINEAR_LIMIT:
            axis.set_xscale("symlog", linthresh=1)
            axis.set_xticks((-10, -1, 0, 1, 10), ("-10", "-1", "0", "1", "10"))
        axis.tick_params(axis="x", labelsize=8)
        style_axes(axis)
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    handles = {}
    for axis in axes.flat:
        handles |= {label: mark for mark, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    title = "test PSNR minus that of uniform pixels [dB]; where axes end at 10, they are logarithmic beyond 1"
    title += "\nlines: least to greatest of scenes and seeds"
    figure.suptitle(title, fontsize=9)
    return figure


def _of(runs: list[Run], panel: Panel) -> list[Run]:
    return [run for run in runs if Panel.of(run) == panel]


def _draw_plan(axis: Any, runs: list[Run], panel: Panel, names: list[str], plan: str, offset: float) -> None:
    uniform = compare(runs, panel, UNIFORM, plan)
    style = STYLES[plan]
    if uniform is not None and uniform.spread is not None and plan == "seconds":
        axis.axvspan(-uniform.spread, uniform.spread, color="gray", alpha=0.15, linewidth=0, label="uniform's spread")
    found = {y: comparison for y, name in enumerate(names) if (comparison := compare(runs, panel, name, plan))}
    found = {y: comparison for y, comparison in found.items() if comparison.differences}
    for y, comparison in found.items():
        ends = min(comparison.pairs), max(comparison.pairs)
        axis.plot(ends, [y + offset] * 2, color=style["color"], linewidth=1, alpha=0.6)
    if found:
        differences = [comparison.differences["psnr"] for comparison in found.values()]
        axis.plot(differences, [y + offset for y in found], linestyle="", markersize=4, **style)
