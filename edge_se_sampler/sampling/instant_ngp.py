"""The error map of instant-ngp (Müller et al. 2022; github.com/NVlabs/instant-ngp, src/testbed_nerf.cu), which its
paper does not mention: "sample focal plane ~error" in its window.

T      steps until the next rebuild: 128, then 1.5 times as many each time, rounded down
S      cells along a side of an image: 3.5 (pixels that T steps draw from an image)^(1/4)
m      map: errors over their p/u, added up over T steps, each shared bilinearly by the four nearest cells; then cleared
P(y)   0.99 x a row's share of its image's m + 0.01 / rows
P(x|y) 0.99 x a cell's share of its row's m + 0.01 / columns

Half of the pixels are uniform, half are drawn from P(y) P(x|y); before the first rebuild all are uniform. The loss is
not weighted, as the code's comment wants it. Pixels of a cell that is masked in part are drawn less often, as in the
code: m is a sum over its valid pixels alone. Decided here: m is divided by the density of both halves together, where
the code takes 1 for the uniform one; images are drawn alike, the code's default; S is at most the image's side in rows
and in columns, each by itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from edge_se_sampler.sampling.cells import CellTable
from edge_se_sampler.sampling.learned import LearnedDistribution
from edge_se_sampler.sampling.parts import PixelBatch, TrainingStep
from edge_se_sampler.sampling.settings import SamplingSettings

FIRST_INTERVAL, INTERVAL_GROWTH, SIDE_FACTOR = 128, 1.5, 3.5
UNIFORM_SHARE, MIN_SHARE = 0.5, 0.01
FIRST_SIDE = 64
"""Cells along a side while all have the same value: as good as any."""


class ErrorCdf(LearnedDistribution):
    """Half uniformly, half from a CDF of coarse cells' errors that is rebuilt now and then."""

    name = "error-cdf"

    def __init__(self, settings: SamplingSettings) -> None:
        super().__init__(settings, FIRST_SIDE)
        self.interval, self.steps = FIRST_INTERVAL, 0
        self.map: CellTable | None = None

    def update(self, drawn: PixelBatch, squared_error: Tensor, step: TrainingStep) -> None:
        """Add errors to the map; rebuild what is drawn from if it is time."""
        if self.map is None:
            per_image = self.interval * len(squared_error) / max(len(self.cells), len(drawn.batch.sizes))
            self.map = CellTable(max(1, int(SIDE_FACTOR * per_image**0.25)), new_value=0.0)
        images = self.map.add(drawn.batch)
        error = squared_error.cpu().double().numpy() / drawn.density_ratio().numpy()
        _deposit(self.map, images[drawn.pixels[:, 0]].numpy(), drawn.pixels[:, 1:].numpy(), error)
        self.steps += 1
        if self.steps == self.interval:
            _turn_into_density(self.map)
            self.cells, self.map = self.map, None
            self.steps, self.interval = 0, int(self.interval * INTERVAL_GROWTH)

    def state_dict(self) -> dict[str, Any]:
        """Both tables, and how far the interval is."""
        learning = None if self.map is None else self.map.state_dict()
        return {**super().state_dict(), "map": learning, "interval": self.interval, "steps": self.steps}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        super().load_state_dict(state)
        self.map = None if state["map"] is None else CellTable.from_state(state["map"])
        self.interval, self.steps = state["interval"], state["steps"]


def _deposit(table: CellTable, image: np.ndarray, pixel: np.ndarray, error: np.ndarray) -> None:
    """Share errors (n,) at the centers of pixels (n, 2) among the four nearest cells of their images (n,)."""
    grid = table.grid[image]
    at = np.clip((pixel + 0.5) / table.size[image] * grid - 0.5, 0, grid - 1)
    low = np.minimum(at.astype(np.int64), np.maximum(grid - 2, 0))
    corners = (low, 1 - (at - low)), (np.minimum(low + 1, grid - 1), at - low)
    for row, down in corners:
        for column, right in corners:
            cell = table.first[image] + row[:, 0] * grid[:, 1] + column[:, 1]
            np.add.at(table.values, cell, down[:, 0] * right[:, 1] * error)


def _turn_into_density(table: CellTable) -> None:
    """Replace m by p/u of the mixture that pixels are drawn from."""
    for first, (rows, columns) in zip(table.first, table.grid, strict=False):  # first has one more
        cells = slice(first, first + rows * columns)
        m = table.values[cells].reshape(rows, columns).astype(np.float64) + 1e-10
        by_row = m.sum(axis=1, keepdims=True)
        row_share = (1 - MIN_SHARE) * by_row / by_row.sum() + MIN_SHARE / rows
        column_share = (1 - MIN_SHARE) * m / by_row + MIN_SHARE / columns
        density = row_share * column_share * rows * columns
        table.values[cells] = (UNIFORM_SHARE + (1 - UNIFORM_SHARE) * density).ravel()
    table.new_value = 1.0
    table.refresh()
