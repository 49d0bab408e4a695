"""Squared errors remembered: what training found at a pixel the last times, instead of rendering it to find out.

b    side of a block of pixels that share a memory
e    remembered error of a block: half what it was, half what was found last
M    mean of e over all blocks that have one; what a block without one is taken to have
a    age: steps since something was found in a block
A    steps in which as many pixels are trained on as there are blocks

What is recalled is M + (e - M) exp(-a / (FADES A)): a memory that nobody refreshes fades to what is usual.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

MAX_BLOCKS = 2**20
"""Of all images together: 8 bytes each, and few enough to be seen again before they fade."""
FADES = 8.0


class ErrorMap:
    """Images are added as they are met. Lives on the CPU; its state goes into a checkpoint."""

    def __init__(self) -> None:
        self.sizes: dict[int, tuple[int, int]] = {}
        self._layout()
        self.values = np.zeros(0, dtype=np.float32)
        self.seen = np.zeros(0, dtype=np.int32)  # step + 1 at which something was found; 0: never
        self._sum, self._known = 0.0, 0

    def __len__(self) -> int:
        return len(self.values)

    def add(self, images: dict[int, tuple[int, int]]) -> None:
        """Make room for images: number -> rows, columns. Should blocks have to grow, what is remembered is lost."""
        new = {number: size for number, size in images.items() if number not in self.sizes}
        if not new:
            return
        side, kept = self.side, len(self.values)
        self.sizes |= new
        self._layout()
        total = int(self._first[-1])
        values, seen = np.zeros(total, dtype=np.float32), np.zeros(total, dtype=np.int32)
        if side == self.side:
            values[:kept], seen[:kept] = self.values, self.seen
        self._take(values, seen)

    def recall(self, indices: np.ndarray, step: int, pixels_a_step: int) -> np.ndarray:
        """Remembered errors of pixels.

        Args:
            indices: (n, 3) int64 image number, row, column.
            pixels_a_step: that are trained on.

        Returns:
            (n,) float64, >= 0.
        """
        block = self._block(indices)
        usual = self._sum / max(1, self._known)
        age = step + 1 - self.seen[block]
        trust = np.where(self.seen[block] > 0, np.exp(-age * pixels_a_step / (FADES * len(self))), 0.0)
        return usual + (self.values[block] - usual) * trust

    def note(self, indices: np.ndarray, squared_error: np.ndarray, step: int) -> None:
        """Remember what a step has found; of several pixels in a block their mean.

        Args:
            indices: (n, 3) int64 image number, row, column.
            squared_error: (n,).
        """
        block, place = np.unique(self._block(indices), return_inverse=True)
        found = np.bincount(place, squared_error) / np.bincount(place)
        new = self.seen[block] == 0
        old = self.values[block].astype(np.float64)
        self.values[block] = np.where(new, found, (old + found) / 2)
        self._sum += float((self.values[block] - old).sum())
        self._known += int(new.sum())
        self.seen[block] = step + 1

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        sizes = [[number, *size] for number, size in self.sizes.items()]
        values, seen = (torch.from_numpy(kept.copy()) for kept in (self.values, self.seen))
        return {"sizes": sizes, "values": values, "seen": seen, "sum": self._sum}

    def load(self, state: dict[str, Any]) -> None:
        """Go on where `state` was taken."""
        self.sizes = {number: (height, width) for number, height, width in state["sizes"]}
        self._layout()
        self._take(state["values"].numpy().copy(), state["seen"].numpy().copy())
        self._sum = state["sum"]  # as it was: added up anew it would differ by rounding

    def _take(self, values: np.ndarray, seen: np.ndarray) -> None:
        self.values, self.seen = values, seen
        self._sum, self._known = float(values.sum(dtype=np.float64)), int(np.count_nonzero(seen))

    def _layout(self) -> None:
        """How large a block is, and where each image begins."""
        size = np.array(list(self.sizes.values()), dtype=np.int64).reshape(-1, 2)
        self.side = 1
        while (blocks := -(-size // self.side)).prod(axis=1).sum() > MAX_BLOCKS:
            self.side += 1
        self._columns = blocks[:, 1]
        self._first = np.concatenate(([0], blocks.prod(axis=1).cumsum()))
        numbers = np.array(list(self.sizes), dtype=np.int64)
        self._order = np.argsort(numbers)
        self._sorted = numbers[self._order]

    def _block(self, indices: np.ndarray) -> np.ndarray:
        image = self._order[np.searchsorted(self._sorted, indices[:, 0])]
        row, column = (indices[:, 1:] // self.side).T
        return self._first[image] + row * self._columns[image] + column
