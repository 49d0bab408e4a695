"""ActRay (Wu et al. 2023, "ActRay: Online Active Ray Sampling for Radiance Fields", SIGGRAPH Asia; code:
github.com/pku-netvideo/actray, actray_pixel_samplers.py and actray_pipeline.py).

L    estimated loss of a cell: the squared error found there, a mean over the channels
s    similarity of the pixel at which an error was found to the one that it stands for: 1 at the pixel itself, else
     1 - the distance of their colors, or 0 if that is less than 0.7
l    L s, and u = l / s
t    steps since a pixel of the cell was drawn

An error E found at a pixel is passed on to others: l <- (l s + E s'^2) / (s + s'), s <- (s^2 + s'^2) / (s + s'), with
their similarity s'. Pixels are drawn in proportion to the upper confidence bound u exp(k min(t, median t)), with
exp(k median t) = max u / (2 median u). Before, it explores: only cells without an estimate are drawn, until a step's
errors reach 3.5 times fewer new cells a pixel than in the best step; those left get the mean. Where a step draws from
one image, each image is explored by itself.

Decided here, for a sampler sees errors and no geometry: errors are passed on to the eight neighboring cells, 64 x 64 an
image, in place of the pixels of other images that show the same point; a cell has its central pixel's color. k is at
least 0. Probabilities are computed anew every 5 steps (the code draws pixels for 5 steps at once), and drawn from with
replacement, from all images together, or within the step's image. Left out: the 300 uniform steps at the beginning,
which are the early phase's to give, and that transparent pixels are not drawn at first, which takes backgrounds of
random color.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.sampling.cells import CellTable, cell_means
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.learned import LearnedDistribution
from edge_se_sampler.sampling.parts import PixelBatch, TrainingStep
from edge_se_sampler.sampling.settings import SamplingSettings

SIDE, REFRESH_STEPS, MIN_SIMILARITY, YIELD_DROP = 64, 5, 0.7, 3.5
UNKNOWN = 1e10
"""Value of cells without an estimate while they are explored: no other is drawn."""
NEIGHBORS = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1) if (down, right) != (0, 0)]


class ActRay(LearnedDistribution):
    """In proportion to estimated losses, the longer unseen the more."""

    name = "actray"

    def __init__(self, settings: SamplingSettings) -> None:
        super().__init__(settings, SIDE, across_images=settings.images_per_step == "all")
        self.l, self.s = np.zeros(0), np.zeros(0)  # by cell; s is 0 without an estimate
        self.drawn_at = np.zeros(0)  # the clock then
        self.colors = np.zeros((0, 3), dtype=np.float32)
        self.clock = 0
        self.exploring, self.best_yield = np.ones(self._num_groups, dtype=bool), np.zeros(self._num_groups)  # by group
        self._colored: set[int] = set()  # images

    def tables(self, batch: ImageBatch) -> tuple[CellTable, Tensor]:
        """The cells, and the index of each image among them."""
        cells, index = super().tables(batch)
        if grown := len(cells.values) - len(self.l):
            self.l, self.s, self.drawn_at = (np.append(a, np.zeros(grown)) for a in (self.l, self.s, self.drawn_at))
        if grown := self._num_groups - len(self.exploring):
            self.exploring = np.append(self.exploring, np.ones(grown, dtype=bool))
            self.best_yield = np.append(self.best_yield, np.zeros(grown))
        if grown := len(cells.values) - len(self.colors):
            self.colors = np.concatenate((self.colors, np.zeros((grown, 3), dtype=np.float32)))
        for k, image in enumerate(index.tolist()):
            if image not in self._colored:
                self._colored.add(image)
                centers = [((np.arange(c) + 0.5) * n / c).astype(int) for n, c in zip(*self._shape(image), strict=True)]
                colors = composite(batch.image(k)[np.ix_(*centers)], batch.background_color)
                self.colors[cells.first[image] :][: colors[..., 0].size] = colors.reshape(-1, 3)
        return cells, index

    @property
    def _num_groups(self) -> int:
        """Of images that are explored together."""
        return 1 if self.cells.across_images else len(self.cells)

    def _group_of(self, images: np.ndarray) -> np.ndarray:
        return np.zeros_like(images) if self.cells.across_images else images

    def _shape(self, image: int) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of an image's pixels, and of its cells."""
        return self.cells.size[image], self.cells.grid[image]

    def update(self, drawn: PixelBatch, squared_error: Tensor, step: TrainingStep) -> None:
        """Enter errors, pass them on, and compute the probabilities anew if it is time."""
        _, index = self.tables(drawn.batch)
        error = squared_error.cpu().double().numpy() / 3
        cell = self.cells.cells_at(index, drawn.pixels)
        self.clock += 1
        cells, found = cell_means(cell, error)
        self.l[cells], self.s[cells], self.drawn_at[cells] = found, 1.0, self.clock
        colors = composite(drawn.values["image"].cpu().numpy(), drawn.batch.background_color)
        image = index[drawn.pixels[:, 0]].numpy()
        reached, group = self._pass_on(image, cell, error, colors) / len(error), self._group_of(image)[0]
        self.best_yield[group] = max(self.best_yield[group], reached)
        self.exploring[group] &= reached * YIELD_DROP >= self.best_yield[group]
        if self.clock % REFRESH_STEPS == 0:
            self._refresh()

    def _pass_on(self, image: np.ndarray, cell: np.ndarray, error: np.ndarray, colors: np.ndarray) -> int:
        """Pass errors (n,) in cells (n,) of images (n,) on to cells of similar color, and count those without an
        estimate among them. Of several errors in a cell the last one counts."""
        reached, grid = 0, self.cells.grid[image]
        row, column = np.divmod(cell - self.cells.first[image], grid[:, 1])
        for down, right in NEIGHBORS:
            inside = (
                (row + down >= 0) & (row + down < grid[:, 0]) & (column + right >= 0) & (column + right < grid[:, 1])
            )
            to = np.where(inside, cell + down * grid[:, 1] + right, cell)
            similarity = 1 - np.linalg.norm(colors - self.colors[to], axis=1)
            passed = np.flatnonzero(inside & (similarity >= MIN_SIMILARITY) & (self.cells.counts[to] > 0))
            to, similarity = to[passed], similarity[passed]
            l, s = self.l[to], self.s[to]
            reached += len(np.unique(to[s == 0]))
            self.l[to] = (l * s + error[passed] * similarity**2) / (s + similarity)
            self.s[to] = (s**2 + similarity**2) / (s + similarity)
        return reached

    def _refresh(self) -> None:
        """Compute the cells' values."""
        known, there = self.s > 0, self.cells.counts > 0
        group = self._group_of(np.repeat(np.arange(len(self.cells)), np.diff(self.cells.first)))
        self.exploring &= np.bincount(group, there & ~known, self._num_groups) > 0
        explored = ~self.exploring[group]
        number = np.maximum(np.bincount(group, known), 1)
        for array in (self.l, self.s):
            mean = np.bincount(group, array * known) / number
            array[explored & ~known] = mean[group[explored & ~known]]
        u = self.l / np.maximum(self.s, 1e-8)
        bound = upper_bound(u, self.clock - self.drawn_at, there & explored)
        self.cells.values[:] = np.where(explored, bound, np.where(known, u, UNKNOWN))
        self.cells.refresh()

    def state_dict(self) -> dict[str, Any]:
        """The estimates, and how far it is; colors are read again."""
        arrays = {name: torch.tensor(getattr(self, name)) for name in ("l", "s", "drawn_at")}
        of_groups = {"exploring": self.exploring.tolist(), "best_yield": self.best_yield.tolist()}
        return {**super().state_dict(), **arrays, **of_groups, "clock": self.clock}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        super().load_state_dict(state)
        self.clock = state["clock"]
        self.l, self.s, self.drawn_at = (state[name].numpy().copy() for name in ("l", "s", "drawn_at"))
        self.exploring, self.best_yield = np.ones(self._num_groups, dtype=bool), np.zeros(self._num_groups)
        self.exploring[:], self.best_yield[:] = state["exploring"], state["best_yield"]  # once one value for all images


def upper_bound(u: np.ndarray, t: np.ndarray, there: np.ndarray) -> np.ndarray:
    """u exp(k min(t, median t)) of cells, the medians over those that are there and have an u above 0."""
    counted = there & (u > 0)
    if not counted.any():
        return u
    middle_t, ratio = np.median(t[counted]), u[counted].max() / np.median(u[counted])
    k = max(0.0, np.log(ratio / 2)) / middle_t if middle_t else 0.0
    return u * np.exp(k * np.minimum(t, middle_t))


def composite(pixels: np.ndarray, background: tuple[float, float, float]) -> np.ndarray:
    """(..., 3) colors in [0, 1] of pixels (..., 3|4), uint8 or float, in front of a background."""
    scale = np.float32(1 / 255) if pixels.dtype == np.uint8 else np.float32(1)
    pixels = pixels * scale
    if pixels.shape[-1] == 3:
        return pixels
    return pixels[..., 3:] * pixels[..., :3] + (1 - pixels[..., 3:]) * np.array(background, dtype=np.float32)
