"""The cells of a box in which networks are evaluated, and the samples of rays in them, packed.

h      size of a cell: its edge, world units
n      rays
m      samples, of all rays one after the other; sample i lies on ray ray_indices[i], ascending
t      distance of a sample from its ray's origin, world units
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.occupancy.hull import Hull

MAX_OCCUPIED_CELLS = 2**18
"""More cost more time than they are worth in detail."""


@dataclass(frozen=True)
class Samples:
    """Where n rays are evaluated."""

    t: Tensor
    """(m,)."""
    ray_indices: Tensor
    """(m,) int64."""
    ray_starts: Tensor
    """(n,) int64: sample at which each ray begins."""
    positions: Tensor
    """(m, 3) world units."""
    cell_indices: Tensor
    """(m,) int64: flat index of the cell that each lies in."""


class OccupancyGrid(nn.Module):
    """Cubic cells of a box: those outside the hull are empty for good, of the others training prunes those without
    density.

    Its state holds the cells themselves: a checkpoint is rendered without the images that the hull was carved from.

    Args:
        aabb_min: (3,) world units: the box's least coordinates.
        cell_size: h.
        hull: (X, Y, Z) bool: cells of h / 2^coarsening that may hold something; none of the grid's outermost cells.
        max_level: how often the grid's cells may be subdivided.
        coarsening: how often the hull's cells are doubled to be the grid's.
    """

    aabb_min: Tensor
    cell_size: Tensor
    hull: Tensor
    occupied: Tensor
    """(X, Y, Z) bool: cells in which networks are evaluated."""
    max_density: Tensor
    """(X, Y, Z) largest density seen in each cell since the last pruning."""
    refined: Tensor
    """(X, Y, Z) bool: cells with features of their own level, see `FeatureGrid`."""
    level: Tensor
    """() int64: how often the cells have been subdivided, 0 .. max_level."""
    max_level: Tensor
    """() int64."""

    def __init__(
        self, aabb_min: Tensor, cell_size: float, hull: Tensor, max_level: int = 0, coarsening: int = 0
    ) -> None:
        super().__init__()
        shape = [size // 2**coarsening for size in hull.shape]
        self.register_buffer("aabb_min", aabb_min.float())
        self.register_buffer("cell_size", torch.tensor(cell_size, dtype=torch.float32))
        self.register_buffer("hull", hull.clone())
        self.register_buffer("occupied", resample(hull, shape[0]))
        self.register_buffer("max_density", torch.zeros(shape))
        self.register_buffer("refined", torch.zeros(shape, dtype=torch.bool))
        self.register_buffer("level", torch.tensor(0))
        self.register_buffer("max_level", torch.tensor(max_level))

    @classmethod
    def from_hull(cls, hull: Hull, max_level: int = 0, coarsening: int = 0) -> OccupancyGrid:
        """The hull's cells, or 2^coarsening times as large ones that hold any of them; all occupied, with an empty rim
        for what rounding puts outside the box."""
        rim = 2**coarsening
        ends = [rim + -size % rim for size in reversed(hull.cells.shape)]
        cells = F.pad(torch.from_numpy(hull.cells), [size for end in ends for size in (rim, end)])
        return cls(
            torch.from_numpy(hull.aabb_min - rim * hull.cell_size), rim * hull.cell_size, cells, max_level, coarsening
        )

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor]) -> OccupancyGrid:
        """The grid whose `state_dict` that is."""
        grid = cls(state["aabb_min"], float(state["cell_size"]), state["hull"])
        for name in grid.state_dict():
            setattr(grid, name, state[name].clone())
        return grid

    @property
    def initial_cell_size(self) -> Tensor:
        """h at level 0."""
        return self.cell_size * 2**self.level

    @property
    def static_mask(self) -> Tensor:
        """(X, Y, Z) bool: cells that hold any of the hull; the others are never occupied."""
        return self.static_mask_at(int(self.level))

    def static_mask_at(self, level: int) -> Tensor:
        """The static mask when the cells have been subdivided so often."""
        return resample(self.hull, (len(self.occupied) << level) >> int(self.level))

    def is_of_the_same_scene(self, other: OccupancyGrid) -> bool:
        """Whether both began with the same cells, whatever has been pruned and subdivided since."""
        initial = [
            (grid.aabb_min, grid.initial_cell_size, grid.hull, grid.max_level, grid.static_mask_at(0))
            for grid in (self, other)
        ]
        return all(torch.equal(one.cpu(), another.cpu()) for one, another in zip(*initial, strict=True))

    def subdivide(self) -> None:
        """Halve all cells along every axis."""
        self.occupied = upsample(self.occupied) & self.static_mask_at(int(self.level) + 1)
        self.max_density, self.refined = upsample(self.max_density), upsample(self.refined)
        self.cell_size = self.cell_size / 2
        self.level = self.level + 1

    @property
    def center(self) -> Tensor:
        """(3,) the box's center, world units."""
        return self.aabb_min + self.cell_size * torch.tensor(self.occupied.shape, device=self.aabb_min.device) / 2

    @property
    def half_extent(self) -> Tensor:
        """Half the box's longest edge, world units."""
        return self.cell_size * max(self.occupied.shape) / 2

    def locate(self, positions: Tensor) -> Tensor:
        """(m, 3) world units -> (m,) int64 flat index of the cell; one of the rim's where outside the box."""
        at = (positions - self.aabb_min) / self.cell_size
        size = torch.tensor(self.occupied.shape, device=at.device)
        at = torch.minimum(at.floor().long().clamp(min=0), size - 1)
        return (at[:, 0] * size[1] + at[:, 1]) * size[2] + at[:, 2]

    def contains(self, positions: Tensor) -> Tensor:
        """(m,) bool: whether positions (m, 3) are in occupied cells."""
        return self.occupied.reshape(-1)[self.locate(positions)]

    def march(
        self, rays: RayBundle, step: float, jitter: Tensor | None, depths: tuple[float, float] = (0, float("inf"))
    ) -> Samples:
        """Samples a step apart (world units) wherever a ray is in an occupied cell.

        Args:
            jitter: (n, 1) in [0, 1): share of a step before the first sample; None: half a step.
            depths: near and far along the camera's axis, world units.
        """
        norm = rays.metadata["directions_norm"]
        begin, end = self._span(rays)
        begin, end = torch.maximum(begin, depths[0] * norm), torch.minimum(end, depths[1] * norm)
        longest = float((end - begin).clamp(min=0).max()) if len(rays) else 0.0
        count = int(np.ceil(longest / step)) + 1
        t = begin + (torch.arange(count, device=begin.device) + (0.5 if jitter is None else jitter)) * step
        inside = t < end
        within = torch.minimum(t, end)  # beyond the end, cell indices would overflow
        cell = torch.zeros(t.shape, dtype=torch.int64, device=t.device)
        origin, direction = (rays.origins - self.aabb_min) / self.cell_size, rays.directions / self.cell_size
        for axis, size in enumerate(self.occupied.shape):
            at = torch.addcmul(origin[:, axis : axis + 1], within, direction[:, axis : axis + 1])
            cell = cell * size + at.long().clamp_(0, size - 1)
        inside &= self.occupied.reshape(-1)[cell]
        packed = torch.nonzero(inside.reshape(-1))[:, 0]
        ray_indices = torch.div(packed, count, rounding_mode="floor")
        counts = inside.sum(dim=1)
        t = t.reshape(-1)[packed]
        positions = torch.addcmul(rays.origins[ray_indices], t[:, None], rays.directions[ray_indices])
        return Samples(t, ray_indices, counts.cumsum(0) - counts, positions, cell.reshape(-1)[packed])

    def _span(self, rays: RayBundle) -> tuple[Tensor, Tensor]:
        """Distances at which rays enter and leave the box, (n, 1) each; a ray that misses leaves before it enters."""
        far = self.aabb_min + self.cell_size * torch.tensor(self.occupied.shape, device=self.aabb_min.device)
        inverse = 1 / torch.where(rays.directions == 0, 1e-12, rays.directions)
        one, other = (self.aabb_min - rays.origins) * inverse, (far - rays.origins) * inverse
        begin = torch.minimum(one, other).amax(dim=1, keepdim=True).clamp(min=0)
        return begin, torch.maximum(one, other).amin(dim=1, keepdim=True)

    @torch.no_grad()
    def update_max_density(self, samples: Samples, density: Tensor) -> None:
        """Keep the largest density seen in each cell, by the densities (m,) of samples."""
        self.max_density.view(-1).scatter_reduce_(0, samples.cell_indices, density.detach(), "amax")

    @torch.no_grad()
    def prune(self, min_density: float, reactivated: Tensor) -> Tensor:
        """Keep occupied only cells where more than min_density was seen since the last pruning, their neighbors (a
        surface may move), and those to be reactivated, (X, Y, Z) bool. Returns the former two, (X, Y, Z) bool.
        """
        dense = dilate(self.max_density > min_density) & self.static_mask
        self.occupied.copy_(dense | (reactivated & self.static_mask))
        self.max_density.zero_()
        return dense


def dilate(cells: Tensor) -> Tensor:
    """(X, Y, Z) bool: cells and the 26 around each; the outermost must be empty."""
    for axis in range(3):
        cells = cells | cells.roll(1, axis) | cells.roll(-1, axis)
    return cells


def upsample(cells: Tensor) -> Tensor:
    """(X, Y, Z) -> (2 X, 2 Y, 2 Z): every cell's value in its eight parts."""
    return cells.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)


def resample(cells: Tensor, length: int) -> Tensor:
    """(X, Y, Z) -> the same box in cells of another size, `length` of them along x: smaller ones have the value of the
    cell around them; larger ones, of bool alone, are true where any of their parts is."""
    while len(cells) < length:
        cells = upsample(cells)
    while len(cells) > length:
        x, y, z = cells.shape
        cells = cells.reshape(x // 2, 2, y // 2, 2, z // 2, 2).any(5).any(3).any(1)
    return cells
