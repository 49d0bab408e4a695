"""Features at the corners of cells, interpolated in between.

There are two levels: coarse, all cells of the static mask at level 0, and refined, those of the grid's current cells
with corners of their own. A point has the features of the refined level where its cell is refined, else of the coarse.

V   corners of cells, of both levels
K   coarse cells
L   refined cells
m   points, each in a cell of the static mask
F   features of a corner
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from edge_se_sampler.occupancy.grid import OccupancyGrid, resample


class FeatureGrid(nn.Module):
    """A table of features (V, F), 0 at first.

    Args:
        grid: its cells; refined as `grid.refined` says.
        feature_dim: F.
    """

    num_coarse_cells: int
    """K."""
    cell_to_row: Tensor
    """(X Y Z,) int32: flat index of a grid cell -> row of the next two: [0, K) coarse, [K, K + L) refined; undefined
    outside the static mask."""
    rows: Tensor
    """(K + L, 8) int64: rows of the table of a cell's corners."""
    cell_origin: Tensor
    """(K + L, 3): least coordinates of a cell, in cell sizes of its level."""

    def __init__(self, grid: OccupancyGrid, feature_dim: int) -> None:
        super().__init__()
        self.grid = [grid]  # in a list: the model's module, not a part of this one
        self.table = nn.Parameter(torch.zeros(self._lay_out(), feature_dim))

    @torch.no_grad()
    def refine(self, refined: Tensor) -> None:
        """Give cells corners of their own, which begin with the features interpolated there. The table is resized.

        Args:
            refined: (X, Y, Z) bool, of the grid's cells; or of half their size, then the grid is subdivided first.
        """
        (grid,) = self.grid
        sizes = (grid.initial_cell_size, grid.cell_size * len(grid.occupied) / len(refined))
        levels = zip((grid.static_mask_at(0), refined), sizes, strict=True)
        positions = torch.cat([grid.aabb_min + torch.nonzero(_corners(cells)) * size for cells, size in levels])
        around = positions[:, None] + (torch.tensor(_CORNERS, device=positions.device) - 0.5) * (sizes[1] / 2)
        cells = grid.locate(around.reshape(-1, 3)).reshape(-1, 8)
        level = resample(grid.static_mask_at(0), len(grid.refined)).int() + grid.refined
        finest = level.reshape(-1)[cells].argmax(dim=1, keepdim=True)  # of the cells that share a corner
        features = self(positions, cells.gather(1, finest)[:, 0])
        if len(refined) > len(grid.occupied):
            grid.subdivide()
        grid.refined = refined
        self._lay_out()
        self.table.data, self.table.grad = features, None

    def forward(self, positions: Tensor, cell_indices: Tensor) -> Tensor:
        """Features (m, F) of positions (m, 3), world units, in cells (m,) int64 of the static mask."""
        (grid,) = self.grid
        row = self.cell_to_row.index_select(0, cell_indices)
        size = grid.initial_cell_size
        if self.num_coarse_cells < len(self.rows):
            size = torch.where(row < self.num_coarse_cells, size, grid.cell_size)[:, None]
        offset = ((positions - grid.aabb_min) / size - self.cell_origin.index_select(0, row)).clamp(0, 1)
        x, y, z = torch.stack((1 - offset, offset), dim=2).unbind(1)
        weight = (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).reshape(-1, 8)
        return _Interpolate.apply(self.table, self.rows.index_select(0, row), weight)

    def _lay_out(self) -> int:
        """Number the corners of both levels; returns V."""
        (grid,) = self.grid
        rows, origins, cell_rows, num_corners = [], [], [], 0
        for cells in (grid.static_mask_at(0), grid.refined):
            corners, origin = _corners(cells), torch.nonzero(cells)
            _, y_size, z_size = corners.shape
            offsets = torch.tensor([(i * y_size + j) * z_size + k for i, j, k in _CORNERS], device=origin.device)
            flat = ((origin[:, 0] * y_size + origin[:, 1]) * z_size + origin[:, 2])[:, None] + offsets
            rows.append((corners.reshape(-1).cumsum(0) - 1 + num_corners)[flat])
            origins.append(origin.to(grid.aabb_min.dtype))
            cell_rows.append((cells.reshape(-1).cumsum(0, dtype=torch.int32) - 1).clamp(min=0).reshape(cells.shape))
            num_corners += int(corners.sum())
        self.num_coarse_cells = len(origins[0])
        coarse, refined = resample(cell_rows[0], len(grid.refined)), self.num_coarse_cells + cell_rows[1]
        self.register_buffer("cell_to_row", torch.where(grid.refined, refined, coarse).reshape(-1), persistent=False)
        self.register_buffer("rows", torch.cat(rows), persistent=False)
        self.register_buffer("cell_origin", torch.cat(origins), persistent=False)
        return num_corners


def _corners(cells: Tensor) -> Tensor:
    """(X + 1, Y + 1, Z + 1) bool: the corners of cells (X, Y, Z) bool."""
    x, y, z = cells.shape
    corners = torch.zeros((x + 1, y + 1, z + 1), dtype=torch.bool, device=cells.device)
    for i, j, k in _CORNERS:
        corners[i : i + x, j : j + y, k : k + z] |= cells
    return corners


_CORNERS = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]


class _Interpolate(torch.autograd.Function):
    """table (V, F), rows (m, 8), weights (m, 8) -> (m, F). Torch's own gradient sorts the rows, which takes eight times
    as long as scattering every number by itself."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Tensor, weight: Tensor) -> Tensor:
        ctx.save_for_backward(rows, weight)
        ctx.shape = table.shape
        return F.embedding_bag(rows, table, per_sample_weights=weight, mode="sum")

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        rows, weight = ctx.saved_tensors
        size = gradient.shape[1]
        values = (weight[:, :, None] * gradient[:, None]).reshape(-1)
        indices = (rows.reshape(-1, 1) * size + torch.arange(size, device=rows.device)).reshape(-1)
        scattered = gradient.new_zeros(ctx.shape.numel()).scatter_add_(0, indices, values)
        return scattered.reshape(ctx.shape), None, None
