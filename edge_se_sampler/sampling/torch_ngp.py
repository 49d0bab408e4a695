"""The error map of torch-ngp (github.com/ashawkey/torch-ngp, `get_rays` and `train_step` in nerf/utils.py, 2022).

e   value of a cell of an image's 128 x 128: at first 1, then e <- 0.1 e + 0.9 x the squared error found there, a mean
    over the channels

A cell is drawn in proportion to e (and to its size), a pixel in it uniformly. Decided here: an image of less than 128
rows or columns has a cell for each; a pixel lies in one cell only, where torch-ngp jitters over borders; draws are with
replacement, and of several errors in a cell the mean counts.
"""

from __future__ import annotations

from torch import Tensor

from edge_se_sampler.sampling.cells import cell_means
from edge_se_sampler.sampling.learned import LearnedDistribution
from edge_se_sampler.sampling.parts import PixelBatch, TrainingStep
from edge_se_sampler.sampling.settings import SamplingSettings

SIDE, KEPT = 128, 0.1


class ErrorMapCells(LearnedDistribution):
    """In proportion to the errors last found in 128 x 128 cells of an image."""

    name = "error-map"

    def __init__(self, settings: SamplingSettings) -> None:
        super().__init__(settings, SIDE)

    def update(self, drawn: PixelBatch, squared_error: Tensor, step: TrainingStep) -> None:
        """Enter errors into the map."""
        cells = self.cells.cells_at(self.cells.add(drawn.batch), drawn.pixels)
        cells, found = cell_means(cells, squared_error.cpu().double().numpy() / 3)
        self.cells.set(cells, KEPT * self.cells.values[cells] + (1 - KEPT) * found)
