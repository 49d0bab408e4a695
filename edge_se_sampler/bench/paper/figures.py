"""The paper's figures 2, 5 and 6 redrawn from runs, and a sheet with a rendering of every trial of its tables.

A folder of views holds the first test view as every trial renders it, TRIAL.png, and of every scene the first view of
each split, PLACEMENT-SCENE-{train,test}.png.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import imageio.v3 as iio
import numpy as np

from edge_se_sampler.bench.outcomes import failed
from edge_se_sampler.bench.paper.published import SCENES
from edge_se_sampler.bench.paper.trials import PAPER_TABLES, TABLES, Trial
from edge_se_sampler.bench.runner import Run
from edge_se_sampler.bench.strategies import LABELS
from edge_se_sampler.engine.figures import require_pyplot, save_figure
from edge_se_sampler.engine.metrics import composite_on, edge_band
from edge_se_sampler.sampling.edges import edge_strength, unit_float

COLORS = {"vanilla-nerf": "#1f77b4", "precrop-nerf": "#ff7f0e", "edge-nerf": "#2ca02c"}
"""The paper's."""
FAILED = "#d62728"
CROP = 5 / 16
"""Side of a magnified crop, as a share of the image's."""


@dataclass(frozen=True)
class RunsAndViews:
    """What the pictures are drawn from."""

    runs: list[Run]
    views: Path

    @property
    def seeds(self) -> list[int]:
        """In order; most pictures show the first."""
        return sorted({run["seed"] for run in self.runs})

    def of(self, table: int, scene: str, strategy: str) -> list[Run]:
        """The runs of all seeds, in order."""
        return [run for run in self.runs if (run["table"], run["scene"], run["strategy"]) == (table, scene, strategy)]

    def find(self, table: int, scene: str, strategy: str, seed: int | None = None) -> Run | None:
        """A trial's run, if there is one; of the first seed, unless another is named."""
        seed = self.seeds[0] if seed is None else seed
        return next((run for run in self.of(table, scene, strategy) if run["seed"] == seed), None)

    def rendering(self, table: int, scene: str, strategy: str, seed: int | None = None) -> np.ndarray:
        """(H, W, 3) in [0, 1]; FileNotFoundError where it was not kept."""
        seed = self.seeds[0] if seed is None else seed
        return unit_float(iio.imread(self.views / f"{Trial(table, scene, strategy, seed).name}.png"))

    def example(self, table: int, scene: str, split: str = "test") -> np.ndarray:
        """(H, W, 3|4) in [0, 1]: a split's first view as the table's trials see it."""
        return unit_float(iio.imread(self.views / f"{TABLES[table].placement}-{scene}-{split}.png"))


def draw_figures(data: RunsAndViews, folder: Path) -> None:
    """Draw every picture of which all runs and renderings are there; leave the others as they are.

    Raises:
        InputError: matplotlib is missing, or a file cannot be written.
    """
    for name, draw in {"sheet": _sheet, "figure-2": _figure_2, "figure-5": _figure_5, "figure-6": _figure_6}.items():
        with suppress(FileNotFoundError):
            figure = draw(data) if data.runs else None
            if figure is not None:
                save_figure(figure, folder / f"{name}.png")


def _show(axis: Any, image: np.ndarray | None, frame: str | None = None, **options: Any) -> None:
    axis.set(xticks=[], yticks=[])
    for spine in axis.spines.values():
        spine.set(visible=frame is not None, color=frame, linewidth=2)
    if image is not None:
        axis.imshow(image, interpolation="nearest", **options)


def _outline(axis: Any, window: tuple[slice, slice]) -> None:
    """A red rectangle around a window's pixels."""
    (top, bottom), (left, right) = ((part.start - 0.5, part.stop - 0.5) for part in window)
    axis.plot([left, right, right, left, left], [top, top, bottom, bottom, top], color=FAILED, lw=1.5)


def _sheet(data: RunsAndViews) -> Any:
    """The renderings of tables 1 to 4; a failed training has a red frame."""
    scenes = [scene for scene in SCENES if any(run["scene"] == scene for run in data.runs)]
    tables = [number for number in PAPER_TABLES if any(run["table"] == number for run in data.runs)]
    if not tables:
        return None
    width, height = 0.62 * len(scenes) + 1.3, 0.62 * (len(LABELS) + 1) + 0.6
    figure = require_pyplot().figure(figsize=(width * min(2, len(tables)), height * -(-len(tables) // 2)))
    parts = np.ravel(figure.subfigures(-(-len(tables) // 2), min(2, len(tables)), squeeze=False))
    for part, number in zip(parts, tables, strict=False):
        part.suptitle(f"Table {number}: {TABLES[number].title}", fontsize=10)
        axes = part.subplots(
            len(LABELS) + 1, len(scenes), squeeze=False,
            gridspec_kw={"left": 0.2, "right": 0.99, "bottom": 0.01, "top": 0.88, "wspace": 0.06, "hspace": 0.06},
        )  # fmt: skip
        for column, scene in zip(axes.T, scenes, strict=True):
            column[0].set_title(scene, fontsize=8, pad=3)
            _show(column[0], composite_on(data.example(number, scene)))
            for axis, strategy in zip(column[1:], LABELS, strict=True):
                run = data.find(number, scene, strategy)
                picture = None if run is None else data.rendering(number, scene, strategy)
                _show(axis, picture, FAILED if run is not None and failed(run) else None)
        for axis, label in zip(axes[:, 0], ("ground truth", *LABELS.values()), strict=True):
            axis.set_ylabel(label, rotation=0, ha="right", va="center", fontsize=8)
    return figure


def _figure_2(data: RunsAndViews) -> Any:
    """What Precrop's window shows of a centred and of an off-centre object, and what each seed comes to."""
    scenes = [scene for scene in ("mic", "drums") if all(data.find(table, scene, "precrop-nerf") for table in (1, 2))]
    if not scenes:
        return None
    titles = {1: "centred", 16: "as small, centred", 2: "off centre"}
    tables = [table for table in titles if all(data.find(table, scene, "precrop-nerf") for scene in scenes)]
    columns, seeds = [(scene, table) for scene in scenes for table in tables], data.seeds[:3]
    figure, axes = require_pyplot().subplots(
        1 + len(seeds), len(columns), figsize=(2.0 * len(columns), 2.3 * (1 + len(seeds))), squeeze=False
    )
    for column, (scene, table) in zip(axes.T, columns, strict=True):
        image = data.example(table, scene, "train")
        height, width = image.shape[:2]
        window = (slice(height // 4, 3 * height // 4), slice(width // 4, 3 * width // 4))
        _show(column[0], composite_on(image))
        _outline(column[0], window)
        column[0].set_title(f"{scene}, {titles[table]}", fontsize=9)
        if image.shape[2] == 4:
            column[0].set_xlabel(f"{(image[(*window, 3)] > 0).mean():.0%} of the window is object", fontsize=8)
        for axis, seed in zip(column[1:], seeds, strict=True):
            run = data.find(table, scene, "precrop-nerf", seed)
            picture = None if run is None else data.rendering(table, scene, "precrop-nerf", seed)
            _show(axis, picture, None if run is None else FAILED if failed(run) else "#cccccc")
            if run is not None:
                axis.set_xlabel(f"{run['psnr']:.2f} dB (background {run['background_psnr']:.2f})", fontsize=8)
    for axis, label in zip(axes[:, 0], ("a training view", *(f"Precrop, seed {seed}" for seed in seeds)), strict=True):
        axis.set_ylabel(label, fontsize=9)
    figure.tight_layout()
    return figure


def _figure_5(data: RunsAndViews) -> Any:
    """Training losses of Random, Precrop and Edge, a line for each seed; a collapsed run stays at its first loss."""
    tables = [number for number in (1, 2) if any(run["table"] == number for run in data.runs)]
    scenes = [s for s in ("chair", "ficus") if all(data.find(t, s, "vanilla-nerf") for t in tables)]
    if not tables or not scenes:
        return None
    figure, axes = require_pyplot().subplots(
        len(tables), len(scenes), figsize=(4.6 * len(scenes), 2.9 * len(tables)), squeeze=False, sharex=True
    )
    for row, table in zip(axes, tables, strict=True):
        for axis, scene in zip(row, scenes, strict=True):
            steps = np.zeros(1)
            for strategy, color in COLORS.items():
                for i, run in enumerate(data.of(table, scene, strategy)):
                    losses = _running_median(np.array(run["loss"]))
                    steps = run["loss_every"] * np.arange(len(losses))
                    axis.plot(steps, losses, color=color, lw=1, alpha=0.8, label=LABELS[strategy] if i == 0 else None)
            axis.axvline(steps[-1] / 10, color="black", ls=":", lw=1)
            axis.set(yscale="log", title=f"{scene}, {'centred' if table == 1 else 'off centre'}")
            axis.title.set_fontsize(10)
            axis.grid(alpha=0.25)
            axis.spines[["top", "right"]].set_visible(False)
    for axis in axes[-1]:
        axis.set_xlabel("iterations (dotted: the early phase ends)")
    for axis in axes[:, 0]:
        axis.set_ylabel("training loss")
    axes[0, -1].legend(frameon=False, fontsize=8)
    figure.tight_layout()
    return figure


def _running_median(values: np.ndarray, reach: int = 3) -> np.ndarray:
    """Over seven steps: every step trains on one image, and images differ."""
    padded = np.pad(values, reach, constant_values=np.nan)
    return np.nanmedian(np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1), axis=1)


def _figure_6(data: RunsAndViews) -> Any:
    """Where Precrop and Edge err near edges, centred: renderings, errors in the edge band, crops."""
    strategies = ("precrop-nerf", "edge-nerf")
    scenes = [scene for scene in ("chair", "drums") if all(data.find(1, scene, name) for name in strategies)]
    if not scenes:
        return None
    figure, axes = require_pyplot().subplots(2 * len(scenes), 4, figsize=(9.2, 4.8 * len(scenes)))
    for (top, bottom), scene in zip(axes.reshape(len(scenes), 2, 4), scenes, strict=True):
        truth = composite_on(data.example(1, scene))
        band, window = edge_band(truth), _find_busiest_window(truth)
        renderings = {name: data.rendering(1, scene, name) for name in strategies}
        titles = [f"{scene}: ground truth", *(LABELS[name] for name in strategies)]
        for axis, title, picture in zip(top, titles, (truth, *renderings.values()), strict=False):
            _show(axis, picture)
            axis.set_title(title, fontsize=9)
            _outline(axis, window)
        _show(top[3], np.where(band, 0.0, 1.0), cmap="gray", vmin=0, vmax=1)
        top[3].set_title("edge band", fontsize=9)
        errors = {name: ((picture - truth) ** 2).mean(axis=2) for name, picture in renderings.items()}
        largest = max(float(np.quantile(error[band], 0.98)) for error in errors.values())
        for axis, crop_axis, name in zip(bottom[:2], bottom[2:], strategies, strict=True):
            _show(axis, np.where(band, errors[name], 0), cmap="magma", vmin=0, vmax=largest)
            mean = np.mean([10 ** (-run["edge_band_psnr"] / 10) for run in data.of(1, scene, name)])
            axis.set_title(f"{LABELS[name]}: error in the band", fontsize=9)
            axis.set_xlabel(f"MSE {errors[name][band].mean():.5f} here,\n{mean:.5f} over views and seeds", fontsize=8)
            _show(crop_axis, np.clip(renderings[name][window], 0, 1))
            crop_axis.set_title(f"{LABELS[name]}, the crop", fontsize=9)
    figure.tight_layout()
    return figure


def _find_busiest_window(image: np.ndarray) -> tuple[slice, slice]:
    """The square with the most edge in it, (rows, columns)."""
    side = int(CROP * min(image.shape[:2]))
    total = cv2.boxFilter(edge_strength(image), -1, (side, side), anchor=(0, 0), normalize=False)
    total = total[: image.shape[0] - side + 1, : image.shape[1] - side + 1]
    top, left = (int(i) for i in np.unravel_index(total.argmax(), total.shape))
    return slice(top, top + side), slice(left, left + side)
