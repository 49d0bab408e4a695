"""Features at the corners of occupied cells, interpolated in between; nothing is stored elsewhere.

There are two levels: cells as they were at first, all that are possible, and those of today's cells that were split for
more detail. A point has the features of the finest level that has its cell: what was wrongly taken to be empty is
coarser, but not lost.

V   corners of cells, of both levels
m   points, each in a possible cell
F   features of a corner
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from edge_se_sampler.occupancy.grid import OccupancyGrid, resample


class FeatureGrid(nn.Module):
    """A table of V corners, 0 at first: then the scene is what the encoded position makes of it.

    Args:
        size: F.
    """

    owned: Tensor
    """(X, Y, Z) bool: today's cells that have corners of their own level."""
    first: int
    """K: cells there were at first."""
    number: Tensor
    """(X Y Z,) int32: row, in the next two, of today's cells: first the K, then those that are owned; that of none of
    them: any."""
    rows: Tensor
    """(K + L, 8) int64: a cell's corners in the table."""
    low: Tensor
    """(K + L, 3) where a cell begins, in sides of its level's cells."""

    def __init__(self, grid: OccupancyGrid, size: int) -> None:
        super().__init__()
        self.grid = [grid]  # not a part of this one
        self.register_buffer("owned", torch.zeros_like(grid.occupied))
        self.table = nn.Parameter(torch.zeros(self._lay_out(), size))

    @torch.no_grad()
    def own(self, owned: Tensor) -> None:
        """Give cells corners of their own, which begin with what is known there. The table gets another size.

        Args:
            owned: (X, Y, Z) bool; twice as many along each axis as there are today: the grid is split first.
        """
        (grid,) = self.grid
        sides = (grid.first_side, grid.side * len(grid.occupied) / len(owned))
        shown = zip((grid.possible_after(0), owned), sides, strict=True)
        where = torch.cat([grid.corner + torch.nonzero(_corners(cells)) * side for cells, side in shown])
        around = where[:, None] + (torch.tensor(_CORNERS, device=where.device) - 0.5) * (sides[1] / 2)
        cell = grid.locate(around.reshape(-1, 3)).reshape(-1, 8)
        level = resample(grid.possible_after(0), len(self.owned)).int() + self.owned
        finest = level.reshape(-1)[cell].argmax(dim=1, keepdim=True)  # a corner is its finest cell's
        known = self(where, cell.gather(1, finest)[:, 0])
        if len(owned) > len(grid.occupied):
            grid.split()
        self.owned = owned
        self._lay_out()
        self.table.data, self.table.grad = known, None

    def forward(self, positions: Tensor, cell: Tensor) -> Tensor:
        """(m, 3) world units and (m,) int64 numbers of their cells, possible ones -> (m, F)."""
        (grid,) = self.grid
        number = self.number.index_select(0, cell)
        side = grid.first_side
        if self.first < len(self.rows):
            side = torch.where(number < self.first, side, grid.side)[:, None]
        share = ((positions - grid.corner) / side - self.low.index_select(0, number)).clamp(0, 1)
        x, y, z = torch.stack((1 - share, share), dim=2).unbind(1)
        weight = (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).reshape(-1, 8)
        return _Weighted.apply(self.table, self.rows.index_select(0, number), weight)

    def _lay_out(self) -> int:
        """Find a row for every corner of both levels; how many that takes."""
        (grid,) = self.grid
        rows, lows, numbers, corners = [], [], [], 0
        for cells in (grid.possible_after(0), self.owned):
            stored, low = _corners(cells), torch.nonzero(cells)
            _, wide, deep = stored.shape
            offsets = torch.tensor([(i * wide + j) * deep + k for i, j, k in _CORNERS], device=low.device)
            place = ((low[:, 0] * wide + low[:, 1]) * deep + low[:, 2])[:, None] + offsets
            rows.append((stored.reshape(-1).cumsum(0) - 1 + corners)[place])
            lows.append(low.to(grid.corner.dtype))
            numbers.append((cells.reshape(-1).cumsum(0, dtype=torch.int32) - 1).clamp(min=0).reshape(cells.shape))
            corners += int(stored.sum())
        self.first = len(lows[0])
        number = torch.where(self.owned, self.first + numbers[1], resample(numbers[0], len(self.owned)))
        self.register_buffer("number", number.reshape(-1), persistent=False)
        self.register_buffer("rows", torch.cat(rows), persistent=False)
        self.register_buffer("low", torch.cat(lows), persistent=False)
        return corners

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """As torch's; the state's cells have corners of their own from now on."""
        owned = state_dict.get(f"{prefix}owned")
        if owned is not None and not torch.equal(owned.cpu(), self.owned.cpu()):
            self.owned = owned.to(self.owned.device)
            self.table.data = self.table.new_zeros(self._lay_out(), self.table.shape[1])
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def _corners(cells: Tensor) -> Tensor:
    """(X + 1, Y + 1, Z + 1) bool: corners of cells (X, Y, Z) bool."""
    x, y, z = cells.shape
    corners = torch.zeros((x + 1, y + 1, z + 1), dtype=torch.bool, device=cells.device)
    for i, j, k in _CORNERS:
        corners[i : i + x, j : j + y, k : k + z] |= cells
    return corners


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
