"""Sparse cells in bricks: what is stored, where a cell and its corners are, and how cells are subdivided."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from edge_se_sampler.occupancy.bricks import BRICK, MAX_DISTANCE, OFFSETS, BrickGrid, dilate, unpack_bits
from edge_se_sampler.occupancy.subdivision import subdivide


def random_cells(share: float = 0.02, shape: tuple[int, int, int] = (21, 9, 14)) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(0).random(shape) < share)


def grid_of(cells: torch.Tensor, max_level: int = 2) -> BrickGrid:
    return BrickGrid.from_cells(torch.tensor([-1.0, 0.0, 2.0]), 0.5, cells, max_level)


@pytest.mark.parametrize("share", [0.001, 0.02, 1.0])
def test_rows_and_cells_are_the_same_cells(share: float) -> None:
    cells = random_cells(share)
    grid = grid_of(cells)
    assert torch.equal(grid.to_cells(grid.occupied.reshape(-1)), cells)
    assert int(grid.occupied.sum()) == int(cells.sum())
    bits = [[(number >> i) & 1 for i in range(64)] for number in grid.sampled.tolist()]
    assert torch.equal(torch.tensor(bits, dtype=torch.bool), grid.occupied)
    assert torch.equal(unpack_bits(grid.sampled), grid.occupied)


def test_every_corner_of_an_occupied_cell_has_a_row_of_its_own() -> None:
    cells = random_cells()
    grid = grid_of(cells)
    brick, cell = torch.nonzero(grid.occupied, as_tuple=True)
    rows = grid.corner_rows(brick, cell)
    assert rows.min() >= 0
    assert torch.equal(rows[:, 0], 64 * brick + cell)
    in_brick = torch.cartesian_prod(*[torch.arange(BRICK)] * 3)
    position = (BRICK * grid.bricks[:, None] + in_brick).reshape(-1, 3)  # of each row
    expected = position[rows[:, 0]][:, None] + OFFSETS
    assert torch.equal(position[rows], expected)


@pytest.mark.parametrize("share", [0.001, 0.02, 1.0])
def test_a_brick_without_which_a_corner_is_missing_is_missed(share: float) -> None:
    grid = grid_of(random_cells(share))
    assert grid.has_all_corners()
    found = []
    for k in range(len(grid.bricks)):
        kept = torch.arange(len(grid.bricks)) != k
        state = grid.state_dict()
        for name in ("bricks", "occupied", "sampled"):
            state[name] = state[name][kept]
        state["max_weight"] = state["max_weight"].view(-1, 64)[kept].reshape(-1)
        fewer = BrickGrid.from_state(state)
        rows = fewer.corner_rows(*torch.nonzero(fewer.occupied, as_tuple=True))
        assert fewer.has_all_corners() == bool((rows >= 0).all())
        found.append(fewer.has_all_corners())
    assert not all(found)


def test_no_brick_is_stored_that_has_neither_a_cell_nor_a_corner() -> None:
    cells = torch.zeros((40, 40, 40), dtype=torch.bool)
    cells[17, 18, 19] = True  # at the upper end of its brick along z alone
    grid = grid_of(cells)
    assert sorted(map(tuple, grid.bricks.tolist())) == [(4, 4, 4), (4, 4, 5)]


def test_smaller_cells_and_a_state_keep_the_focus_which_earlier_versions_lack() -> None:
    cells, focus = random_cells(), torch.tensor([1.0, 2.0, 3.0, 0.45, 9.0], dtype=torch.float64)
    grid = BrickGrid.from_cells(torch.zeros(3), 0.5, cells, 2, focus=focus)
    state = grid.state_dict()
    for other in (subdivide(grid, cells, 0.25), BrickGrid.from_state(state)):
        assert torch.equal(other.focus, focus)
    del state["focus"]
    before = BrickGrid.from_state(state)
    before.load_state_dict(state)
    assert before.focus.tolist() == [0] * 5


def test_the_table_has_bricks_or_the_distance_to_the_next() -> None:
    cells = torch.zeros((80, 8, 8), dtype=torch.bool)
    cells[20, 0, 0] = True
    grid = grid_of(cells)
    along = grid.table[:, 0, 0].tolist()
    assert grid.bricks[along[5]].tolist() == [5, 0, 0]
    assert [-entry for entry in along[6:]] == [min(MAX_DISTANCE, i - 5) for i in range(6, len(along))]
    assert int(grid.table[4, 1, 1]) == -1


@pytest.mark.parametrize("ratio", [0.25, 0.3, 0.5, 0.8])
def test_smaller_cells_are_those_in_and_next_to_what_is_kept(ratio: float) -> None:
    cells = random_cells(0.1)
    kept = cells & random_cells(0.5)
    finer = subdivide(grid_of(cells), kept, 0.5 * ratio)
    size = torch.ceil(torch.tensor(cells.shape) / ratio - 1e-6).long().tolist()
    assert finer.size.tolist() == size
    axes = [
        ((torch.arange(n) + 0.5) * ratio).long().clamp(max=most - 1) for n, most in zip(size, cells.shape, strict=True)
    ]
    where = torch.meshgrid(*axes, indexing="ij")
    assert torch.equal(finer.to_cells(finer.occupied.reshape(-1)), dilate(kept[where]) & cells[where])
    assert finer.is_of_the_same_scene(grid_of(cells))
    assert float(finer.cell_size) == 0.5 * ratio
    assert (int(finer.level), int(finer.max_level)) == (1, 2)


def test_a_grid_from_its_state_is_the_same_and_of_the_same_scene() -> None:
    grid = subdivide(grid_of(random_cells()), random_cells(), 0.2)
    grid.update_max_weight(torch.tensor([3, 5, 3]), torch.tensor([0.5, 0.25, 0.75]))
    again = BrickGrid.from_state(grid.state_dict())
    for name, value in (*grid.state_dict().items(), ("table", grid.table), ("neighbors", grid.neighbors)):
        assert torch.equal(getattr(again, name), value), name
    assert again.is_of_the_same_scene(grid)
    assert not again.is_of_the_same_scene(grid_of(random_cells(0.03)))
    assert not again.is_of_the_same_scene(grid_of(random_cells(), max_level=3))


def test_the_largest_weight_is_remembered_until_it_is_reset() -> None:
    grid = grid_of(random_cells())
    for weights in ([0.5, 0.25, 0.75], [0.6, 0.1, 0.6]):
        grid.update_max_weight(torch.tensor([3, 5, 3]), torch.tensor(weights))
    assert grid.max_weight[[3, 5]].tolist() == [0.75, 0.25]
    assert int(grid.num_seen) == 6
    grid.reset_max_weight()
    assert not grid.max_weight.any()
    assert int(grid.num_seen) == 0


def test_dilating_adds_the_26_around_and_nothing_beyond_the_border() -> None:
    cells = torch.zeros((4, 5, 6), dtype=torch.bool)
    cells[0, 2, 5] = True
    around = torch.zeros_like(cells)
    around[:2, 1:4, 4:] = True
    assert torch.equal(dilate(cells), around)
