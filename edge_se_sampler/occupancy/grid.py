"""Which cells of a box are worth asking the network about, and the samples of rays in them, packed.

h      side of a cell, world units
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
"""More cost more than they tell: with four times as many, bricks at 400 pixels ends after 100 CPU seconds at 33.14 dB,
not 34.41."""


@dataclass(frozen=True)
class Samples:
    """Where n rays are to be evaluated."""

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
    """Cells of a box; those outside the hull are empty for ever, those inside as long as no density is seen there.

    Its state has the cells themselves: a checkpoint needs no images to be rendered.

    Args:
        corner: (3,) world units: where the box has its least coordinates.
        side: h.
        hull: (X, Y, Z) bool: what may hold something, in cells of h, or its half, its quarter, ...; none of the grid's
            outermost cells.
        splits: how often the grid's cells may be upsample along every axis.
        coarser: how often the hull's cells have to be doubled to be the grid's.
    """

    corner: Tensor
    side: Tensor
    hull: Tensor
    occupied: Tensor
    largest: Tensor
    """(X, Y, Z) density seen in each cell since the last judgement."""
    splits: Tensor
    """(2,) int64: how often cells have been split, and how often they still may be."""

    def __init__(self, corner: Tensor, side: float, hull: Tensor, splits: int = 0, coarser: int = 0) -> None:
        super().__init__()
        shape = [size // 2**coarser for size in hull.shape]
        self.register_buffer("corner", corner.float())
        self.register_buffer("side", torch.tensor(side, dtype=torch.float32))
        self.register_buffer("hull", hull.clone())
        self.register_buffer("occupied", resample(hull, shape[0]))
        self.register_buffer("largest", torch.zeros(shape))
        self.register_buffer("splits", torch.tensor((0, splits)))

    @classmethod
    def of(cls, hull: Hull, splits: int = 0, coarser: int = 0) -> OccupancyGrid:
        """The hull's cells, or so much larger ones that have any of them, all occupied, with an empty rim: what
        rounding puts outside of the box is in none."""
        rim = 2**coarser
        ends = [rim + -size % rim for size in reversed(hull.cells.shape)]
        cells = F.pad(torch.from_numpy(hull.cells), [size for end in ends for size in (rim, end)])
        return cls(torch.from_numpy(hull.corner - rim * hull.side), rim * hull.side, cells, splits, coarser)

    @property
    def first_side(self) -> Tensor:
        """h before any split."""
        return self.side * 2 ** self.splits[0]

    @property
    def finest_side(self) -> Tensor:
        """h after the last split that there may be."""
        return self.side / 2 ** self.splits[1]

    @property
    def possible(self) -> Tensor:
        """(X, Y, Z) bool: cells that have anything of the hull."""
        return self.possible_after(int(self.splits[0]))

    def possible_after(self, splits: int) -> Tensor:
        """The same when they have been split so often, since the first."""
        return resample(self.hull, (len(self.occupied) << splits) >> int(self.splits[0]))

    @classmethod
    def at_first(cls, state: Mapping[str, Tensor]) -> tuple[OccupancyGrid, int]:
        """What the grid of a state was before any judgement, and how often its cells have been split since."""
        done, left = state["splits"].tolist()
        coarser = (len(state["hull"]) * 2**done // len(state["occupied"])).bit_length() - 1
        return cls(state["corner"], float(state["side"]) * 2**done, state["hull"], done + left, coarser), done

    def is_the_same_as(self, other: OccupancyGrid) -> bool:
        """Whether both have the same cells, split as often."""
        told = ("corner", "side", "hull", "splits")
        same = self.occupied.shape == other.occupied.shape
        return same and all(torch.equal(getattr(self, key).cpu(), getattr(other, key).cpu()) for key in told)

    def split(self) -> None:
        """Halve all cells along every axis."""
        self.occupied = upsample(self.occupied) & self.possible_after(int(self.splits[0]) + 1)
        self.largest = upsample(self.largest)
        self.side = self.side / 2
        self.splits = self.splits + torch.tensor((1, -1), device=self.splits.device)

    @property
    def middle(self) -> Tensor:
        """(3,) of the box."""
        return self.corner + self.side * torch.tensor(self.occupied.shape, device=self.corner.device) / 2

    @property
    def reach(self) -> Tensor:
        """Half the longest edge of the box."""
        return self.side * max(self.occupied.shape) / 2

    def locate(self, positions: Tensor) -> Tensor:
        """(m, 3) world units -> (m,) int64 number of the cell; the rim's where it is outside of the box."""
        at = (positions - self.corner) / self.side
        size = torch.tensor(self.occupied.shape, device=at.device)
        at = torch.minimum(at.floor().long().clamp(min=0), size - 1)
        return (at[:, 0] * size[1] + at[:, 1]) * size[2] + at[:, 2]

    def contains(self, positions: Tensor) -> Tensor:
        """(m,) bool: positions (m, 3) in occupied cells."""
        return self.occupied.reshape(-1)[self.locate(positions)]

    def march(
        self, rays: RayBundle, step: float, jitter: Tensor | None, depths: tuple[float, float] = (0, float("inf"))
    ) -> Samples:
        """Samples a step apart wherever a ray is in an occupied cell.

        Args:
            step: world units.
            jitter: (n, 1) in [0, 1): where in the first step a ray begins; None: in its middle.
            depths: least and greatest along the camera's axis, world units.
        """
        norm = rays.metadata["directions_norm"]
        begin, end = self._span(rays)
        begin, end = torch.maximum(begin, depths[0] * norm), torch.minimum(end, depths[1] * norm)
        longest = float((end - begin).clamp(min=0).max()) if len(rays) else 0.0
        count = int(np.ceil(longest / step)) + 1
        t = begin + (torch.arange(count, device=begin.device) + (0.5 if jitter is None else jitter)) * step
        inside = t < end
        within = torch.minimum(t, end)  # beyond, cell numbers would mean nothing
        cell = torch.zeros(t.shape, dtype=torch.int64, device=t.device)
        origin, direction = (rays.origins - self.corner) / self.side, rays.directions / self.side
        for axis, size in enumerate(self.occupied.shape):
            at = torch.addcmul(origin[:, axis : axis + 1], within, direction[:, axis : axis + 1])
            cell = cell * size + at.long().clamp_(0, size - 1)
        inside &= self.occupied.reshape(-1)[cell]
        packed = torch.nonzero(inside.reshape(-1))[:, 0]
        ray = torch.div(packed, count, rounding_mode="floor")
        number = inside.sum(dim=1)
        t = t.reshape(-1)[packed]
        positions = torch.addcmul(rays.origins[ray], t[:, None], rays.directions[ray])
        return Samples(t, ray, number.cumsum(0) - number, positions, cell.reshape(-1)[packed])

    def _span(self, rays: RayBundle) -> tuple[Tensor, Tensor]:
        """Where rays enter and leave the box, (n, 1) each; the end is not after the beginning for those that miss."""
        far = self.corner + self.side * torch.tensor(self.occupied.shape, device=self.corner.device)
        inverse = 1 / torch.where(rays.directions == 0, 1e-12, rays.directions)
        one, other = (self.corner - rays.origins) * inverse, (far - rays.origins) * inverse
        begin = torch.minimum(one, other).amax(dim=1, keepdim=True).clamp(min=0)
        return begin, torch.maximum(one, other).amin(dim=1, keepdim=True)

    @torch.no_grad()
    def remember(self, samples: Samples, density: Tensor) -> None:
        """Take note of the densities (m,) that training has seen, the largest of each cell."""
        self.largest.view(-1).scatter_reduce_(0, samples.cell_indices, density.detach(), "amax")

    @torch.no_grad()
    def judge(self, empty: float, again: Tensor) -> Tensor:
        """Occupied are from now on the cells where a density above `empty` was seen since the last judgement, their
        neighbours, so that a surface may move, and those to be tried again.

        Args:
            again: (X, Y, Z) bool: cells to be tried whatever was seen.

        Returns:
            (X, Y, Z) bool: the cells that are not occupied for a trial alone.
        """
        near = dilate(self.largest > empty)
        self.occupied.copy_((near | again) & self.possible)
        self.largest.zero_()
        return near & self.possible


def dilate(cells: Tensor) -> Tensor:
    """Cells (X, Y, Z) bool, and the 26 around each; none of them in the outermost."""
    for axis in range(3):
        cells = cells | cells.roll(1, axis) | cells.roll(-1, axis)
    return cells


def upsample(cells: Tensor) -> Tensor:
    """(X, Y, Z) -> (2 X, 2 Y, 2 Z): each cell's value for its eight parts."""
    return cells.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)


def resample(cells: Tensor, length: int) -> Tensor:
    """(X, Y, Z): the same space in cells of another size, `length` of them along x: parts of each; or, of bool, those
    that have any of them."""
    while len(cells) < length:
        cells = upsample(cells)
    while len(cells) > length:
        x, y, z = cells.shape
        cells = cells.reshape(x // 2, 2, y // 2, 2, z // 2, 2).any(5).any(3).any(1)
    return cells
