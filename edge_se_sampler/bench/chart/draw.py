"""Pictures of the chart: PSNR against training time, network evaluations and memory."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from edge_se_sampler.bench.chart.summary import (
    RECOMMENDED,
    TOP,
    Run,
    beside,
    comparable,
    front,
    over_scenes,
    scenes_of,
)
from edge_se_sampler.bench.chart.train import LOOKS, Scale
from edge_se_sampler.bench.chart.variants import GROUPS, VARIANTS, Group
from edge_se_sampler.engine.figures import require_pyplot

MIB = 2**20


def seconds_of(scale: Scale) -> str:
    """What is meant by a second."""
    return "CPU seconds of training, one core" if scale.threads == 1 else f"seconds of training, {scale.threads} cores"


def draw_chart(runs: list[Run], external: Sequence[dict[str, Any]], scale: Scale) -> Any:
    """PSNR over training time of methods and scorings, bands over seeds; other programs dotted; their front
    behind them, named in the order of time."""
    figure, axis = require_pyplot().subplots(figsize=(8.8, 5.2))
    shown = comparable(runs, TOP)
    for name, (color, style) in _looks_of(shown).items():
        _draw_curve(axis, shown[name], VARIANTS[name].label, color, style, name == RECOMMENDED)
    common = {run["scene"] for mine in shown.values() for run in mine}
    for i, program in enumerate(external):
        if mine := beside(program, shown):
            _draw_curve(axis, mine, f"{program['name']} ({program['version']})", f"C{(i + 4) % 10}", ":", False)
    _draw_front(axis, [run for mine in shown.values() for run in mine])
    axis.set(ylabel="test PSNR [dB]")
    axis.set_title(f"mean over {', '.join(sorted(common))}; bands: least to largest of the seeds", fontsize=9)
    _finish(axis, seconds_of(scale))
    axis.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    figure.tight_layout()
    return figure


def draw_parts(runs: list[Run], scale: Scale) -> Any:
    """The same for what is changed of the recommended method, a panel a kind of change."""
    trained = {VARIANTS[run["variant"]].group for run in runs}
    groups: list[Group] = [group for group in GROUPS if group not in TOP and group in trained]
    figure, axes = require_pyplot().subplots(
        1, max(1, len(groups)), figsize=(4.4 * max(1, len(groups)), 6.4), sharey=True, squeeze=False
    )
    axes = axes[0]
    for axis, group in zip(axes, groups, strict=False):
        for i, (name, mine) in enumerate(comparable(runs, (group,)).items()):
            strong = name == RECOMMENDED
            color = "black" if strong else f"C{i % 10}"
            _draw_curve(axis, mine, VARIANTS[name].label, color, "-" if i < 11 else "--", strong)
        axis.set_title(GROUPS[group])
        _finish(axis, seconds_of(scale))
        axis.legend(fontsize=7, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.14))
    axes[0].set_ylabel("test PSNR [dB]")
    figure.tight_layout()
    return figure


def draw_costs(runs: list[Run]) -> Any:
    """Methods and scorings: PSNR over how often the networks were asked, and at the end over memory; medians."""
    figure, (asked, memory) = require_pyplot().subplots(1, 2, figsize=(10.4, 4.2), sharey=True)
    shown = comparable(runs, TOP)
    for name, (color, style) in _looks_of(shown).items():
        strong = name == RECOMMENDED
        for run in shown[name]:
            points = np.array(run["curve"])
            asked.plot(points[:, 2], points[:, 3], style, color=color, lw=2 if strong else 0.9)
        label, psnr = VARIANTS[name].label, statistics.median(run["psnr"] for run in shown[name])
        room = statistics.median(run["peak_bytes"] for run in shown[name]) / MIB
        memory.plot(room, psnr, "*" if strong else "o", color=color, ms=12 if strong else 7, label=label)
    asked.set(xscale="log", xlabel="points that the networks were asked about", ylabel="test PSNR [dB]")
    memory.set(xlim=(0, 1.1 * memory.get_xlim()[1]), xlabel="peak memory above the imports' [MiB]")
    memory.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    for axis in (asked, memory):
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    return figure


def draw_scenes(runs: list[Run], external: Sequence[dict[str, Any]], scale: Scale) -> Any:
    """Methods, or what there is if there are none: a panel a scene, every seed a line; failed ones end in a cross."""
    names = scenes_of(runs)
    columns = min(4, len(names))
    rows = -(-len(names) // columns)
    figure, axes = require_pyplot().subplots(
        rows, columns, figsize=(3.1 * columns, 2.7 * rows), squeeze=False, sharex=True, sharey=True
    )
    trained = {name: v for name, v in VARIANTS.items() if any(run["variant"] == name for run in runs)}
    shown = {name: v for name, v in trained.items() if v.group == "methods"} or trained
    labelled: set[str] = set()
    for axis, scene in zip(axes.ravel(), names, strict=False):
        for name, (color, style) in _looks_of(shown).items():
            for run in (run for run in runs if (run["variant"], run["scene"]) == (name, scene)):
                x, y = [point[0] for point in run["curve"]], [point[-1] for point in run["curve"]]
                label = shown[name].label if name not in labelled else None
                labelled.add(name)
                axis.plot(x, y, style, color=color, lw=1.6 if name == RECOMMENDED else 0.9, label=label)
                if run["outcome"] != "learnt":
                    axis.plot(x[-1], y[-1], "x", color=color, ms=6)
        for program in external:
            for run in (run for run in program["runs"] if run["scene"] == scene):
                label = None if "others" in labelled else "other programs"
                labelled.add("others")
                axis.plot([p[0] for p in run["curve"]], [p[-1] for p in run["curve"]], "k:", lw=1, label=label)
        axis.set_title(scene)
        _finish(axis, "")
    for axis in axes.ravel()[len(names) :]:
        axis.set_visible(False)
    for axis in axes.ravel()[len(names) - columns : len(names)]:
        axis.tick_params(labelbottom=True)  # also above a place left empty
    figure.legend(loc="lower center", ncols=4, fontsize=8, frameon=False)
    figure.supylabel("test PSNR [dB]", fontsize=9)
    figure.supxlabel(seconds_of(scale), fontsize=9, y=0.1)
    figure.tight_layout(rect=(0, 0.11, 1, 1))
    return figure


def _looks_of(shown: dict[str, Any]) -> dict[str, tuple[str, str]]:
    """Colour and line of each variant: black for the recommended one."""
    others = [name for name in shown if name != RECOMMENDED]
    told = {name: (f"C{i % 10}", "-" if VARIANTS[name].group == "methods" else "--") for i, name in enumerate(others)}
    return {name: told.get(name, ("black", "-")) for name in shown}


def _draw_curve(axis: Any, runs: list[Run], label: str, color: str, style: str, strong: bool) -> None:
    begins = max(run["curve"][0][0] for run in runs)
    ends = max(begins, min(run["curve"][-1][0] for run in runs))
    moments = sorted({begins, *(look for look in LOOKS if begins < look < ends), ends})
    over: list[Callable[[Any], Any]] = [np.min, np.median, np.max]
    low, middle, high = ([over_scenes(runs, moment, of) for moment in moments] for of in over)
    failed = sum(run.get("outcome", "learnt") != "learnt" for run in runs)  # other programs' results tell none
    label += f", {failed} of {len(runs)} failed" if failed else ""
    axis.plot(moments, middle, style, color=color, lw=2.6 if strong else 1.3, label=label, zorder=3 if strong else 2)
    axis.fill_between(moments, low, high, color=color, alpha=0.12, lw=0)


def _draw_front(axis: Any, shown: list[Run]) -> None:
    told = front(shown)
    names = list(dict.fromkeys(VARIANTS[row["best"]].label for row in told))
    label = f"front: {', then '.join(names)}"
    axis.plot(
        [row["seconds"] for row in told], [row["psnr"] for row in told], color="0.85", lw=9, zorder=0, label=label
    )


def _finish(axis: Any, label: str) -> None:
    axis.set(xscale="log", xlabel=label)
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)
    marks = [mark for mark in (1, 3, 10, 30, 100) if mark < 2 * axis.dataLim.x1]
    axis.set_xticks(marks, [str(mark) for mark in marks])
    axis.minorticks_off()
