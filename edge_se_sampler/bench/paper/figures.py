"""The paper's figures 2, 5 and 6 remade from runs, and a sheet of what every cell of its tables looks like.

Every renderer was asked for the same held-out view, the first; `views` holds it as each cell rendered it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import imageio.v3 as iio
import numpy as np

from edge_se_sampler.bench.paper.published import LABELS, SCENES, STRATEGIES
from edge_se_sampler.bench.paper.trials import PAPERS, TABLES, Cell
from edge_se_sampler.bench.paper.verdicts import LABEL, failed
from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.figures import require_pyplot, save_figure
from edge_se_sampler.engine.metrics import edge_band
from edge_se_sampler.sampling.edges import edge_strength, unit_float

COLORS = {"vanilla-nerf": "#1f77b4", "precrop-nerf": "#ff7f0e", "edge-nerf": "#2ca02c"}
"""The paper's."""
FAILED = "#d62728"
CROP = 5 / 16
"""A crop's side, as a share of the image's."""


@dataclass(frozen=True)
class Experiment:
    """What the pictures are drawn from."""

    runs: list[dict[str, Any]]
    data_of: Callable[[Cell], Path]
    views: Path

    @property
    def seeds(self) -> list[int]:
        """In order; views are shown of the first."""
        return sorted({run["seed"] for run in self.runs})

    def run(self, table: int, scene: str, strategy: str, seed: int | None = None) -> dict[str, Any] | None:
        """A cell's run, if there is one."""
        seed = self.seeds[0] if seed is None else seed
        place = {"table": table, "scene": scene, "strategy": strategy, "seed": seed}
        return next((run for run in self.runs if all(run[key] == value for key, value in place.items())), None)

    def rendering(self, table: int, scene: str, strategy: str, seed: int | None = None) -> np.ndarray | None:
        """(H, W, 3) in [0, 1], if it was kept."""
        seed = self.seeds[0] if seed is None else seed
        path = self.views / f"{Cell(table, scene, strategy, seed).name}.png"
        return unit_float(iio.imread(path)) if path.exists() else None

    def images(self, table: int, scene: str, split: Any = "test") -> Views:
        """The scene as the table's cells saw it."""
        return read_blender(self.data_of(Cell(table, scene, "edge-nerf", 0)), split)

    def truth(self, table: int, scene: str) -> np.ndarray:
        """(H, W, 3): the first held-out view on white."""
        return _on_white(self.images(table, scene).images[0])


def draw_figures(experiment: Experiment, folder: Path) -> list[Path]:
    """Draw what the runs suffice for, as PNG in `folder`.

    Raises:
        InputError: matplotlib is missing, or a file cannot be written.
    """
    drawn = []
    for name, draw in {"sheet": _sheet, "figure-2": _figure_2, "figure-5": _figure_5, "figure-6": _figure_6}.items():
        figure = draw(experiment)
        if figure is not None:
            drawn.append(folder / f"{name}.png")
            save_figure(figure, drawn[-1])
    return drawn


def _on_white(image: np.ndarray) -> np.ndarray:
    image = unit_float(image)
    return image if image.shape[2] == 3 else image[..., :3] * image[..., 3:] + 1 - image[..., 3:]


def _show(axis: Any, image: np.ndarray | None, frame: str | None = None, **more: Any) -> None:
    axis.set(xticks=[], yticks=[])
    for spine in axis.spines.values():
        spine.set(visible=frame is not None, color=frame, linewidth=2)
    if image is not None:
        axis.imshow(image, interpolation="nearest", **more)


def _outline(axis: Any, window: tuple[slice, slice]) -> None:
    """A red rectangle around a window's pixels."""
    (top, bottom), (left, right) = ((part.start - 0.5, part.stop - 0.5) for part in window)
    axis.plot([left, right, right, left, left], [top, top, bottom, bottom, top], color=FAILED, lw=1.5)


def _sheet(experiment: Experiment) -> Any:
    """Tables 1 to 4 in pictures: what failed has a red frame."""
    scenes = [scene for scene in SCENES if any(run["scene"] == scene for run in experiment.runs)]
    tables = [number for number in PAPERS if any(run["table"] == number for run in experiment.runs)]
    if not tables:
        return None
    width, height = 0.62 * len(scenes) + 1.3, 0.62 * (len(STRATEGIES) + 1) + 0.6
    figure = require_pyplot().figure(figsize=(width * min(2, len(tables)), height * -(-len(tables) // 2)))
    parts = np.ravel(figure.subfigures(-(-len(tables) // 2), min(2, len(tables)), squeeze=False))
    for part, number in zip(parts, tables, strict=False):
        part.suptitle(f"Table {number}: {TABLES[number].title}", fontsize=10)
        axes = part.subplots(
            len(STRATEGIES) + 1, len(scenes), squeeze=False,
            gridspec_kw={"left": 0.2, "right": 0.99, "bottom": 0.01, "top": 0.88, "wspace": 0.06, "hspace": 0.06},
        )  # fmt: skip
        for column, scene in zip(axes.T, scenes, strict=True):
            column[0].set_title(scene, fontsize=8, pad=3)
            _show(column[0], experiment.truth(number, scene))
            for axis, strategy in zip(column[1:], STRATEGIES, strict=True):
                run = experiment.run(number, scene, strategy)
                frame = FAILED if run is not None and failed(run) else None
                _show(axis, experiment.rendering(number, scene, strategy), frame)
        for axis, label in zip(axes[:, 0], ("truth", *LABELS), strict=True):
            axis.set_ylabel(label, rotation=0, ha="right", va="center", fontsize=8)
    return figure


def _figure_2(experiment: Experiment) -> Any:
    """What Precrop's window sees of a centred and of an off-centre object, and what it comes to, seed by seed."""
    scenes = [s for s in ("mic", "drums") if all(experiment.run(t, s, "precrop-nerf") for t in (1, 2))]
    if not scenes:
        return None
    tables = [t for t in (1, 16, 2) if all(experiment.run(t, s, "precrop-nerf") for s in scenes)]
    places, seeds = [(scene, table) for scene in scenes for table in tables], experiment.seeds[:3]
    figure, axes = require_pyplot().subplots(
        1 + len(seeds), len(places), figsize=(2.0 * len(places), 2.3 * (1 + len(seeds))), squeeze=False
    )
    titles = {1: "centred", 16: "smaller, in the middle", 2: "as small, off centre"}
    for column, (scene, table) in zip(axes.T, places, strict=True):
        image = unit_float(experiment.images(table, scene, "train").images[0])
        height, width = image.shape[:2]
        window = (slice(height // 4, 3 * height // 4), slice(width // 4, 3 * width // 4))
        _show(column[0], _on_white(image))
        _outline(column[0], window)
        column[0].set_title(f"{scene}, {titles[table]}", fontsize=9)
        if image.shape[2] == 4:
            column[0].set_xlabel(f"{(image[(*window, 3)] > 0).mean():.0%} of the window is object", fontsize=8)
        for axis, seed in zip(column[1:], seeds, strict=True):
            run = experiment.run(table, scene, "precrop-nerf", seed)
            if run is not None:
                picture = experiment.rendering(table, scene, "precrop-nerf", seed)
                _show(axis, picture, FAILED if failed(run) else "#cccccc")
                axis.set_xlabel(f"{run['psnr']:.2f} dB (background {run['background_psnr']:.2f})", fontsize=8)
    for axis, label in zip(axes[:, 0], ("a training view", *(f"Precrop, seed {seed}" for seed in seeds)), strict=True):
        axis.set_ylabel(label, fontsize=9)
    figure.tight_layout()
    return figure


def _figure_5(experiment: Experiment) -> Any:
    """Training losses of Random, Precrop and Edge, every seed a line; a collapsed run stays where it began."""
    tables = [number for number in (1, 2) if any(run["table"] == number for run in experiment.runs)]
    scenes = [s for s in ("chair", "ficus") if all(experiment.run(t, s, "vanilla-nerf") for t in tables)]
    if not tables or not scenes:
        return None
    figure, axes = require_pyplot().subplots(
        len(tables), len(scenes), figsize=(4.6 * len(scenes), 2.9 * len(tables)), squeeze=False, sharex=True
    )
    for row, table in zip(axes, tables, strict=True):
        for axis, scene in zip(row, scenes, strict=True):
            steps = np.zeros(1)
            for strategy, color in COLORS.items():
                mine = [
                    r for r in experiment.runs if (r["table"], r["scene"], r["strategy"]) == (table, scene, strategy)
                ]
                for i, run in enumerate(mine):
                    losses = _median_of_neighbours(np.array(run["loss"]))
                    steps = run["loss_every"] * np.arange(len(losses))
                    axis.plot(steps, losses, color=color, lw=1, alpha=0.8, label=LABEL[strategy] if i == 0 else None)
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


def _median_of_neighbours(values: np.ndarray, reach: int = 3) -> np.ndarray:
    """A step trains on one image, and images differ: the middle of seven steps."""
    padded = np.pad(values, reach, constant_values=np.nan)
    return np.nanmedian(np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1), axis=1)


def _figure_6(experiment: Experiment) -> Any:
    """Where Precrop and Edge err near edges, centred: renderings, error maps in the edge band, crops."""
    arms = ("precrop-nerf", "edge-nerf")
    scenes = [s for s in ("chair", "drums") if all(experiment.rendering(1, s, a) is not None for a in arms)]
    if not scenes:
        return None
    figure, axes = require_pyplot().subplots(2 * len(scenes), 4, figsize=(9.2, 4.8 * len(scenes)))
    for rows, scene in zip(axes.reshape(len(scenes), 2, 4), scenes, strict=True):
        truth = experiment.truth(1, scene)
        band, window = edge_band(truth), _busiest(truth)
        pictures = {"truth": truth} | {LABEL[arm]: _there(experiment.rendering(1, scene, arm)) for arm in arms}
        for axis, (label, picture) in zip(rows[0], pictures.items(), strict=False):
            _show(axis, picture)
            axis.set_title(f"{scene}: {label}" if axis is rows[0][0] else label, fontsize=9)
            _outline(axis, window)
        _show(rows[0][3], np.where(band, 0.0, 1.0), cmap="gray", vmin=0, vmax=1)
        rows[0][3].set_title("edge band", fontsize=9)
        errors = {a: ((pictures[LABEL[a]] - truth) ** 2).mean(axis=2) for a in arms}
        largest = max(float(np.quantile(error[band], 0.98)) for error in errors.values())
        for axis, arm in zip(rows[1], arms, strict=False):
            _show(axis, np.where(band, errors[arm], 0), cmap="magma", vmin=0, vmax=largest)
            mine = [run for run in experiment.runs if (run["table"], run["scene"], run["strategy"]) == (1, scene, arm)]
            every = np.mean([10 ** (-run["edge_band_psnr"] / 10) for run in mine])
            axis.set_title(f"{LABEL[arm]}: error in the band", fontsize=9)
            axis.set_xlabel(f"MSE {errors[arm][band].mean():.5f} here,\n{every:.5f} over views and seeds", fontsize=8)
        for axis, label in zip(rows[1][2:], (LABEL[arm] for arm in arms), strict=True):
            _show(axis, np.clip(pictures[label][window], 0, 1))
            axis.set_title(f"{label}, the crop", fontsize=9)
    figure.tight_layout()
    return figure


def _there(picture: np.ndarray | None) -> np.ndarray:
    assert picture is not None
    return picture


def _busiest(image: np.ndarray) -> tuple[slice, slice]:
    """The square with the most edge in it, (rows, columns)."""
    side = int(CROP * min(image.shape[:2]))
    total = cv2.boxFilter(edge_strength(image), -1, (side, side), anchor=(0, 0), normalize=False)
    total = total[: image.shape[0] - side + 1, : image.shape[1] - side + 1]
    top, left = (int(i) for i in np.unravel_index(total.argmax(), total.shape))
    return slice(top, top + side), slice(left, left + side)
