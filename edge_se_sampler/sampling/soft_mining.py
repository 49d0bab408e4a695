"""Soft Mining (Kheradmand et al. 2024, "Accelerating Neural Field Training via Soft Mining", arXiv 2312.00075; code:
github.com/ubc-vision/nf-soft-mining, examples/datasets/lmc.py and train_ngp_nerf_prop.py).

q   error at a pixel, which its density shall be proportional to
x   a walker's position as a share of its image's rows and columns

A step's pixels are those that walkers stand on. First they move, by Langevin's step: x += b^2/2 grad(log q) + b N(0, 1)
with b = 0.02. Then a tenth, always the same walkers, is drawn anew uniformly, but the tenth with the smallest errors
(and all whose error is as small), and who left the image, from Sobel edges. The loss is weighted by q^-r, but at most
by the weights' mean + standard deviation; r = min(step / 1000, alpha), alpha being `soft_mining_alpha`.

Decided here, for a sampler sees errors and no gradients: q is the root of the mean squared error of the channels (the
code weights by the mean absolute one); grad(log q) is the central difference in a map, 64 x 64 cells an image, each the
mean of its previous value and of the q found last, no less than MIN_ERROR; the code has the gradient of a pixel's own
loss, times 20 and over the number of rays in place of b^2/2. Weights are by the map's q before the step, over the mean
of the step's pixels.
A walker that is drawn anew may get another of the batch's images (the code leaves it its own), so that images with
larger errors have more of them; with one image a step, each image has its own walkers. Who comes onto a masked pixel
has left the image. A process of a distributed run has its own walkers. p/u is the density aimed at, not the walk's: a
tenth uniform, the rest in proportion to q within the image.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.sampling.cells import MIN_VALUE, CellTable, cell_means
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.learned import LearnedDistribution
from edge_se_sampler.sampling.parts import PixelBatch, PixelSource, TrainingStep
from edge_se_sampler.sampling.random_streams import Stream, stream
from edge_se_sampler.sampling.settings import SamplingSettings
from edge_se_sampler.sampling.strategies import Edge

SIDE, NOISE, SHARE, WARMUP_STEPS, EDGE_FLOOR = 64, 0.02, 0.1, 1000, 1e-5
MIN_ERROR = 2.0**-10
"""The least q of gradients and weights: the smallest step of a half-precision number at 1."""


class SoftMining(LearnedDistribution):
    """Pixels that walk towards larger errors."""

    name = "soft-mining"

    def __init__(self, settings: SamplingSettings) -> None:
        super().__init__(settings, SIDE)  # its values stay 1: it draws the uniform tenth
        self.map = np.zeros(0)  # q by cell; 0: unknown
        self.walkers: dict[int, np.ndarray] = {}  # by image in the table, -1 for all: (n, 4) image, x, q
        self._walking = -1

    def clear(self) -> None:
        """Give back the memory of the edges' table."""
        super().clear()
        self.edges = Edge(replace(self.settings, edge_epsilon=EDGE_FLOOR))

    def tables(self, batch: ImageBatch) -> tuple[CellTable, Tensor]:
        """The uniform table, and the index of each image in it."""
        cells, index = super().tables(batch)
        if grown := len(cells.values) - len(self.map):
            self.map = np.append(self.map, np.zeros(grown))
        return cells, index

    def drawable(self, batch: ImageBatch) -> tuple[PixelSource, Tensor, Tensor]:
        """As `Distribution`; and InputError where there are no edges to begin from."""
        self.edges.tables(batch)
        return super().drawable(batch)

    def draw(self, batch: ImageBatch, count: int, step: TrainingStep) -> PixelBatch:
        """Move the walkers, and return the pixels that they stand on."""
        _, table_index, drawable = self.drawable(batch)
        cells = self.cells
        self._walking = -1
        if self.settings.images_per_step == "one":
            choice = stream(step.seed, step.number, Stream.PIXELS).integers(len(drawable), size=1)
            drawable = drawable[choice]
            self._walking = int(table_index[drawable])
        images = table_index[drawable].numpy()
        walkers = self.walkers.get(self._walking, np.zeros((0, 4)))
        walkers = walkers[np.isin(walkers[:, 0], images)][:count]
        walkers = np.concatenate((walkers, np.full((count - len(walkers), 4), np.nan)))
        rng = stream(step.seed, step.number, Stream.SELECTION, step.rank)
        walkers = self.walkers[self._walking] = self._move(walkers, batch, drawable, images, rng)
        position = np.zeros(len(cells), dtype=np.int64)
        position[images] = drawable.numpy()
        image = walkers[:, 0].astype(np.int64)
        pixels = np.column_stack((position[image], cells.pixel_at(image, walkers[:, 1:3])))
        weight = self._loss_weight(cells.cell_of(image, pixels[:, 1:]), step.number)
        return PixelBatch(batch, torch.from_numpy(pixels), self, loss_weight=weight)

    def _move(
        self, walkers: np.ndarray, batch: ImageBatch, drawable: Tensor, images: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """Walkers (n, 4) after a step; nan: new ones, which are drawn uniformly."""
        count, new, cells = len(walkers), np.isnan(walkers[:, 0]), self.cells
        anew = int(SHARE * count)
        image, x = np.where(new, 0, walkers[:, 0]).astype(np.int64), np.where(new[:, None], 0, walkers[:, 1:3])
        x = x + NOISE**2 / 2 * self._gradient(image, x) + NOISE * rng.standard_normal(x.shape)
        left = ~((x >= 0) & (x < 1)).all(axis=1) | ~cells.valid(image, cells.pixel_at(image, x))
        restarted = (left | (walkers[:, 3] <= np.partition(walkers[:, 3], anew)[anew])) & ~new
        uniform = new | (np.arange(count) >= count - anew) & ~restarted
        moved = np.column_stack((image, x, walkers[:, 3]))
        edges, edge_index = self.edges.tables(batch)
        for rows, source, index in (uniform, cells, torch.from_numpy(images)), (restarted, edges, edge_index[drawable]):
            drawn = source.draw(index, int(rows.sum()), rng).numpy()
            moved[rows, 0] = image = images[drawn[:, 0]]
            moved[rows, 1:3] = (drawn[:, 1:] + 0.5) / cells.size[image]
        return moved

    def _gradient(self, image: np.ndarray, x: np.ndarray) -> np.ndarray:
        """(n, 2) grad(log q) at positions (n, 2) in images (n,); 0 where a neighbor's q is unknown."""
        cells, gradient = self.cells, np.zeros_like(x)
        grid = cells.grid[image]
        at = cells.pixel_at(image, x) * grid // cells.size[image]
        for axis in range(2):
            low, high = at.copy(), at.copy()
            low[:, axis], high[:, axis] = np.maximum(at[:, axis] - 1, 0), np.minimum(at[:, axis] + 1, grid[:, axis] - 1)
            before, after = (self.map[cells.first[image] + c[:, 0] * grid[:, 1] + c[:, 1]] for c in (low, high))
            known = (before > 0) & (after > 0)
            before, after = np.maximum(before, MIN_ERROR), np.maximum(after, MIN_ERROR)
            distance = (high - low)[known, axis] / grid[known, axis]  # 0 where there is one cell, and no difference
            gradient[known, axis] = np.log(after[known] / before[known]) / np.maximum(distance, 1e-9)
        return gradient

    def _loss_weight(self, cell: np.ndarray, number: int) -> Tensor | None:
        """(n,) weights of pixels in these cells."""
        if not self.settings.soft_mining_alpha:
            return None
        q = self.map[cell]
        mean = q[q > 0].mean() if (q > 0).any() else 1.0
        q = np.maximum(np.where(q > 0, q, mean), MIN_ERROR)
        weight = (q / mean) ** -min(number / WARMUP_STEPS, self.settings.soft_mining_alpha)
        return torch.from_numpy(np.minimum(weight, weight.mean() + weight.std())).float()

    def update(self, drawn: PixelBatch, squared_error: Tensor, step: TrainingStep) -> None:
        """Enter errors into the map, and give each walker its own."""
        _, index = self.tables(drawn.batch)
        q = np.sqrt(squared_error.cpu().double().numpy() / 3)
        cells, found = cell_means(self.cells.cells_at(index, drawn.pixels), np.maximum(q, MIN_VALUE))
        self.map[cells] = np.where(self.map[cells] > 0, (self.map[cells] + found) / 2, found)
        if drawn.distribution is self:
            self.walkers[self._walking][:, 3] = q

    def density_ratio(self, batch: ImageBatch, pixels: Tensor) -> Tensor:
        """(n,) the p/u that the walk aims at."""
        cells, index = self.tables(batch)
        known = np.add.reduceat(cells.counts * (self.map > 0), cells.first[:-1])
        mean = np.add.reduceat(cells.counts * self.map, cells.first[:-1]) / np.maximum(known, 1)
        image, q = index.numpy()[pixels[:, 0].numpy()], self.map[cells.cells_at(index, pixels)]
        return torch.from_numpy(SHARE + (1 - SHARE) * np.where(q > 0, q / np.maximum(mean[image], MIN_VALUE), 1.0))

    def state_dict(self) -> dict[str, Any]:
        """The map and the walkers."""
        walkers = {number: torch.tensor(rows) for number, rows in self.walkers.items()}
        return {**super().state_dict(), "map": torch.tensor(self.map), "walkers": walkers}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        super().load_state_dict(state)
        self.map = state["map"].numpy().copy()
        self.walkers = {number: rows.numpy().copy() for number, rows in state["walkers"].items()}
