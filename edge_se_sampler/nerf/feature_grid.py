"""Features at the corners of occupied cells, interpolated in between; nothing is stored elsewhere.

V   corners of possible cells
m   points, each in a cell
F   features of a corner
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from edge_se_sampler.nerf.occupancy import OccupancyGrid


class FeatureGrid(nn.Module):
    """A table of V corners, 0 at first: then the scene is what the encoded position makes of it.

    Args:
        size: F.
    """

    offsets: Tensor
    """(8,) int64: how much farther in `place` each corner of a cell is than its first."""
    place: Tensor
    """((X + 1) (Y + 1) (Z + 1),) int64: row of each corner in the table; that of no cell's: any."""

    def __init__(self, grid: OccupancyGrid, size: int) -> None:
        super().__init__()
        self.grid = [grid]  # not a part of this one
        corners = torch.zeros([length + 1 for length in grid.possible.shape], dtype=torch.bool)
        shape = grid.possible.shape
        for i, j, k in _CORNERS:
            corners[i : i + shape[0], j : j + shape[1], k : k + shape[2]] |= grid.possible.cpu()
        place = corners.reshape(-1).cumsum(0) - 1
        self.register_buffer("place", place.clamp(min=0), persistent=False)
        self.table = nn.Parameter(torch.zeros(int(corners.sum()), size))
        _, wide, deep = corners.shape
        offsets = torch.tensor([(i * wide + j) * deep + k for i, j, k in _CORNERS])
        self.register_buffer("offsets", offsets, persistent=False)

    def forward(self, positions: Tensor) -> Tensor:
        """(m, 3) world units, in possible cells -> (m, F)."""
        (grid,) = self.grid
        at = (positions - grid.corner) / grid.side
        low = at.floor()
        share = at - low
        low = low.long()
        _, wide, deep = (length + 1 for length in grid.possible.shape)
        corner = (low[:, 0] * wide + low[:, 1]) * deep + low[:, 2]
        rows = self.place[corner[:, None] + self.offsets]
        x, y, z = torch.stack((1 - share, share), dim=2).unbind(1)
        weight = (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).reshape(-1, 8)
        return _Weighted.apply(self.table, rows, weight)


_CORNERS = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]


class _Weighted(torch.autograd.Function):
    """table (V, F), rows (m, 8), weights (m, 8) -> (m, F). Torch's own gradient of it sorts the rows, which takes eight
    times as long as adding up number by number."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Tensor, weight: Tensor) -> Tensor:
        ctx.save_for_backward(rows, weight)
        ctx.shape = table.shape
        return F.embedding_bag(rows, table, per_sample_weights=weight, mode="sum")

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        rows, weight = ctx.saved_tensors
        size = gradient.shape[1]
        shares = (weight[:, :, None] * gradient[:, None]).reshape(-1)
        numbers = (rows.reshape(-1, 1) * size + torch.arange(size, device=rows.device)).reshape(-1)
        added = gradient.new_zeros(ctx.shape.numel()).scatter_add_(0, numbers, shares)
        return added.reshape(ctx.shape), None, None
