"""The paper's figure 2 redrawn from runs, and a sheet with a rendering of every trial of its tables.

A folder of views holds the first test view as every trial renders it, TRIAL.png, and of every scene the first view of
each split, PLACEMENT-SCENE-{train,test}.png.
"""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from edge_se_sampler.bench.outcomes import failed
from edge_se_sampler.bench.paper.published import LABELS, REAL_SCENES, SCENES
from edge_se_sampler.bench.paper.trials import PAPER_TABLES, TABLES, Trial, runs_by_trial
from edge_se_sampler.bench.results import Run
from edge_se_sampler.engine.figures import require_pyplot, save_figure
from edge_se_sampler.engine.metrics import composite_on
from edge_se_sampler.sampling.edges import unit_float

FAILED = "#d62728"

Runs = dict[Trial, Run]


def draw_figures(runs: list[Run], views: Path, folder: Path) -> None:
    """Draw every picture of which all runs and renderings are there; leave the others as they are."""
    pictures = {"sheet": partial(_sheet, SCENES), "sheet-real": partial(_sheet, REAL_SCENES), "figure-2": _figure_2}
    for name, draw in pictures.items():
        with suppress(FileNotFoundError):
            figure = draw(runs_by_trial(runs), views)
            if figure is not None:
                save_figure(figure, folder / f"{name}.png")


def _read_view(views: Path, table: int, scene: str, split: str = "test") -> np.ndarray:
    """(H, W, 3|4) in [0, 1]: a split's first view as the table's trials see it."""
    return unit_float(iio.imread(views / f"{TABLES[table].placement}-{scene}-{split}.png"))


def _show(axis: Any, image: np.ndarray | None, frame: str | None = None) -> None:
    axis.set(xticks=[], yticks=[])
    for spine in axis.spines.values():
        spine.set(visible=frame is not None, color=frame, linewidth=2)
    if image is not None:
        axis.imshow(image, interpolation="nearest")


def _show_rendering(axis: Any, runs: Runs, trial: Trial, views: Path, frame: str | None = None) -> None:
    """A trial's rendering, framed red if it failed; without a run, nothing."""
    run = runs.get(trial)
    image = None if run is None else iio.imread(views / f"{trial.name}.png")
    _show(axis, image, FAILED if run and failed(run) else frame)


def _sheet(of: Collection[str], runs: Runs, views: Path) -> Any:
    """The renderings of tables 1 to 4 on some scenes; a failed training has a red frame."""
    runs = {trial: run for trial, run in runs.items() if trial.scene in of and trial.table in PAPER_TABLES}
    scenes = [scene for scene in of if any(trial.scene == scene for trial in runs)]
    tables = [number for number in PAPER_TABLES if any(trial.table == number for trial in runs)]
    if not tables:
        return None
    seed = min(trial.seed for trial in runs)
    width, height = max(0.62 * len(scenes) + 1.3, 2.7), 0.62 * (len(LABELS) + 1) + 0.6
    rows, columns = -(-len(tables) // 2), min(2, len(tables))
    figure = require_pyplot().figure(figsize=(width * columns, height * rows))
    parts = np.ravel(figure.subfigures(rows, columns, squeeze=False))
    grid = {"left": 1.13 / width, "right": 0.99, "bottom": 0.01, "top": 0.88, "wspace": 0.06, "hspace": 0.06}
    for part, number in zip(parts, tables, strict=False):
        part.suptitle(f"Table {number}: {TABLES[number].title}", fontsize=10)
        axes = part.subplots(len(LABELS) + 1, len(scenes), squeeze=False, gridspec_kw=grid)
        for column, scene in zip(axes.T, scenes, strict=True):
            column[0].set_title(scene, fontsize=8, pad=3)
            _show(column[0], composite_on(_read_view(views, number, scene)))
            for axis, strategy in zip(column[1:], LABELS, strict=True):
                _show_rendering(axis, runs, Trial(number, scene, strategy, seed), views)
        for axis, label in zip(axes[:, 0], ("ground truth", *LABELS.values()), strict=True):
            axis.set_ylabel(label, rotation=0, ha="right", va="center", fontsize=8)
    return figure


def _figure_2(runs: Runs, views: Path) -> Any:
    """What Precrop's window shows of a centred and of an off-centre object, and what each seed comes to."""
    titles = {1: "centred", 16: "as small, centred", 2: "off centre"}
    seeds = sorted({trial.seed for trial in runs})[:3]
    first = [trial for trial in runs if (trial.strategy, trial.seed) == ("precrop-nerf", seeds[0])]
    scenes = [scene for scene in ("mic", "drums") if {*titles} <= {t.table for t in first if t.scene == scene}]
    if not scenes:
        return None
    columns = [*product(scenes, titles)]
    size = (2.0 * len(columns), 2.3 * (1 + len(seeds)))
    figure, axes = require_pyplot().subplots(1 + len(seeds), len(columns), figsize=size, squeeze=False)
    for column, (scene, table) in zip(axes.T, columns, strict=True):
        image = _read_view(views, table, scene, "train")
        height, width = image.shape[:2]
        top, bottom, left, right = height // 4, 3 * height // 4, width // 4, 3 * width // 4
        _show(column[0], composite_on(image))
        corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom], [left, top]]) - 0.5
        column[0].plot(*corners.T, color=FAILED, lw=1.5)
        column[0].set_title(f"{scene}, {titles[table]}", fontsize=9)
        object_share = (image[top:bottom, left:right, 3] > 0).mean()
        column[0].set_xlabel(f"{object_share:.0%} of the window is object", fontsize=8)
        for axis, seed in zip(column[1:], seeds, strict=True):
            trial = Trial(table, scene, "precrop-nerf", seed)
            _show_rendering(axis, runs, trial, views, frame="#cccccc")
            if run := runs.get(trial):
                axis.set_xlabel(f"{run['psnr']:.2f} dB (background {run['background_psnr']:.2f})", fontsize=8)
    for axis, label in zip(axes[:, 0], ("a training view", *(f"Precrop, seed {seed}" for seed in seeds)), strict=True):
        axis.set_ylabel(label, fontsize=9)
    figure.tight_layout()
    return figure
