"""A grid's cells, subdivided (NSVF, Liu et al. 2020; Plenoxels, Fridovich-Keil et al. 2022)."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from edge_se_sampler.occupancy.bricks import BRICK, BrickGrid


def subdivide(grid: BrickGrid, kept: Tensor, cell_size: float) -> BrickGrid:
    """The same box in smaller cells, their size, in world units, at least a quarter of the grid's. Occupied are those
    whose center is in an occupied cell, and that are in, or next to one in, cells (X, Y, Z) bool that are kept."""
    ratio = cell_size / float(grid.cell_size)
    size = torch.ceil(grid.size / ratio - 1e-6).long()
    bricks, occupied = _find_bricks(kept, ratio, size), []
    parents = grid.to_cells(grid.occupied.reshape(-1))
    window = torch.arange(-1, BRICK + 1, device=kept.device)  # a brick's cells along an axis, and one around
    for some in bricks.split(2**13):
        cells = BRICK * some[:, None] + window[:, None]
        parent = torch.minimum(((cells.clamp(min=0) + 0.5) * ratio).long(), grid.size - 1)
        x, y, z = parent.unbind(dim=2)
        where = x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]
        around = kept[where]
        for axis in (1, 2, 3):
            lower, middle, upper = (around.narrow(axis, i, BRICK) for i in range(3))
            around = lower | middle | upper
        inner = (parents[where] & _in_box(cells, size))[:, 1:-1, 1:-1, 1:-1]
        occupied.append((around & inner).flatten(1))
    occupied = torch.cat(occupied)
    some = occupied.any(dim=1)
    scene = int(grid.max_level), int(grid.num_pixels), grid.focus
    finer = BrickGrid(grid.aabb_min, cell_size, size.tolist(), bricks[some], occupied[some], *scene).to(kept.device)
    finer.level, finer.finest_size, finer.scene = grid.level + 1, grid.finest_size, grid.scene
    return finer


def _find_bricks(kept: Tensor, ratio: float, size: Tensor) -> Tensor:
    """(k, 3) positions of the bricks of smaller cells, see `subdivide`, in which some may be occupied."""
    found = torch.zeros((size // BRICK + 1).tolist(), dtype=torch.bool, device=kept.device)
    cells = torch.nonzero(kept)
    first, last = (cells / ratio).long() - 1, ((cells + 1) / ratio).long() + 1  # at most seven, in three bricks
    ends = [torch.minimum(end.clamp(min=0), size - 1) // BRICK for end in (first, (first + last) // 2, last)]
    for x, y, z in itertools.product(ends, repeat=3):
        found[x[:, 0], y[:, 1], z[:, 2]] = True
    return torch.nonzero(found)


def _in_box(cells: Tensor, size: Tensor) -> Tensor:
    """(k, n, n, n) bool: cells of the coordinates (k, n, 3) along each axis that are not beyond a size (3,)."""
    x, y, z = (cells < size).unbind(dim=2)
    return x[:, :, None, None] & y[:, None, :, None] & z[:, None, None, :]
