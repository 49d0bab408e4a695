"""A map of squared errors over the training images: what training found at a pixel before, instead of rendering it.

b    side of a block of pixels that share an entry
e    entry of a block: the mean of its previous entry and of what was found last
M    mean of e over all blocks that have an entry; stands in for those that have none
a    age: steps since a block was last updated
A    steps in which as many pixels are trained on as there are blocks

A lookup returns M + (e - M) exp(-a / (DECAY_PASSES A)): an entry that is not updated decays to the mean.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

MAX_BLOCKS = 2**20
"""Of all images together: 8 bytes each, and few enough to be updated again before they have decayed."""
DECAY_PASSES = 8.0


class ErrorMap:
    """Squared errors by block of pixels, on the CPU. Images are added as they are met."""

    def __init__(self) -> None:
        self.sizes: dict[int, tuple[int, int]] = {}
        self.values = np.zeros(0, dtype=np.float32)
        self.updated = np.zeros(0, dtype=np.int32)  # 1 + step of the last update; 0: never
        self._sum, self._known = 0.0, 0
        self._lay_out()

    def __len__(self) -> int:
        return len(self.values)

    def add(self, images: dict[int, tuple[int, int]]) -> None:
        """Make room for images: number -> rows, columns. Where blocks have to grow for it, all entries are lost."""
        new = {number: size for number, size in images.items() if number not in self.sizes}
        if not new:
            return
        side, kept = self.side, len(self.values)
        self.sizes |= new
        self._lay_out()
        values, updated = np.zeros(self._first[-1], dtype=np.float32), np.zeros(self._first[-1], dtype=np.int32)
        if side == self.side:
            values[:kept], updated[:kept] = self.values, self.updated
        self._set_entries(values, updated)

    def lookup(self, indices: np.ndarray, step: int, pixels_per_step: int) -> np.ndarray:
        """Expected squared errors of pixels at a step: (n, 3) int64 image number, row, column -> (n,) float64, >= 0.

        Args:
            pixels_per_step: how many are trained on.
        """
        block = self._block_of(indices)
        mean = self._sum / max(1, self._known)
        age = step + 1 - self.updated[block]
        decay = np.exp(-age * pixels_per_step / (DECAY_PASSES * len(self)))
        return mean + (self.values[block] - mean) * np.where(self.updated[block] > 0, decay, 0.0)

    def update(self, indices: np.ndarray, squared_error: np.ndarray, step: int) -> None:
        """Enter the squared errors (n,) that a step has found at pixels (n, 3); of several in a block their mean."""
        block, inverse = np.unique(self._block_of(indices), return_inverse=True)
        found = np.bincount(inverse, squared_error) / np.bincount(inverse)
        new = self.updated[block] == 0
        old = self.values[block].astype(np.float64)
        self.values[block] = np.where(new, found, (old + found) / 2)
        self._sum += float((self.values[block] - old).sum())
        self._known += int(new.sum())
        self.updated[block] = step + 1

    def state_dict(self) -> dict[str, Any]:
        """Images and entries, for a checkpoint."""
        sizes = [[number, *size] for number, size in self.sizes.items()]
        values, updated = torch.tensor(self.values), torch.tensor(self.updated)
        return {"sizes": sizes, "values": values, "updated": updated, "sum": self._sum}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        self.sizes = {number: (height, width) for number, height, width in state["sizes"]}
        self._lay_out()
        self._set_entries(state["values"].numpy().copy(), state["updated"].numpy().copy())
        self._sum = state["sum"]  # added up again it would differ by rounding

    def _set_entries(self, values: np.ndarray, updated: np.ndarray) -> None:
        self.values, self.updated = values, updated
        self._sum, self._known = float(values.sum(dtype=np.float64)), int(np.count_nonzero(updated))

    def _lay_out(self) -> None:
        """Decide how large a block is, and where each image begins."""
        size = np.array(list(self.sizes.values()), dtype=np.int64).reshape(-1, 2)
        self.side = 1
        while (blocks := -(-size // self.side)).prod(axis=1).sum() > MAX_BLOCKS:
            self.side += 1
        self._columns = blocks[:, 1]
        self._first = np.concatenate(([0], blocks.prod(axis=1).cumsum()))
        numbers = np.array(list(self.sizes), dtype=np.int64)
        self._order = np.argsort(numbers)
        self._sorted = numbers[self._order]

    def _block_of(self, indices: np.ndarray) -> np.ndarray:
        """(n,) index of each pixel's block."""
        image = self._order[np.searchsorted(self._sorted, indices[:, 0])]
        row, column = (indices[:, 1:] // self.side).T
        return self._first[image] + row * self._columns[image] + column
