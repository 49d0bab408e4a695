"""Sparse cells of a box, stored in bricks of 4 x 4 x 4, and the values at their corners (NSVF, Liu et al. 2020;
Plenoxels, Fridovich-Keil et al. 2022).

h      size of a cell: its edge, world units
K      bricks that are stored: those that hold an occupied cell, or a corner of one
row    of a cell, and of the values at its least corner: 64 * brick + 16 x + 4 y + z, with x, y, z in the brick
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor, nn

BRICK = 4
"""Cells along a brick."""
MAX_DISTANCE = 8
"""Distances between bricks are counted up to here."""
OFFSETS = torch.cartesian_prod(*[torch.arange(2)] * 3)
"""(8, 3) int64: the corners of a cell, or a brick and its upper neighbors; the last axis is the fastest."""


class BrickGrid(nn.Module):
    """Cubic cells, of which the occupied ones hold something.

    Its state holds the cells themselves: a checkpoint is rendered without the images that they were carved from.

    Args:
        aabb_min: (3,) float64, world units: the box's least coordinates.
        cell_size: h.
        cells: (X, Y, Z) bool: cells that are occupied.
        max_level: how often the cells may be subdivided.
    """

    aabb_min: Tensor
    cell_size: Tensor
    size: Tensor
    """(3,) int64: X, Y, Z."""
    bricks: Tensor
    """(K, 3) int64: position of each brick, in bricks."""
    occupied: Tensor
    """(K, 64) bool: cells that are occupied, by their row."""
    max_weight: Tensor
    """(64 K,) float32: largest weight in a ray's color that was seen in each cell since the last reset."""
    num_seen: Tensor
    """() int64: how many weights that were."""
    finest_size: Tensor
    """() float64: h at max_level, as it was planned."""
    level: Tensor
    """() int64: how often the cells have been subdivided, 0 .. max_level."""
    max_level: Tensor
    """() int64."""
    scene: Tensor
    """(32,) uint8: digest of the box and the cells at level 0."""
    neighbors: Tensor
    """(K, 8) int32: the brick itself and its upper neighbors, in the order of OFFSETS; -1: not stored."""
    numbers: Tensor
    """(BX + 1, BY + 1, BZ + 1) int32: number of every brick that is stored; -1: not stored."""
    table: Tensor
    """(BX, BY, BZ) int32: number of a brick in which a cell is sampled; else minus the distance, in bricks along the
    farthest axis, to the next."""
    sampled: Tensor
    """(K,) int64: bit i is set if the brick's cell i is sampled: all occupied cells, or those of them that are not
    transparent."""

    def __init__(self, aabb_min: Tensor, cell_size: float, cells: Tensor, max_level: int = 0) -> None:
        super().__init__()
        content = cells.numpy().tobytes() + aabb_min.double().numpy().tobytes() + str((cell_size, max_level)).encode()
        self.register_buffer("scene", torch.tensor(list(hashlib.sha256(content).digest()), dtype=torch.uint8))
        self.register_buffer("level", torch.tensor(0))
        self.register_buffer("max_level", torch.tensor(max_level))
        self.register_buffer("finest_size", torch.tensor(cell_size / 2**max_level, dtype=torch.float64))
        self.register_buffer("num_seen", torch.tensor(0))
        self.register_buffer("aabb_min", aabb_min.double())
        self.register_buffer("cell_size", torch.tensor(cell_size, dtype=torch.float64))
        self.register_buffer("size", torch.tensor(cells.shape))
        # a brick more at the upper end: for the corners of the last cells
        cells = F.pad(cells, [pad for size in reversed(cells.shape) for pad in (0, BRICK - size % BRICK)])
        corners = cells
        for axis in range(3):
            corners = corners | corners.roll(1, axis)
        self.register_buffer("bricks", torch.nonzero(_to_bricks(corners).flatten(3).any(dim=3)).contiguous())
        self.register_buffer("occupied", _to_bricks(cells).flatten(3)[tuple(self.bricks.T)])
        self.register_buffer("max_weight", torch.zeros(self.occupied.numel()))
        self._index_bricks()
        self.set_sampled(pack_bits(self.occupied))

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor]) -> BrickGrid:
        """The grid whose `state_dict` that is."""
        grid = cls(state["aabb_min"], 1.0, torch.zeros((1, 1, 1), dtype=torch.bool))
        for name in grid.state_dict():
            setattr(grid, name, state[name].clone(memory_format=torch.contiguous_format))
        grid._index_bricks()
        grid.set_sampled(grid.sampled)
        return grid

    def is_of_the_same_scene(self, other: BrickGrid) -> bool:
        """Whether both began with the same cells."""
        return bool((self.scene == other.scene).all())

    @property
    def num_rows(self) -> int:
        return self.occupied.numel()

    @property
    def shape(self) -> list[int]:
        """Bricks along each axis of the box."""
        return [size // BRICK + 1 for size in self.size.tolist()]

    def _index_bricks(self) -> None:
        """Derive `numbers` and `neighbors`."""
        device = self.bricks.device
        numbers = torch.full([size + 1 for size in self.shape], -1, dtype=torch.int32, device=device)
        numbers[tuple(self.bricks.T)] = torch.arange(len(self.bricks), dtype=torch.int32, device=device)
        upper = self.bricks[:, None] + OFFSETS.to(device)
        self.register_buffer("neighbors", numbers[tuple(upper.unbind(dim=2))].contiguous(), persistent=False)
        self.register_buffer("numbers", numbers, persistent=False)

    def set_sampled(self, sampled: Tensor) -> None:
        """Sample only some of the occupied cells, see `sampled`."""
        self.register_buffer("sampled", sampled)
        some = sampled != 0
        table = torch.zeros(self.shape, dtype=torch.bool, device=some.device)
        table[tuple(self.bricks[some].T)] = True
        distance = torch.zeros(self.shape, dtype=torch.int32, device=some.device)
        for _ in range(MAX_DISTANCE):
            distance += ~table
            table = dilate(table)
        distance.neg_()[tuple(self.bricks[some].T)] = torch.nonzero(some)[:, 0].int()
        self.register_buffer("table", distance, persistent=False)

    def update_max_weight(self, rows: Tensor, weights: Tensor) -> None:
        """Remember the weights (m,) of samples, by the rows (m,) int64 of their cells."""
        self.max_weight.scatter_reduce_(0, rows, weights.to(self.max_weight.dtype), "amax")
        self.num_seen += len(rows)

    def reset_max_weight(self) -> None:
        """Forget the weights seen so far."""
        self.max_weight.zero_()
        self.num_seen.zero_()

    def to_cells(self, rows: Tensor) -> Tensor:
        """(64 K,) bool by row -> (X, Y, Z) bool, the box's cells."""
        dense = torch.zeros((*self.shape, BRICK, BRICK, BRICK), dtype=torch.bool, device=rows.device)
        dense[tuple(self.bricks.T)] = rows.reshape(-1, BRICK, BRICK, BRICK)
        dense = dense.permute(0, 3, 1, 4, 2, 5).reshape([size * BRICK for size in self.shape])
        x, y, z = self.size.tolist()
        return dense[:x, :y, :z]

    def corner_rows(self, bricks: Tensor, cells: Tensor) -> Tensor:
        """(m, 8) int64: rows of the corners of cells, by their brick (m,) and number in it (m,), in the order of
        OFFSETS; -1 where a corner is not stored."""
        neighbor, corner = CORNERS.to(bricks.device)[cells].unbind(dim=2)
        brick = torch.gather(self.neighbors[bricks].long(), 1, neighbor)
        return torch.where(brick < 0, -1, 64 * brick + corner)

    def subdivide(self, kept: Tensor) -> BrickGrid:
        """The same box in cells half as large: the eight parts of those cells (X, Y, Z) bool that are kept."""
        finer = BrickGrid(self.aabb_min.cpu(), float(self.cell_size) / 2, upsample(kept).cpu()).to(kept.device)
        finer.level, finer.max_level = self.level + 1, self.max_level
        finer.finest_size, finer.scene = self.finest_size, self.scene
        return finer


def _corner_table() -> Tensor:
    """(64, 8, 2) int64: neighbor of OFFSETS, and cell in it, of the corners of a brick's cells."""
    cell = torch.cartesian_prod(*[torch.arange(BRICK)] * 3)[:, None] + OFFSETS
    base = torch.tensor([BRICK * BRICK, BRICK, 1])
    return torch.stack(((cell // BRICK * torch.tensor([4, 2, 1])).sum(2), (cell % BRICK * base).sum(2)), dim=2)


CORNERS = _corner_table()


def _to_bricks(cells: Tensor) -> Tensor:
    """(4 BX, 4 BY, 4 BZ) -> (BX, BY, BZ, 4, 4, 4)."""
    x, y, z = (size // BRICK for size in cells.shape)
    return cells.reshape(x, BRICK, y, BRICK, z, BRICK).permute(0, 2, 4, 1, 3, 5)


def pack_bits(cells: Tensor) -> Tensor:
    """(K, 64) bool -> (K,) int64."""
    return (cells * (1 << torch.arange(64, device=cells.device))).sum(dim=1)


def unpack_bits(numbers: Tensor) -> Tensor:
    """(K,) int64 -> (K, 64) bool."""
    return (numbers[:, None] >> torch.arange(64, device=numbers.device)) & 1 > 0


def dilate(cells: Tensor) -> Tensor:
    """(X, Y, Z) bool: cells and the 26 around each."""
    for axis in range(3):
        padding = [0, 0] * (2 - axis) + [1, 1] + [0, 0] * axis
        size, padded = cells.shape[axis], F.pad(cells, padding)
        cells = padded.narrow(axis, 0, size) | cells | padded.narrow(axis, 2, size)
    return cells


def upsample(cells: Tensor) -> Tensor:
    """(X, Y, Z) -> (2 X, 2 Y, 2 Z): every cell's value in its eight parts."""
    return cells.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)
