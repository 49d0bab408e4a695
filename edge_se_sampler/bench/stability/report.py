"""README.md and pictures of the robustness sweep: failures by setting and strategy."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from edge_se_sampler.bench.outcomes import COLLAPSED_SHARE, failed
from edge_se_sampler.bench.runner import Run
from edge_se_sampler.bench.stability.settings import SETTINGS, STRATEGIES, Trial
from edge_se_sampler.bench.statistics import wilson_interval
from edge_se_sampler.bench.tables import describe_command, markdown_table
from edge_se_sampler.engine.figures import require_pyplot, save_figure

FAILURE_MODES = {
    "dead at the start": "dead",
    "emptied": "emptied",
    "opaque background": "opaque",
    "underfit": "underfit",
}
PICTURES = {
    "failure-rates": "Failed trainings by setting and strategy",
    "over-time": "Share of trainings that show the object, over the iterations",
    "failures": "Failed trainings: held-out view, rendering and opacity",
}


def describe(folder: Path) -> str:
    """README.md of the sweep in a folder."""
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    runs, size = result["runs"], result["settings"]
    shown = tables(folder)
    pictures = {
        name: f"![{caption}]({name}.png)\n" for name, caption in PICTURES.items() if (folder / f"{name}.png").exists()
    }
    seeds = len({run["seed"] for run in runs})
    network = f"{size['width']} units wide, {size['samples']} + {size['samples']} samples"
    return f"""# Where training dies, and what keeps it alive

A NeRF of an object in front of a background often learns nothing but the background. How often that happens depends on
the pixels that a step trains on, and on the setting. The base setting is a small training of the paper's NeRF: a coarse
and a fine network of 4 layers, {network}, ReLU density, Xavier initialisation,
{size["iterations"]} iterations of {size["rays"]} rays, 40 views of 48 x 48 pixels, and an object that covers 5% of
white images. Every other setting differs from it in one thing, or two, which its name says. Each is trained with
{seeds} seeds, the same for every strategy.

A training *fails* if on held-out views it has more than {COLLAPSED_SHARE:.0%} of the error on the object that the
background alone has (*collapsed*), or is less than 0.5 dB better than the background alone (*underfit*). A collapsed
network was *dead* at the start (no density anywhere before the first step, hence no gradient with ReLU), was *emptied*
by training, or shows the background's color *opaque* in front of everything.

{pictures.get("failure-rates", "")}
## By strategy

*Random* samples pixels uniformly. *Precrop* samples the centre half of the images for the first tenth of the
iterations, *Edge* samples by edge strength for that time, and *SE* afterwards by the rank of squared errors.
*Reinitialised*: networks that have died get new weights (`--reinit-dead True`). *Adaptive*: edge sampling lasts until
the object is learnt (`schedule adaptive`).

{shown["strategies"]}

{_describe_hard_settings(runs)}
{pictures.get("over-time", "")}
## By setting

Failed trainings, with the 95% Wilson interval of the rate, and how they failed.

{shown["settings"]}

{pictures.get("failures", "")}
## Reproduce

{describe_command(result)}
"""


def tables(folder: Path) -> dict[str, str]:
    """`strategies`: failures of each over all settings; `settings`: of each strategy in each."""
    runs = json.loads((folder / "result.json").read_text(encoding="utf-8"))["runs"]
    settings, strategies = _present(runs)
    head = ("", "failed", *FAILURE_MODES.values(), "settings without failure", "settings with nothing but failures")
    rows = []
    for strategy in strategies:
        of_strategy = [run for run in runs if run["strategy"] == strategy]
        modes = Counter(run["failure_mode"] for run in of_strategy)
        rates = [failure_rate(runs, setting, strategy) for setting in settings]
        failures = sum(map(failed, of_strategy))
        counts = [*(modes[mode] for mode in FAILURE_MODES), rates.count(0), rates.count(1)]
        rows.append((STRATEGIES[strategy].label, f"{failures} of {len(of_strategy)}", *map(str, counts)))
    by_setting = [
        (setting, *(_describe_failures(select(runs, setting, strategy)) for strategy in strategies))
        for setting in settings
    ]
    labels = [STRATEGIES[strategy].label for strategy in strategies]
    return {"strategies": markdown_table(head, rows), "settings": markdown_table(("", *labels), by_setting)}


def draw(folder: Path, workplace: Path | None) -> None:
    """Draw the pictures; that of failed renderings only from views in the workplace."""
    runs = json.loads((folder / "result.json").read_text(encoding="utf-8"))["runs"]
    if runs:
        save_figure(draw_failure_rates(runs), folder / "failure-rates.png")
        save_figure(draw_over_time(runs), folder / "over-time.png")
    failures = draw_failures(runs, workplace / "stability" / "views") if workplace is not None else None
    if failures is not None:
        save_figure(failures, folder / "failures.png")


def select(runs: Sequence[Run], setting: str, strategy: str) -> list[Run]:
    """The runs of a setting and a strategy."""
    return [run for run in runs if (run["setting"], run["strategy"]) == (setting, strategy)]


def failure_rate(runs: Sequence[Run], setting: str, strategy: str) -> float:
    """Failed share of the runs of a setting and a strategy; NaN without runs."""
    selected = select(runs, setting, strategy)
    return sum(map(failed, selected)) / len(selected) if selected else float("nan")


def _present(runs: Sequence[Run]) -> tuple[list[str], list[str]]:
    """The settings and the strategies of the runs, in the order of the sweep."""
    settings, strategies = ({run[key] for run in runs} for key in ("setting", "strategy"))
    return [name for name in SETTINGS if name in settings], [name for name in STRATEGIES if name in strategies]


def _describe_failures(runs: Sequence[Run]) -> str:
    if not runs:
        return "–"
    failures = sum(map(failed, runs))
    low, high = wilson_interval(failures, len(runs))
    modes = Counter(run["failure_mode"] for run in runs)
    counts = ", ".join(f"{modes[mode]} {word}" for mode, word in FAILURE_MODES.items() if modes[mode])
    text = f"**{failures}/{len(runs)}** [{100 * low:.0f}–{100 * high:.0f}%]"
    return f"{text} ({counts})" if counts else text


def _describe_hard_settings(runs: Sequence[Run]) -> str:
    """Where Random survives, and where the strategies with edges fail."""
    settings, strategies = _present(runs)
    lines = []
    if "vanilla-nerf" in strategies:
        easy = [name for name in settings if failure_rate(runs, name, "vanilla-nerf") < 0.5]
        lines.append(f"- Random fails in fewer than half of the trainings of: {'; '.join(easy) or 'no setting'}.")
    for strategy in ("edge-se-nerf", "adaptive"):
        failures = {name: sum(map(failed, select(runs, name, strategy))) for name in settings}
        worst = sorted((name for name in settings if failures[name]), key=lambda name: -failures[name])
        if strategy in strategies:
            counts = "; ".join(f"{name} ({failures[name]})" for name in worst)
            lines.append(f"- {STRATEGIES[strategy].label} fails in: {counts or 'no setting'}.")
    return "".join(f"{line}\n" for line in lines)


def draw_failure_rates(runs: Sequence[Run]) -> Any:
    """Failure rates as colors: settings down, strategies across."""
    settings, strategies = _present(runs)
    rates = np.array([[failure_rate(runs, setting, strategy) for strategy in strategies] for setting in settings])
    figure, axis = require_pyplot().subplots(figsize=(1.05 * len(strategies) + 3.0, 0.33 * len(settings) + 1.9))
    axis.imshow(rates, cmap="RdYlGn_r", vmin=0, vmax=1, aspect="auto")
    for row, column in np.argwhere(~np.isnan(rates)):
        selected = select(runs, settings[row], strategies[column])
        color = "white" if abs(rates[row, column] - 0.5) > 0.35 else "black"
        text = f"{sum(map(failed, selected))}/{len(selected)}"
        axis.text(column, row, text, ha="center", va="center", fontsize=8, color=color)
    labels = [STRATEGIES[strategy].label.replace(", ", ",\n") for strategy in strategies]
    axis.set_xticks(range(len(strategies)), labels, fontsize=8)
    axis.xaxis.tick_top()
    axis.set_yticks(range(len(settings)), settings, fontsize=8)
    axis.tick_params(length=0)
    axis.set_xlabel("failed trainings; each setting differs from the base in what is named", fontsize=9)
    figure.tight_layout()
    return figure


def draw_over_time(runs: Sequence[Run]) -> Any:
    """Share of all trainings of a strategy that show something of the object, over the iterations."""
    figure, axis = require_pyplot().subplots(figsize=(8.0, 4.2))
    for strategy in _present(runs)[1]:
        shares = np.array([run["shares"] for run in runs if run["strategy"] == strategy])
        alive = 100 * (shares <= COLLAPSED_SHARE).mean(axis=0)
        axis.plot(100 * np.arange(1, len(alive) + 1) / len(alive), alive, label=STRATEGIES[strategy].label)
    axis.set(xlabel="% of the iterations", ylabel="% of trainings that show the object", xlim=(0, 100), ylim=(0, 102))
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(alpha=0.25)
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
    figure.tight_layout()
    return figure


def draw_failures(runs: Sequence[Run], views: Path, columns: int = 4) -> Any:
    """Some failed trainings of each failure mode, as their panels; None where there are no panels."""
    by_mode = {}
    for mode in FAILURE_MODES:
        trials = [Trial(run["setting"], run["strategy"], run["seed"]) for run in runs if run["failure_mode"] == mode]
        found = [trial for trial in trials if (views / f"{trial.name}.png").exists()]
        if found:
            spread = np.linspace(0, len(found) - 1, columns).round().astype(int)
            by_mode[f"{mode}\n({len(trials)} trainings)"] = [found[i] for i in np.unique(spread)]
    if not by_mode:
        return None
    figure, axes = require_pyplot().subplots(
        len(by_mode), columns, figsize=(3.0 * columns, 1.5 * len(by_mode) + 0.3), squeeze=False
    )
    figure.suptitle("held-out view | rendering | opacity (white: opaque)", fontsize=9)
    for row, (label, trials) in zip(axes, by_mode.items(), strict=True):
        row[0].set_ylabel(label, fontsize=8)
        for axis in row:
            axis.set(xticks=[], yticks=[])
        for axis, trial in zip(row, trials, strict=False):
            axis.imshow(iio.imread(views / f"{trial.name}.png"), interpolation="nearest", vmin=0, vmax=255)
            axis.set_title(f"{STRATEGIES[trial.strategy].label}\n{trial.setting}", fontsize=6.5)
        for axis in row[len(trials) :]:
            axis.set_visible(False)
    figure.tight_layout()
    return figure
