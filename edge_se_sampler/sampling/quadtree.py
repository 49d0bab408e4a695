"""A quadtree of every image, subdivided where errors are large (Zhang et al. 2022, "Fast Learning Radiance Fields by
Shooting Much Fewer Rays", arXiv 2208.06821).

open     of the deepest level, and with a pixel that may be drawn: a leaf that may be subdivided
learnt   a leaf whose errors were small when those of its level were judged; it stays as it is
weight   of a leaf: how many pixels it can draw if it is open, at most LEARNT_PIXELS of them if it is learnt
c        color change around a pixel, at least CHANGE_FLOOR times its mean over the image

A leaf is drawn by its weight; half of its pixels are drawn uniformly, half in proportion to c, as in its code. Decided
here: a level is judged as soon as PIXELS_PER_LEAF pixels were drawn, on average, for each of its open leaves, where the
paper waits for epochs, which short trainings have none of, and a leaf that nobody has looked at stays open; by the
root mean squared error of a channel (the paper: an average error; its code: the largest); and trees stay to the end,
where the paper's last epoch takes all pixels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.sampling.edges import CHANGE_STEP, color_change
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.parts import Distribution, PixelBatch, TrainingStep
from edge_se_sampler.sampling.settings import SamplingSettings

START_LEVEL, MAX_LEVEL = 2, 5
SIDE = 2**MAX_LEVEL
"""Cells along a side of an image: the smallest leaves."""
PIXELS_PER_LEAF = 32
LEARNT_PIXELS = 10
CHANGE_FLOOR = 0.01


def cell_of(position: np.ndarray, size: np.ndarray | int) -> np.ndarray:
    """Cells, along one side, of rows or columns of images of that size."""
    return position * SIDE // size


def leaf_strength(change: np.ndarray, valid: np.ndarray, level: np.ndarray, deepest: int) -> np.ndarray:
    """Strengths of an image's pixels: (H, W) float32, 0 where they are not valid.

    Args:
        change: (H, W) color change.
        valid: (H, W) bool.
        level: (SIDE, SIDE) level of the leaf that each cell lies in.
        deepest: level of open leaves.
    """
    row, column = np.indices(level.shape)
    shift = MAX_LEVEL - level.astype(np.int64)
    first_cell = (row >> shift << shift) * SIDE + (column >> shift << shift)  # of the leaf that a cell lies in
    rows, columns = (cell_of(np.arange(length), length) for length in change.shape)

    def by_leaf(values: np.ndarray) -> np.ndarray:
        """Sums over the pixels of the leaf that a cell lies in, (SIDE, SIDE)."""
        sums = np.bincount(first_cell.reshape(-1), sum_by_cell(values, rows, columns).reshape(-1), SIDE * SIDE)
        return sums[first_cell]

    floor = CHANGE_FLOOR * change.mean(dtype=np.float64) / CHANGE_STEP
    c = change / CHANGE_STEP
    np.maximum(c, np.float32(np.ceil(max(floor, 1))), out=c)  # whole numbers: sums are exact
    c *= valid
    pixels, total = by_leaf(valid), by_leaf(c)
    weight = np.where(level == deepest, pixels, np.minimum(pixels, LEARNT_PIXELS))
    uniform, by_change = (
        (weight / 2 / np.where(pixels > 0, amount, 1)).astype(np.float32)[:, columns][rows]
        for amount in (pixels, total)
    )  # of a pixel
    c *= by_change
    c += uniform
    c *= valid
    return c


def sum_by_cell(values: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """(SIDE, SIDE) sums of values (H, W) over the pixels of each cell, in float64; of a small image some cells have no
    pixel.

    Args:
        rows: (H,) row of cells that each row of pixels lies in, ascending.
        columns: (W,) as rows.
    """
    first_row, first_column = (np.flatnonzero(np.diff(cells, prepend=-1)) for cells in (rows, columns))
    sums = np.zeros((SIDE, SIDE))
    by_row = np.add.reduceat(values, first_row, axis=0, dtype=np.float64)
    sums[np.ix_(rows[first_row], columns[first_column])] = np.add.reduceat(by_row, first_column, axis=1)
    return sums


def drawable_cells(valid: np.ndarray) -> np.ndarray:
    """(SIDE, SIDE) bool: cells with a pixel of an image that is valid, (H, W) bool."""
    return sum_by_cell(valid, *(cell_of(np.arange(length), length) for length in valid.shape)) > 0


class Forest:
    """The trees of all images that were met, and the errors found since the deepest level was begun."""

    def __init__(self) -> None:
        self.deepest = START_LEVEL
        self.row: dict[int, int] = {}  # of an image number
        self.level = np.zeros((0, SIDE, SIDE), dtype=np.uint8)  # of the leaf that a cell lies in
        self.drawable: dict[int, np.ndarray] = {}  # by image number, cells with a pixel to draw, if not all have one
        self.error = np.zeros((0, SIDE, SIDE))  # sums
        self.count = np.zeros((0, SIDE, SIDE), dtype=np.int32)

    def add(self, numbers: list[int]) -> None:
        """Begin the trees of images that are new, with open leaves alone."""
        new = [number for number in numbers if number not in self.row]
        if new:
            self.row |= {number: len(self.row) + i for i, number in enumerate(new)}
            added = (len(new), SIDE, SIDE)
            self.level = np.concatenate((self.level, np.full(added, self.deepest, dtype=np.uint8)))
            self.error = np.concatenate((self.error, np.zeros(added)))
            self.count = np.concatenate((self.count, np.zeros(added, dtype=np.int32)))

    def observe(self, cells: tuple[np.ndarray, ...], squared_error: np.ndarray) -> None:
        """Add squared errors (n,), sums over channels, of pixels in cells: tree, row, column, (n,) each."""
        np.add.at(self.error, cells, squared_error)
        np.add.at(self.count, cells, 1)

    def subdivide(self, threshold: float) -> bool:
        """Judge the open leaves if enough pixels are known; whether any leaf has changed."""
        if self.deepest == MAX_LEVEL:
            return False
        side = SIDE >> self.deepest
        by_leaf = (len(self.level), SIDE // side, side, SIDE // side, side)
        every = np.ones((SIDE, SIDE), dtype=bool)
        drawable = np.stack([self.drawable.get(number, every) for number in self.row]).reshape(by_leaf).any(axis=(2, 4))
        open_leaves = drawable & (self.level[:, ::side, ::side] == self.deepest)
        number = int(np.count_nonzero(open_leaves))
        if not number or self.count.sum() < PIXELS_PER_LEAF * number:
            return False
        error, count = (values.reshape(by_leaf).sum(axis=(2, 4)) for values in (self.error, self.count))
        grown = open_leaves & ((error > 3 * threshold**2 * count) | (count == 0))
        self.deepest += 1
        self.level[grown.repeat(side, axis=1).repeat(side, axis=2)] = self.deepest
        self.error[:], self.count[:] = 0, 0
        return True


class Quadtree(Distribution):
    """By leaf, uniformly and by color change; it learns from what it drew itself. Subdividing renews its tables."""

    name = "quadtree"
    needs_errors = True

    def __init__(self, settings: SamplingSettings) -> None:
        super().__init__(settings)
        self.forest = Forest()

    def tables(self, batch: ImageBatch) -> tuple[Any, Tensor]:
        """As `Distribution.tables`."""
        for k, number in enumerate(batch.numbers.tolist()):
            if number not in self.forest.drawable and (batch.mask is not None or min(batch.sizes[k]) < SIDE):
                self.forest.drawable[number] = drawable_cells(_valid(batch, k))
        self.forest.add(batch.numbers.tolist())
        return super().tables(batch)

    def update(self, drawn: PixelBatch, squared_error: Tensor, step: TrainingStep) -> None:
        """Add the errors to their leaves', and subdivide when enough are known."""
        if drawn.distribution is not self:
            return
        position, row, column = drawn.pixels.numpy().T
        tree = np.array([self.forest.row[number] for number in drawn.batch.numbers.tolist()])
        height, width = np.array(drawn.batch.sizes)[position].T
        cells = (tree[position], cell_of(row, height), cell_of(column, width))
        self.forest.observe(cells, squared_error.cpu().double().numpy())
        if self.forest.subdivide(self.settings.quadtree_threshold):
            self.clear()

    def state_dict(self) -> dict[str, Any]:
        """The trees and the errors."""
        arrays = {name: torch.tensor(getattr(self.forest, name)) for name in ("level", "error", "count")}
        return {"numbers": list(self.forest.row), "deepest": self.forest.deepest, **arrays}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        self.clear()
        self.forest.row = {number: row for row, number in enumerate(state["numbers"])}
        self.forest.deepest = state["deepest"]
        for name in ("level", "error", "count"):
            setattr(self.forest, name, state[name].numpy().copy())

    def _valid_strength(self, batch: ImageBatch, k: int) -> Tensor:
        """(H, W) strengths of the image at position k by its tree."""
        change, valid = color_change(batch.image(k), batch.background_color), _valid(batch, k)
        level = self.forest.level[self.forest.row[int(batch.numbers[k])]]
        return torch.from_numpy(leaf_strength(change, valid, level, self.forest.deepest))


def _valid(batch: ImageBatch, k: int) -> np.ndarray:
    """(H, W) bool: pixels of the image at position k that are not masked."""
    return np.ones(batch.sizes[k], dtype=bool) if batch.mask is None else batch.valid(k).numpy()
