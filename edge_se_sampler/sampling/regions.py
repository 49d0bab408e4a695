"""Pixel regions: flat, textured and edge pixels, each drawn as often as its errors are large (Sun et al. 2023,
"Efficient Ray Sampling for Radiance Fields Reconstruction", arXiv 2308.15547).

d    color change around a pixel
r    region of a pixel: 0 flat, 1 textured, 2 edge
e_r  running mean squared error of the region's pixels, over all images
w_r  strength of a pixel, max(e_r, FLOOR max e), over max e; 1 for all before any error is known

The paper draws more where color and depth vary, because errors are large there. Its thresholds and factors are decided
here, so that there is none to set: flat is d up to its mean over the image, textured up to the mean of what is above;
and how much more a region is drawn follows from the errors that training finds in it. The paper's depth boundaries are
left out: a pixel sampler sees no depths.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.sampling.edges import color_change
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.parts import Distribution, PixelBatch, TrainingStep
from edge_se_sampler.sampling.settings import SamplingSettings

REGIONS = 3
MASKED = 3
"""Stands for a region where no pixel may be drawn."""
FLOOR = 0.05
WINDOW_PIXELS = 2**14
"""A running mean is about one over the last so many pixels of its region."""


def classify(change: np.ndarray) -> np.ndarray:
    """r of every pixel, (H, W) uint8, from color changes (H, W)."""
    texture = change.mean(dtype=np.float64)
    varied = change > texture
    edge = change[varied].mean(dtype=np.float64) if varied.any() else np.inf
    return varied.astype(np.uint8) + (change > edge)


class RegionTable:
    """Pixels of many images by region: 4.25 bytes each. Drawn by the strengths of their regions at that moment."""

    def __init__(self) -> None:
        self.strength = np.ones(REGIONS)
        """w."""
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
            order.append(np.argsort(flat, kind="stable").astype(np.int32))
            quarters = np.pad(flat, (0, -len(flat) % 4)).reshape(-1, 4)
            packed.append(np.bitwise_or.reduce(quarters << np.array([0, 2, 4, 6], dtype=np.uint8), axis=1))
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
        """r (n,) of drawn pixels, (n, 3) as `draw` returns them."""
        which, row, column = drawn.numpy().T
        image = images.numpy()[which]
        pixel = row * self._shape[image, 1] + column
        return self._packed[self._first_packed[image] + pixel // 4] >> (2 * (pixel % 4)) & 3

    def density_ratio(self, images: Tensor, drawn: Tensor) -> Tensor:
        """(n,) p of drawn pixels times the number of drawable pixels of their image."""
        count = self._count[images.numpy()[drawn[:, 0].numpy()]]
        strength = np.append(self.strength, 0.0)[self.region(images, drawn)]
        return torch.from_numpy(strength * count.sum(axis=1) / (count @ self.strength))


class Regions(Distribution):
    """In proportion to the mean squared error that training has found in a pixel's region; it learns from what it
    drew itself."""

    name = "regions"
    new_table = RegionTable
    needs_errors = True

    def __init__(self, settings: SamplingSettings) -> None:
        super().__init__(settings)
        self.errors, self.seen = np.zeros(REGIONS), np.zeros(REGIONS)

    @property
    def region_strength(self) -> np.ndarray:
        """w (3,), > 0; a region without errors has the largest."""
        known = np.where(self.seen > 0, self.errors, self.errors.max())
        return np.maximum(known / known.max(), FLOOR) if known.any() else np.ones(REGIONS)

    def strength(self, image: np.ndarray, background_color: tuple[float, float, float]) -> np.ndarray:
        """w of every pixel's region; raises as `color_change`."""
        return self.region_strength[classify(color_change(image, background_color))]

    def tables(self, batch: ImageBatch) -> tuple[RegionTable, Tensor]:
        """As `Distribution.tables`, with the current strengths."""
        table, table_index = super().tables(batch)
        table.strength = self.region_strength
        return table, table_index

    def update(self, drawn: PixelBatch, squared_error: Tensor, step: TrainingStep) -> None:
        """Add the errors to the running means of their regions."""
        if drawn.distribution is not self:
            return
        table, table_index = self.tables(drawn.batch)
        region = table.region(table_index, drawn.pixels)
        count = np.bincount(region, minlength=REGIONS)
        total = np.bincount(region, squared_error.double().cpu().numpy(), minlength=REGIONS)
        self.seen = np.minimum(self.seen + count, np.maximum(WINDOW_PIXELS, count))
        self.errors += (total - count * self.errors) / np.maximum(self.seen, 1)

    def state_dict(self) -> dict[str, Any]:
        """The running means and how many pixels they are of."""
        return {"errors": self.errors.tolist(), "seen": self.seen.tolist()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        self.errors, self.seen = np.array(state["errors"]), np.array(state["seen"])

    def _valid_strength(self, batch: ImageBatch, k: int) -> Tensor:
        """(H, W) uint8 regions of the image at position k, which are what its table holds."""
        region = torch.from_numpy(classify(color_change(batch.image(k), batch.background_color)))
        return region if batch.mask is None else torch.where(batch.valid(k), region, MASKED)
