"""What the map's runs say: failures of every point and strategy, as a table and as pictures."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from edge_se_sampler.bench.experiment import write_result
from edge_se_sampler.bench.stability.settings import STRATEGIES, points
from edge_se_sampler.bench.statistics import wilson_interval
from edge_se_sampler.engine.figures import require_pyplot, save_figure
from edge_se_sampler.engine.files import write_atomically

SHORT = {
    "slow": "slow",
    "dead at the start": "dead",
    "killed by the data": "killed",
    "opaque background": "opaque",
}
LEGEND = (
    "Failures of runs, with the 95 % Wilson interval of the rate and how they ended. dead: no density anywhere before "
    "the first step; killed: empty at the end; opaque: the background's colour in front of everything; slow: less than "
    "0.5 dB better than an empty scene."
)


def write_outputs(result: dict[str, Any], views: Path, output_dir: Path) -> None:
    """The totals in result.json, table.md, map.png, survival.png and sheet.png, of the runs that there are.

    Raises:
        InputError: a file cannot be written, or matplotlib is missing.
    """
    runs = result["runs"]
    result["totals"] = totals(runs)
    write_result(output_dir / "result.json", result)
    write_atomically(output_dir / "table.md", table(runs).encode())
    if runs:
        save_figure(draw_map(runs), output_dir / "map.png")
        save_figure(draw_survival(runs), output_dir / "survival.png")
    sheet = draw_sheet(runs, views)
    if sheet is not None:
        save_figure(sheet, output_dir / "sheet.png")


def of(runs: list[dict[str, Any]], point: int, strategy: str) -> list[dict[str, Any]]:
    """A point's runs under a strategy, by seed."""
    return [run for run in runs if (run["point"], run["strategy"]) == (point, strategy)]


def totals(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of every point and strategy: label, runs, failures, their Wilson interval, endings, of both networks."""
    told = []
    for number, point in enumerate(points()):
        for strategy in STRATEGIES:
            mine = of(runs, number, strategy)
            if not mine:
                continue
            failures = sum(run["outcome"] != "learnt" for run in mine)
            low, high = wilson_interval(failures, len(mine))
            told.append(
                {
                    "point": number,
                    "label": point.label,
                    "strategy": strategy,
                    "runs": len(mine),
                    "failures": failures,
                    "interval": [round(low, 4), round(high, 4)],
                    "fine": dict(Counter(run["fine_ending"] for run in mine)),
                    "coarse": dict(Counter(run["coarse_ending"] for run in mine)),
                    "revived": sum(run["revived"] for run in mine),
                }
            )
    return told


def table(runs: list[dict[str, Any]]) -> str:
    """Markdown: points down, strategies across."""
    place = {(row["point"], row["strategy"]): row for row in totals(runs)}
    shown = [name for name in STRATEGIES if any(strategy == name for _, strategy in place)]
    lines = ["| | " + " | ".join(STRATEGIES[name].label for name in shown) + " |", "|---" * (len(shown) + 1) + "|"]
    for number, point in enumerate(points()):
        if any(of_point == number for of_point, _ in place):
            fields = [_field(place.get((number, name))) for name in shown]
            lines.append(f"| {point.label} | " + " | ".join(fields) + " |")
    return LEGEND + "\n\n" + "\n".join(lines) + "\n"


def _field(row: dict[str, Any] | None) -> str:
    if row is None:
        return "–"
    low, high = row["interval"]
    endings = ", ".join(f"{n} {SHORT[how]}" for how, n in sorted(row["fine"].items()) if how in SHORT)
    how = f" ({endings})" if endings else ""
    return f"**{row['failures']}/{row['runs']}** [{100 * low:.0f}–{100 * high:.0f} %]{how}"


def draw_map(runs: list[dict[str, Any]]) -> Any:
    """Failure rates as colours: points down, strategies across."""
    rows = totals(runs)
    numbers = sorted({row["point"] for row in rows})
    names = [name for name in STRATEGIES if any(row["strategy"] == name for row in rows)]
    rates = np.full((len(numbers), len(names)), np.nan)
    for row in rows:
        rates[numbers.index(row["point"]), names.index(row["strategy"])] = row["failures"] / row["runs"]
    figure, axis = require_pyplot().subplots(figsize=(1.05 * len(names) + 3.0, 0.33 * len(numbers) + 1.9))
    axis.imshow(rates, cmap="RdYlGn_r", vmin=0, vmax=1, aspect="auto")
    for row in rows:
        at = names.index(row["strategy"]), numbers.index(row["point"])
        rate = row["failures"] / row["runs"]
        color = "white" if abs(rate - 0.5) > 0.35 else "black"
        axis.text(*at, f"{row['failures']}/{row['runs']}", ha="center", va="center", fontsize=8, color=color)
    axis.set_xticks(range(len(names)), [STRATEGIES[name].label.replace(", ", ",\n") for name in names], fontsize=8)
    axis.xaxis.tick_top()
    axis.set_yticks(range(len(numbers)), [points()[number].label for number in numbers], fontsize=8)
    axis.tick_params(length=0)
    axis.set_xlabel("failures of runs; each point differs from the base in what is named", fontsize=9)
    figure.tight_layout()
    return figure


def draw_survival(runs: list[dict[str, Any]]) -> Any:
    """Share of runs that show something of the object (error below 0.9 of an empty scene's), over iterations."""
    numbers = sorted({run["point"] for run in runs})
    columns = min(5, len(numbers))
    rows = -(-len(numbers) // columns)
    figure, axes = require_pyplot().subplots(
        rows, columns, figsize=(2.5 * columns, 1.9 * rows + 0.7), squeeze=False, sharex=True, sharey=True
    )
    for axis, number in zip(axes.ravel(), numbers, strict=False):
        axis.set_title(points()[number].label, fontsize=8)
        for i, (name, strategy) in enumerate(STRATEGIES.items()):
            mine = of(runs, number, name)
            if mine:
                alive = np.mean([np.array(run["shares"]) < 0.9 for run in mine], axis=0)
                x = 100 * np.arange(1, len(alive) + 1) / len(alive)
                axis.plot(x, alive + 0.004 * i, color=f"C{i}", lw=1.2, label=strategy.label)
        axis.set(ylim=(-0.05, 1.08), xlim=(0, 100))
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25)
    for axis in axes.ravel()[len(numbers) :]:
        axis.set_visible(False)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=5, fontsize=8, frameon=False)
    inch = 1 / (1.9 * rows + 0.7)
    figure.supylabel("share of runs that show the object", fontsize=9, x=0.005)
    figure.supxlabel("% of the iterations", fontsize=9, y=0.48 * inch)
    figure.tight_layout(rect=(0.015, 0.62 * inch, 1, 1))
    return figure


def draw_sheet(runs: list[dict[str, Any]], views: Path, columns: int = 4) -> Any:
    """What failed runs look like: some of each ending, as held-out view, rendering and opacity."""
    kept = [(run, views / f"point-{run['point']}-{run['strategy']}-{run['seed']}.png") for run in runs]
    by_ending = {how: [(run, path) for run, path in kept if run["outcome"] == how and path.exists()] for how in SHORT}
    by_ending = {how: found for how, found in by_ending.items() if found}
    if not by_ending:
        return None
    figure, axes = require_pyplot().subplots(
        len(by_ending), columns, figsize=(3.0 * columns, 1.5 * len(by_ending) + 0.3), squeeze=False
    )
    figure.suptitle("held-out view | rendering | opacity (white: opaque)", fontsize=9)
    for row, (how, found) in zip(axes, by_ending.items(), strict=True):
        spread = [found[i] for i in sorted({round(i) for i in np.linspace(0, len(found) - 1, columns)})]
        row[0].set_ylabel(f"{how}\n({len(found)} runs)", fontsize=8)
        for axis in row:
            axis.set(xticks=[], yticks=[])
        for axis, (run, path) in zip(row, spread, strict=False):
            axis.imshow(iio.imread(path), interpolation="nearest", vmin=0, vmax=255)
            label = STRATEGIES[run["strategy"]].label
            axis.set_title(f"{label}\n{points()[run['point']].label}", fontsize=6.5)
        for axis in row[len(spread) :]:
            axis.set_visible(False)
    figure.tight_layout()
    return figure
