"""Pixels of images by region, each drawn by the strength that its region has at that moment."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

REGIONS = 3
MASKED = 3
"""Stands for a region where no pixel may be drawn."""


class RegionTable:
    """Pixels of many images by region: 4.25 bytes each. Drawn by the strengths of their regions at that moment."""

    def __init__(self) -> None:
        self.strength = np.ones(REGIONS)
        """Of a pixel of each region, > 0."""
        self._order = np.zeros(0, dtype=np.int32)  # pixels of an image, by region
        self._packed = np.zeros(0, dtype=np.uint8)  # region of each pixel, two bits each
        self._count = np.zeros((0, REGIONS), dtype=np.int64)
        self._shape = np.zeros((0, 2), dtype=np.int64)
        self._first = self._first_packed = np.zeros(0, dtype=np.int64)  # where an image begins in each

    def __len__(self) -> int:
        return len(self._shape)

    @property
    def nbytes(self) -> int:
        """Bytes that the table holds."""
        return sum(value.nbytes for value in vars(self).values())

    def add(self, regions: Iterable[Tensor]) -> None:
        """Append images: their regions, (H, W) uint8, or MASKED."""
        order, packed, count, shape = [self._order], [self._packed], [self._count], [self._shape]
        for region in regions:
            flat = region.numpy().reshape(-1)
            order.extend(np.flatnonzero(flat == number).astype(np.int32) for number in (*range(REGIONS), MASKED))
            four = np.pad(flat, (0, -len(flat) % 4)).reshape(-1, 4).T
            packed.append(four[0] | four[1] << 2 | four[2] << 4 | four[3] << 6)
            count.append(np.bincount(flat, minlength=REGIONS + 1)[None, :REGIONS])
            shape.append(np.array([region.shape], dtype=np.int64))
        arrays = (np.concatenate(parts) for parts in (order, packed, count, shape))
        self._order, self._packed, self._count, self._shape = arrays
        pixels = self._shape.prod(axis=1)
        self._first = np.cumsum(pixels) - pixels
        self._first_packed = np.cumsum(-(-pixels // 4)) - -(-pixels // 4)

    def drawable(self, images: Tensor) -> Tensor:
        """(k,) bool: the images that have a pixel to draw."""
        return torch.from_numpy(self._count[images.numpy()].any(axis=1))

    def draw(self, images: Tensor, n: int, rng: np.random.Generator) -> Tensor:
        """As `PixelTable.draw`, but in random order."""
        u = rng.random((3, n))
        which = (u[0] * len(images)).astype(np.int64)
        image, count = images.numpy()[which], self._count[images.numpy()]
        mass = np.cumsum(count * self.strength, axis=1)
        region = (u[1][:, None] >= (mass / mass[:, -1:])[which, :-1]).sum(axis=1)
        within = (u[2] * count[which, region]).astype(np.int64)
        before = np.cumsum(count, axis=1) - count
        pixel = self._order[self._first[image] + before[which, region] + within].astype(np.int64)
        return torch.from_numpy(np.stack((which, *np.divmod(pixel, self._shape[image, 1])), axis=1))

    def region(self, images: Tensor, drawn: Tensor) -> np.ndarray:
        """region (n,) of drawn pixels, (n, 3) as `draw` returns them."""
        which, row, column = drawn.numpy().T
        image = images.numpy()[which]
        pixel = row * self._shape[image, 1] + column
        return self._packed[self._first_packed[image] + pixel // 4] >> (2 * (pixel % 4)) & 3

    def density_ratio(self, images: Tensor, drawn: Tensor) -> Tensor:
        """(n,) p of drawn pixels times the number of drawable pixels of their image."""
        count = self._count[images.numpy()[drawn[:, 0].numpy()]]
        strength = np.append(self.strength, 0.0)[self.region(images, drawn)]
        return torch.from_numpy(strength * count.sum(axis=1) / (count * self.strength).sum(axis=1))
