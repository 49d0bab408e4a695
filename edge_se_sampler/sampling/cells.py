"""Images divided into cells, each with a value that training may change; pixels are drawn in proportion to their
cell's value.

H, W   rows and columns of an image's pixels
R, C   rows and columns of its cells: the pixel at row y lies in row floor(y R / H) of the cells
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.sampling.image_batch import ImageBatch

BLOCK = 32
"""Cells whose mass is kept as one sum, so that a change of some cells needs no sum over all."""
REJECTIONS = 8
"""Times that a masked pixel is drawn anew before its cell's pixels are counted."""
MIN_VALUE = 1e-20
"""No cell's value falls below: an image whose errors are all 0 has to be drawn from, too."""


class CellTable:
    """Pixels of many images in at most `side` x `side` cells an image.

    8 bytes a cell, and a bit a pixel where there are masks. Images are added as they are met, and stay.

    Args:
        new_value: the value of an image's cells when it is added.
        across_images: whether images with larger values are drawn more often; otherwise all alike.
    """

    def __init__(self, side: int, *, new_value: float = 1.0, across_images: bool = False) -> None:
        self.side, self.new_value, self.across_images = side, new_value, across_images
        self.sizes: dict[int, tuple[int, int]] = {}  # by image number
        self._index: dict[int, int] = {}  # by image number, once its mask was read
        self._bits = np.zeros(0, dtype=np.uint8)  # masks
        self._first_bit = np.zeros(0, dtype=np.int64)  # at which an image's mask begins; -1: it has none
        self.values, self.counts = np.zeros(0, dtype=np.float32), np.zeros(0, dtype=np.int32)  # counts: pixels to draw
        self._lay_out()

    def __len__(self) -> int:
        return len(self.sizes)

    def add(self, batch: ImageBatch) -> Tensor:
        """Take up a batch's images, if they are new; (k,) int64: the index of each in this table."""
        numbers = batch.numbers.tolist()
        new = [k for k, number in enumerate(numbers) if number not in self._index]
        if new:
            self.grow({numbers[k]: batch.sizes[k] for k in new})
            order = {number: i for i, number in enumerate(self.sizes)}
            self._index |= {numbers[k]: order[numbers[k]] for k in new}
            if batch.mask is not None:
                masks, length = [self._bits], len(self._bits)
                for k in new:
                    masks.append(self._mask(order[numbers[k]], batch.valid(k).numpy(), 8 * length))
                    length += len(masks[-1])
                self._bits = np.concatenate(masks)
            self.refresh()
        return torch.tensor([self._index[number] for number in numbers])

    def grow(self, sizes: dict[int, tuple[int, int]]) -> None:
        """Make room for images; those of a loaded state are here already."""
        known, images = len(self.values), len(self.sizes)
        self.sizes |= {number: size for number, size in sizes.items() if number not in self.sizes}
        self._lay_out()
        self.values = np.append(self.values, np.full(self.first[-1] - known, self.new_value, dtype=np.float32))
        self._first_bit = np.append(self._first_bit, np.full(len(self.sizes) - images, -1))
        grown = [self.counts]
        for i in range(images, len(self.sizes)):
            rows, columns = (
                np.bincount(np.arange(n) * r // n) for n, r in zip(self.size[i], self.grid[i], strict=True)
            )
            counts = np.outer(rows, columns).ravel().astype(np.int32)
            grown.append(np.pad(counts, (0, self.first[i + 1] - self.first[i] - len(counts))))
        self.counts = np.concatenate(grown)

    def _mask(self, image: int, valid: np.ndarray, first_bit: int) -> np.ndarray:
        """Count only the valid (H, W) pixels of an image; their bits, which begin at `first_bit`."""
        starts = [-(-np.arange(r) * n // r) for n, r in zip(self.size[image], self.grid[image], strict=True)]
        by_row = np.add.reduceat(valid, starts[0], axis=0, dtype=np.int32)
        counts = np.add.reduceat(by_row, starts[1], axis=1).ravel()
        self.counts[self.first[image] : self.first[image] + len(counts)] = counts
        self._first_bit[image] = first_bit
        return np.packbits(valid)

    def _lay_out(self) -> None:
        """Where each image's cells begin, a whole number of blocks each."""
        self.size = np.array(list(self.sizes.values()), dtype=np.int64).reshape(-1, 2)
        self.grid = np.minimum(self.size, self.side)
        blocks = -(-self.grid.prod(axis=1) // BLOCK)
        self._first_block = np.concatenate(([0], blocks.cumsum()))
        self.first = self._first_block * BLOCK

    def refresh(self) -> None:
        """Follow changes of `values` anywhere; raises as `set`."""
        self.values = _checked(self.values)
        self._mass = np.zeros(len(self.values) // BLOCK)
        self._sum_blocks(np.arange(len(self._mass)))
        self._support = np.add.reduceat(self.counts, self.first[:-1]) if len(self) else np.zeros(0, dtype=np.int64)

    def set(self, cells: np.ndarray, values: np.ndarray) -> None:
        """Change the values of some cells, at most once each. FloatingPointError: one is not finite in float32."""
        self.values[cells] = _checked(values)
        self._sum_blocks(np.unique(cells // BLOCK))

    def _sum_blocks(self, blocks: np.ndarray) -> None:
        self._mass[blocks] = self._weights(blocks).sum(axis=1)
        self._image_mass = np.add.reduceat(self._mass, self._first_block[:-1]) if len(self) else np.zeros(0)
        # of shares: in one sum of masses, images with large values would round away those of others
        share = self._mass / np.maximum(np.repeat(self._image_mass, np.diff(self._first_block)), MIN_VALUE)
        self._cumulative = np.concatenate(([0.0], share.cumsum()))

    def _weights(self, blocks: np.ndarray) -> np.ndarray:
        """(n, BLOCK) float64 masses of the cells of n blocks."""
        return self.values.reshape(-1, BLOCK)[blocks] * self.counts.reshape(-1, BLOCK)[blocks].astype(np.float64)

    def cells_at(self, images: Tensor, pixels: Tensor) -> np.ndarray:
        """(n,) the cells of pixels (n, 3): position in `images`, row, column."""
        return self.cell_of(images[pixels[:, 0]].numpy(), pixels[:, 1:].numpy())

    def cell_of(self, image: np.ndarray, pixel: np.ndarray) -> np.ndarray:
        """(n,) the cells of pixels (n, 2), row and column, in images (n,)."""
        grid = self.grid[image]
        row, column = (pixel * grid // self.size[image]).T
        return self.first[image] + row * grid[:, 1] + column

    def pixel_at(self, image: np.ndarray, x: np.ndarray) -> np.ndarray:
        """(n, 2) the pixels at shares x (n, 2) of the rows and columns of images (n,), the nearest ones if outside."""
        return np.clip((x * self.size[image]).astype(np.int64), 0, self.size[image] - 1)

    def valid(self, image: np.ndarray, pixel: np.ndarray) -> np.ndarray:
        """Whether pixels (..., 2) of images (...) may be drawn."""
        first = self._first_bit[image]
        if not len(self._bits):
            return np.ones(first.shape, dtype=bool)
        bit = np.where(first >= 0, first + pixel[..., 0] * self.size[image, 1] + pixel[..., 1], 0)
        return (first < 0) | (self._bits[bit >> 3] >> (7 - (bit & 7)).astype(np.uint8) & 1 > 0)

    def drawable(self, images: Tensor) -> Tensor:
        """(k,) bool: the images that have a pixel to draw."""
        return torch.from_numpy(self._support[images.numpy()] > 0)

    def draw(self, images: Tensor, n: int, rng: np.random.Generator) -> Tensor:
        """n independent draws: (n, 3) int64 position in `images`, row, column.

        Args:
            images: (k,) int64, indices of images in this table; all `drawable`.
        """
        indices, u = images.numpy(), rng.random((3, n)) * (1 - 2.0**-36)  # less than 1 after rounding, too
        low = self._cumulative[self._first_block[indices]]
        share = self._cumulative[self._first_block[indices + 1]] - low
        if self.across_images:
            cumulative = self._image_mass[indices].cumsum()
            which = np.searchsorted(cumulative, u[0] * cumulative[-1], side="right")
        else:
            which = (u[0] * len(indices)).astype(np.int64)
        block = np.searchsorted(self._cumulative[1:], low[which] + u[1] * share[which], side="right")
        first, end = self._first_block[indices[which]], self._first_block[indices[which] + 1]
        for i in np.flatnonzero((block < first) | (block >= end)):  # rounding
            block[i] = first[i] + self._mass[first[i] : end[i]].argmax()
        weights = self._weights(block).cumsum(axis=1)
        cell = BLOCK * block + (weights <= (u[2] * weights[:, -1])[:, None]).sum(axis=1)
        row, column = self._draw_in_cells(indices[which], cell, rng)
        return torch.from_numpy(np.stack((which, row, column), axis=1))

    def _draw_in_cells(
        self, image: np.ndarray, cell: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Row and column (n,) of a pixel of each cell (n,), uniform among those that may be drawn."""
        at = np.stack(np.divmod(cell - self.first[image], self.grid[image, 1]), axis=1)
        size, grid = self.size[image], self.grid[image]
        low, high = -(-at * size // grid), -(-(at + 1) * size // grid)
        pixel = low + (rng.random((len(cell), 2)) * (high - low)).astype(np.int64)
        bad = np.flatnonzero(self._first_bit[image] >= 0)
        for _ in range(REJECTIONS):
            bad = bad[~self.valid(image[bad], pixel[bad])]
            pixel[bad] = low[bad] + (rng.random((len(bad), 2)) * (high - low)[bad]).astype(np.int64)
        bad = bad[~self.valid(image[bad], pixel[bad])]
        if len(bad):  # few of the cell's pixels may be drawn: look at all
            height, width = (high - low)[bad].max(axis=0)
            window = low[bad, None] + np.stack(np.divmod(np.arange(height * width), width), axis=1)
            inside = (window < high[bad, None]).all(axis=2)
            window = np.minimum(window, high[bad, None] - 1)
            valid = inside & self.valid(np.broadcast_to(image[bad, None], inside.shape), window)
            rank = (rng.random(len(bad)) * self.counts[cell[bad]]).astype(np.int64)
            place = (valid.cumsum(axis=1) <= rank[:, None]).sum(axis=1)
            pixel[bad] = window[np.arange(len(bad)), place]
        return pixel[:, 0], pixel[:, 1]

    def density_ratio(self, images: Tensor, drawn: Tensor) -> Tensor:
        """(n,) float64 p of drawn pixels over that under uniform sampling, image first, pixel second."""
        indices, which = images.numpy(), drawn[:, 0].numpy()
        mass, support = self._image_mass[indices], self._support[indices]
        mean = mass.sum() / max(1, np.count_nonzero(support))  # over the images that uniform sampling chooses from
        scale = support / np.maximum(mean if self.across_images else mass, MIN_VALUE)
        return torch.from_numpy(self.values[self.cells_at(images, drawn)] * scale[which])

    def state_dict(self) -> dict[str, Any]:
        """Images and values, for a checkpoint; masks are read again."""
        sizes = [[number, *size] for number, size in self.sizes.items()]
        names = ("side", "new_value", "across_images")
        return {**{name: getattr(self, name) for name in names}, "sizes": sizes, "values": torch.tensor(self.values)}

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> CellTable:
        """What `state_dict` was taken of."""
        table = cls(state["side"], new_value=state["new_value"], across_images=state["across_images"])
        table.grow({number: (height, width) for number, height, width in state["sizes"]})
        table.values = state["values"].numpy().copy()
        table.refresh()
        return table


def _checked(values: np.ndarray) -> np.ndarray:
    """As float32, none below MIN_VALUE; FloatingPointError unless all are finite."""
    with np.errstate(over="ignore"):
        checked = np.maximum(values, MIN_VALUE).astype(np.float32)
    if bad := np.count_nonzero(~np.isfinite(checked)):
        raise FloatingPointError(f"the errors of {bad} of {len(checked)} cells are not finite")
    return checked


def cell_means(cells: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different ones of cells (n,), and the mean of what was found (n,) in each."""
    different, inverse = np.unique(cells, return_inverse=True)
    return different, np.bincount(inverse, found) / np.bincount(inverse)
