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

from typing import Any

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.sampling.edges import color_change
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.parts import Distribution, PixelBatch, TrainingStep
from edge_se_sampler.sampling.region_table import MASKED, REGIONS, RegionTable
from edge_se_sampler.sampling.settings import SamplingSettings

FLOOR = 0.05
WINDOW_PIXELS = 2**14
"""A running mean is about one over the last so many pixels of its region."""


def classify(change: np.ndarray) -> np.ndarray:
    """r of every pixel, (H, W) uint8, from color changes (H, W)."""
    texture = change.mean(dtype=np.float64)
    varied = change > texture
    edge = change[varied].mean(dtype=np.float64) if varied.any() else np.inf
    return varied.astype(np.uint8) + (change > edge)


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

    def tables(self, batch: ImageBatch) -> tuple[RegionTable, Tensor]:
        """As `Distribution.tables`, with the current strengths."""
        table, table_index = super().tables(batch)
        assert isinstance(table, RegionTable)
        table.strength = self.region_strength
        return table, table_index

    def update(self, drawn: PixelBatch, squared_error: Tensor, step: TrainingStep) -> None:
        """Add the errors to the running means of their regions."""
        if drawn.distribution is not self:
            return
        table, table_index = self.tables(drawn.batch)
        region = table.region(table_index, drawn.pixels)
        count = np.bincount(region, minlength=REGIONS)
        total = np.bincount(region, squared_error.cpu().double().numpy(), minlength=REGIONS)
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
