"""What the chart's runs say: PSNR against training time, the front, and what each part is worth.

A variant's curve is, at every look, the mean over scenes of the median over seeds; it ends where the slowest of its
runs ended. The front is, at every moment, the variant that is best then.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edge_se_sampler.bench.chart.train import LOOKS
from edge_se_sampler.bench.chart.variant import GROUPS, VARIANTS, Group
from edge_se_sampler.bench.experiment import write_result
from edge_se_sampler.engine.files import write_atomically
from edge_se_sampler.show import require_pyplot, save_figure

Run = dict[str, Any]
RECOMMENDED = "lean"


def write_outputs(result: dict[str, Any], external: Sequence[dict[str, Any]], output_dir: Path) -> None:
    """The front in result.json, table.md, chart.png, parts.png and scenes.png, of the runs that there are.

    Raises:
        InputError: a file cannot be written, or matplotlib is missing.
    """
    runs = result["runs"]
    result["front"] = front(runs)
    result["external"] = list(external)
    write_result(output_dir / "result.json", result)
    if runs:
        write_atomically(output_dir / "table.md", table(runs).encode())
        save_figure(draw_chart(runs, external), output_dir / "chart.png")
        save_figure(draw_parts(runs), output_dir / "parts.png")
        save_figure(draw_scenes(runs, external), output_dir / "scenes.png")


def scenes_of(runs: list[Run]) -> list[str]:
    """Scenes, in the order of their names."""
    return sorted({run["scene"] for run in runs})


def at(curve: Sequence[Sequence[float]], seconds: float) -> float | None:
    """PSNR at a moment of training, between looks by the logarithm of time; None before the first look."""
    times, psnr = [point[0] for point in curve], [point[-1] for point in curve]
    if not times or seconds < times[0] * 0.999:
        return None
    return float(np.interp(np.log(seconds), np.log(times), psnr))


def over_scenes(runs: list[Run], seconds: float, of_seeds: Callable[[Any], Any] = np.median) -> float | None:
    """Mean over scenes of the median (or what else) over seeds; None if a run had nothing to show yet."""
    values = {scene: [at(r["curve"], seconds) for r in runs if r["scene"] == scene] for scene in scenes_of(runs)}
    if not values or any(value is None for found in values.values() for value in found):
        return None
    return statistics.mean(float(of_seeds(found)) for found in values.values())


def comparable(runs: list[Run]) -> dict[str, list[Run]]:
    """Variant -> its runs on the scenes that every variant has been trained on."""
    by_variant = {name: [run for run in runs if run["variant"] == name] for name in VARIANTS}
    by_variant = {name: mine for name, mine in by_variant.items() if mine}
    common = set.intersection(*({run["scene"] for run in mine} for mine in by_variant.values()))
    return {name: [run for run in mine if run["scene"] in common] for name, mine in by_variant.items()}


def front(runs: list[Run]) -> list[dict[str, Any]]:
    """At every look the best variant, and how far the recommended one is from it, dB."""
    told = []
    for seconds in LOOKS:
        known = {name: over_scenes(mine, seconds) for name, mine in comparable(runs).items()} if runs else {}
        values = {name: value for name, value in known.items() if value is not None}
        if values:
            best = max(values, key=lambda name, of=values: of[name])
            mine = values.get(RECOMMENDED)
            behind = None if mine is None else round(values[best] - mine, 3)
            told.append(
                {"seconds": seconds, "best": best, "psnr": round(values[best], 3), "recommended_behind": behind}
            )
    return told


def table(runs: list[Run]) -> str:
    """Markdown: of every variant its PSNR at looks, at the end, failures, steps, evaluations and memory."""
    looks = [look for look in (3, 7, 20, 60) if any(run["seconds"] > look for run in runs)]
    head = ["", *(f"{look} s" for look in looks), "end", "failed", "ms a step", "evaluations a step", "memory"]
    scenes = sorted({run["scene"] for mine in comparable(runs).values() for run in mine})
    parts = [f"Mean test PSNR in dB over {', '.join(scenes)}, medians over seeds, by seconds of training."]
    for group, title in GROUPS.items():
        chosen = {name: mine for name, mine in comparable(runs).items() if VARIANTS[name].group == group}
        if chosen:
            lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
            lines += [
                f"| {VARIANTS[name].label} | {' | '.join(_fields(mine, looks))} |" for name, mine in chosen.items()
            ]
            parts.append(f"**{title}**\n\n" + "\n".join(lines))
    return "\n\n".join(parts) + "\n"


def _fields(runs: list[Run], looks: list[int]) -> list[str]:
    values = [over_scenes(runs, look) for look in looks]
    end = statistics.mean(
        statistics.median(run["psnr"] for run in runs if run["scene"] == scene) for scene in scenes_of(runs)
    )
    failed = sum(run["outcome"] != "learnt" for run in runs)
    step = statistics.median(1000 * (run["seconds"] - run["ready_seconds"]) / run["steps"] for run in runs)
    asked = statistics.median(run["evaluations"] / run["steps"] for run in runs)
    memory = statistics.median(run["peak_bytes"] for run in runs) / 2**20
    shown = ["–" if value is None else f"{value:.2f}" for value in (*values, end)]
    return [*shown, f"{failed} of {len(runs)}", f"{step:.1f}", f"{asked:,.0f}", f"{memory:,.0f} MiB"]


def draw_chart(runs: list[Run], external: Sequence[dict[str, Any]]) -> Any:
    """PSNR over training seconds of methods and scorings, bands over seeds; other programs dotted."""
    figure, axis = require_pyplot().subplots(figsize=(8.4, 5.2))
    shown = {n: m for n, m in comparable(runs).items() if VARIANTS[n].group in ("methods", "scorings")}
    for i, (name, mine) in enumerate(shown.items()):
        _draw_curve(axis, mine, VARIANTS[name].label, f"C{i % 10}", "-" if i < 10 else "--", name == RECOMMENDED)
    common = {run["scene"] for mine in shown.values() for run in mine}
    for i, program in enumerate(external):
        mine = [run for run in program["runs"] if run["scene"] in common]
        if mine:
            _draw_curve(axis, mine, f"{program['name']} {program['version']}", f"C{i + 3}", ":", False)
    axis.set(xscale="log", xlabel="seconds of training", ylabel="test PSNR [dB]")
    axis.set_title(f"mean over {', '.join(sorted(common))}; bands: least to largest of the seeds", fontsize=9)
    _finish(axis)
    axis.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    figure.tight_layout()
    return figure


def draw_parts(runs: list[Run]) -> Any:
    """The same for what is changed of the recommended method, a panel a kind of change."""
    groups: list[Group] = [group for group in GROUPS if group not in ("methods", "scorings")]
    figure, axes = require_pyplot().subplots(1, len(groups), figsize=(4.4 * len(groups), 5.2), sharey=True)
    for axis, group in zip(axes, groups, strict=True):
        every = comparable(runs)
        for i, (name, mine) in enumerate({n: m for n, m in every.items() if VARIANTS[n].group == group}.items()):
            _draw_curve(axis, mine, VARIANTS[name].label, f"C{(i + 1) % 10}", "-" if i < 9 else "--", False)
        if RECOMMENDED in every:
            _draw_curve(axis, every[RECOMMENDED], "lean-nerf", "black", "-", True)
        axis.set(xscale="log", xlabel="seconds of training", title=GROUPS[group])
        _finish(axis)
        axis.legend(fontsize=7, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2)
    axes[0].set_ylabel("test PSNR [dB]")
    figure.tight_layout()
    return figure


def draw_scenes(runs: list[Run], external: Sequence[dict[str, Any]]) -> Any:
    """Methods, a panel a scene, every seed a line; failed ones end in a cross."""
    names = scenes_of(runs)
    columns = min(4, len(names))
    rows = -(-len(names) // columns)
    figure, axes = require_pyplot().subplots(
        rows, columns, figsize=(3.1 * columns, 2.7 * rows), squeeze=False, sharex=True, sharey=True
    )
    methods = [name for name, variant in VARIANTS.items() if variant.group == "methods"]
    for axis, scene in zip(axes.ravel(), names, strict=False):
        for i, name in enumerate(methods):
            for run in (run for run in runs if (run["variant"], run["scene"]) == (name, scene)):
                x, y = [point[0] for point in run["curve"]], [point[-1] for point in run["curve"]]
                label = VARIANTS[name].label if scene == names[0] and run["seed"] == 0 else None
                axis.plot(x, y, color=f"C{i}", lw=1, label=label)
                if run["outcome"] != "learnt":
                    axis.plot(x[-1], y[-1], "x", color=f"C{i}", ms=6)
        for program in external:
            for run in (run for run in program["runs"] if run["scene"] == scene):
                axis.plot([p[0] for p in run["curve"]], [p[-1] for p in run["curve"]], "k:", lw=1)
        axis.set(xscale="log", title=scene)
        _finish(axis)
    for axis in axes.ravel()[len(names) :]:
        axis.set_visible(False)
    figure.legend(loc="lower center", ncols=4, fontsize=8, frameon=False)
    figure.supylabel("test PSNR [dB]", fontsize=9)
    figure.tight_layout(rect=(0, 0.09, 1, 1))
    return figure


def _draw_curve(axis: Any, runs: list[Run], label: str, color: str, style: str, strong: bool) -> None:
    ends = min(run["curve"][-1][0] for run in runs)
    begins = max(run["curve"][0][0] for run in runs)
    moments = [begins, *(look for look in LOOKS if begins < look < ends), ends]
    low, middle, high = ([over_scenes(runs, s, of) for s in moments] for of in (np.min, np.median, np.max))
    failed = sum(run.get("outcome", "learnt") != "learnt" for run in runs)  # other programs' results tell none
    label += f", {failed} of {len(runs)} failed" if failed else ""
    axis.plot(moments, middle, style, color=color, lw=2.4 if strong else 1.3, label=label, zorder=3 if strong else 2)
    axis.fill_between(moments, low, high, color=color, alpha=0.12, lw=0)


def _finish(axis: Any) -> None:
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)
    axis.set_xticks([1, 3, 10, 30, 100], ["1", "3", "10", "30", "100"])
    axis.minorticks_off()
