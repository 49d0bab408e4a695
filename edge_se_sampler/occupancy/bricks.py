"""Sparse cells of a box, stored in bricks of 4 x 4 x 4, and the values at their corners (NSVF, Liu et al. 2020;
Plenoxels, Fridovich-Keil et al. 2022).

h      size of a cell: its edge, world units
K      bricks that are stored: those that hold an occupied cell, or a corner of one
row    of a cell, and of the values at its least corner: 64 * brick + 16 x + 4 y + z, with x, y, z in the brick
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from edge_se_sampler import ranks
from edge_se_sampler.devices import exact_type

BRICK = 4
"""Cells along a brick."""
MAX_DISTANCE = 8
"""Distances between bricks are counted up to here."""
EXACT = ("aabb_min", "cell_size", "finest_size", "focus")
"""What a grid has in float64: it stays on the CPU, and keeps its type."""
OFFSETS = torch.cartesian_prod(*[torch.arange(2)] * 3)
"""(8, 3) int64: the corners of a cell, or a brick and its upper neighbors; the last axis is the fastest."""


class BrickGrid(nn.Module):
    """Cubic cells, of which the occupied ones hold something.

    Its state holds the cells themselves: a checkpoint is rendered without the images that they were carved from.

    Args:
        aabb_min: (3,) float64, world units: the box's least coordinates.
        cell_size: h.
        size: cells along each axis of the box.
        bricks: (k, 3) int64: positions of the bricks that hold occupied cells, in bricks.
        occupied: (k, 64) bool: which of their cells are.
        max_level: how often the cells may be subdivided.
        num_pixels: pixels of the training images that show something of the scene.
        focus: (5,) float64, world units: the point that the training views look at; what share of the way to it has
            nothing in it that they see; and how far away from it they are at most.
    """

    is_carved_close: bool = False
    """Whether masks that show all of an object have left few cells around it; not in the state."""

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
    """() float64: h at the max_level with which training begins, were cells always halved."""
    level: Tensor
    """() int64: how often the cells have been subdivided, 0 .. max_level."""
    max_level: Tensor
    """() int64: how often they are to be, less once there turn out to be too many."""
    num_pixels: Tensor
    """() int64."""
    focus: Tensor
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
    sampled_bricks: Tensor
    """(s, 3) int64: position, in bricks, of each in which a cell is sampled."""

    def __init__(
        self,
        aabb_min: Tensor,
        cell_size: float,
        size: Sequence[int],
        bricks: Tensor,
        occupied: Tensor,
        max_level: int,
        num_pixels: int,
        focus: Tensor | None = None,
    ) -> None:
        super().__init__()
        content = [values.cpu().numpy().tobytes() for values in (aabb_min.cpu().double(), bricks, occupied)]
        digest = hashlib.sha256(b"".join(content) + str((cell_size, *size, max_level, num_pixels)).encode()).digest()
        self.register_buffer("scene", torch.tensor(list(digest), dtype=torch.uint8))
        self.register_buffer("level", torch.tensor(0))
        self.register_buffer("max_level", torch.tensor(max_level))
        self.register_buffer("num_pixels", torch.tensor(num_pixels))
        self.register_buffer("finest_size", torch.tensor(cell_size / 2**max_level, dtype=torch.float64))
        self.register_buffer("num_seen", torch.tensor(0))
        self.register_buffer("aabb_min", aabb_min.cpu().double())
        self.register_buffer("cell_size", torch.tensor(cell_size, dtype=torch.float64))
        self.register_buffer("size", torch.tensor(size))
        self.register_buffer("focus", torch.zeros(5).double() if focus is None else focus.cpu().double())
        self.register_buffer("bricks", self._bricks_of_corners(bricks, occupied))
        self._index_bricks()
        stored = torch.zeros((len(self.bricks), BRICK**3), dtype=torch.bool, device=bricks.device)
        stored[self.numbers[tuple(bricks.T)].long()] = occupied
        self.register_buffer("occupied", stored)
        self.register_buffer("max_weight", torch.zeros(stored.numel(), device=bricks.device))
        self.set_sampled(pack_bits(stored))

    @classmethod
    def from_cells(
        cls,
        aabb_min: Tensor,
        cell_size: float,
        cells: Tensor,
        max_level: int = 0,
        num_pixels: int = 0,
        focus: Tensor | None = None,
    ) -> BrickGrid:
        """A box's cells (X, Y, Z) bool, of which those are occupied."""
        padded = F.pad(cells, [pad for size in reversed(cells.shape) for pad in (0, -size % BRICK)])
        x, y, z = (size // BRICK for size in padded.shape)
        blocks = padded.reshape(x, BRICK, y, BRICK, z, BRICK).permute(0, 2, 4, 1, 3, 5).flatten(3)
        bricks = torch.nonzero(blocks.any(dim=3))
        return cls(aabb_min, cell_size, cells.shape, bricks, blocks[tuple(bricks.T)], max_level, num_pixels, focus)

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor]) -> BrickGrid:
        """The grid whose `state_dict` that is."""
        grid = cls.from_cells(state["aabb_min"], 1.0, torch.zeros((1, 1, 1), dtype=torch.bool))
        state = {"focus": grid.focus, **state}  # earlier versions had none
        for name in grid.state_dict():
            setattr(grid, name, state[name].clone(memory_format=torch.contiguous_format))
        grid._index_bricks()
        grid.set_sampled(grid.sampled)
        return grid

    def _load_from_state_dict(self, *arguments: Any, **options: Any) -> None:
        state, prefix = arguments[:2]
        state.setdefault(f"{prefix}focus", self.focus)  # earlier versions had none
        super()._load_from_state_dict(*arguments, **options)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> BrickGrid:
        """Move to another device, but for `EXACT`, which some do not have."""
        kept: dict[str, Tensor | None] = {name: self._buffers[name] for name in EXACT}
        self._buffers.update(dict.fromkeys(EXACT))
        super()._apply(fn, recurse)
        self._buffers.update(kept)
        return self

    def is_of_the_same_scene(self, other: BrickGrid) -> bool:
        """Whether both began with the same cells."""
        return bool((self.scene == other.scene).all())

    def empty_depth(self, origins: Tensor) -> Tensor:
        """(n,) world units: the depth up to which nothing is in rays from there, by the `focus`. Right before a camera,
        where no other image tells, training would put a picture of its image, which other views see as floaters."""
        *focus, share, farthest = self.focus.tolist()
        if not share:
            return origins.new_zeros(len(origins))
        return share * (origins - origins.new_tensor(focus)).norm(dim=1).clamp(max=farthest)

    @property
    def num_rows(self) -> int:
        return self.occupied.numel()

    @property
    def shape(self) -> list[int]:
        """Bricks along each axis of the box."""
        return [size // BRICK + 1 for size in self.size.tolist()]

    def _bricks_of_corners(self, bricks: Tensor, occupied: Tensor) -> Tensor:
        """(K, 3) positions of bricks in which a corner of an occupied cell lies, ascending."""
        found = torch.zeros(self.shape, dtype=torch.bool, device=bricks.device)
        cells = occupied.reshape(-1, BRICK, BRICK, BRICK)
        for upper in OFFSETS.to(bricks.device):
            x, y, z = (slice(-1, None) if at_end else slice(None) for at_end in upper.tolist())
            found[tuple((bricks[cells[:, x, y, z].flatten(1).any(dim=1)] + upper).T)] = True
        return torch.nonzero(found).contiguous()

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
        self.register_buffer("sampled_bricks", self.bricks[some], persistent=False)
        table = torch.zeros(self.shape, dtype=torch.bool, device=some.device)
        table[tuple(self.sampled_bricks.T)] = True
        distance = torch.zeros(self.shape, dtype=torch.uint8, device=some.device)
        for _ in range(MAX_DISTANCE):
            distance += ~table
            table = dilate(table)
        table = distance.int().neg_()
        table[tuple(self.sampled_bricks.T)] = torch.nonzero(some)[:, 0].int()
        self.register_buffer("table", table, persistent=False)

    def update_max_weight(self, rows: Tensor, weights: Tensor) -> None:
        """Remember the weights (m,) of samples, by the rows (m,) int64 of their cells; and those of all ranks."""
        self.max_weight.scatter_reduce_(0, rows, weights.to(self.max_weight.dtype), "amax")
        ranks.find_largest(self.max_weight)
        self.num_seen += ranks.add_up(torch.tensor(len(rows)))

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

    def coordinates(self, rows: Tensor) -> Tensor:
        """(m, 3) int64: coordinates of cells, by their rows (m,), in the box."""
        cell = rows % BRICK**3
        return BRICK * self.bricks[rows // BRICK**3] + torch.stack((cell // 16, cell // 4 % 4, cell % 4), dim=1)

    def corner_rows(self, bricks: Tensor, cells: Tensor) -> Tensor:
        """(m, 8) int64: rows of the corners of cells, by their brick (m,) and number in it (m,), in the order of
        OFFSETS; -1 where a corner is not stored."""
        neighbor, corner = CORNERS.to(bricks.device)[cells].unbind(dim=2)
        brick = torch.gather(self.neighbors[bricks].long(), 1, neighbor)
        return torch.where(brick < 0, -1, 64 * brick + corner)

    def has_all_corners(self) -> bool:
        """Whether the corners of all occupied cells are stored, without which compiled kernels must not be called."""
        cells = self.occupied.unflatten(1, (BRICK,) * 3)
        for upper, neighbor in zip(OFFSETS.tolist(), self.neighbors.unbind(dim=1), strict=True):
            x, y, z = (slice(-1, None) if is_upper else slice(None) for is_upper in upper)
            if (cells[:, x, y, z].flatten(1).any(dim=1) & (neighbor < 0)).any():
                return False
        return True

    def find_corners(self, cells: Tensor) -> Tensor:
        """(64 K,) bool: the rows of corners of those of the occupied cells, (K, 64) bool."""
        found = torch.zeros(self.num_rows, dtype=torch.bool, device=cells.device)
        for some in torch.arange(len(cells), device=cells.device).split(2**13):
            brick, cell = torch.nonzero(cells[some], as_tuple=True)
            found[self.corner_rows(some[brick], cell)] = True
        return found

    def to_cell_units(self, positions: Tensor) -> Tensor:
        """Positions (m, 3), world units, in sides of a cell from the box's least coordinates; float64, where their
        device has it."""
        device = positions.device
        corner, cell_size = (x.to(device, exact_type(device)) for x in (self.aabb_min, self.cell_size))
        return (positions - corner) / cell_size

    def contains(self, positions: Tensor) -> Tensor:
        """(m,) bool: whether positions (m, 3), world units, are in occupied cells."""
        cell = self.to_cell_units(positions).floor().long()
        inside = ((cell >= 0) & (cell < self.size)).all(dim=1)
        brick = self.numbers[tuple(torch.where(inside[:, None], cell // BRICK, -1).T)].long()  # -1: none of the bricks
        inside = brick >= 0
        x, y, z = (cell[inside] % BRICK).unbind(dim=1)
        return inside.masked_scatter(inside, self.occupied[brick[inside], (x * BRICK + y) * BRICK + z])


def _corner_table() -> Tensor:
    """(64, 8, 2) int64: neighbor of OFFSETS, and cell in it, of the corners of a brick's cells."""
    cell = torch.cartesian_prod(*[torch.arange(BRICK)] * 3)[:, None] + OFFSETS
    base = torch.tensor([BRICK * BRICK, BRICK, 1])
    return torch.stack(((cell // BRICK * torch.tensor([4, 2, 1])).sum(2), (cell % BRICK * base).sum(2)), dim=2)


CORNERS = _corner_table()


def pack_bits(cells: Tensor) -> Tensor:
    """(K, 64) bool -> (K,) int64."""
    return (cells * (1 << torch.arange(64, device=cells.device))).sum(dim=1)


def unpack_bits(numbers: Tensor) -> Tensor:
    """(K,) int64 -> (K, 64) bool."""
    return (numbers[:, None] >> torch.arange(64, device=numbers.device)) & 1 > 0


def dilate(cells: Tensor) -> Tensor:
    """(X, Y, Z) bool: cells and the 26 around each."""
    for axis in range(3):
        rest, dilated = cells.shape[axis] - 1, cells.clone()
        dilated.narrow(axis, 1, rest).logical_or_(cells.narrow(axis, 0, rest))
        dilated.narrow(axis, 0, rest).logical_or_(cells.narrow(axis, 1, rest))
        cells = dilated
    return cells
