"""Cells and the samples of rays in them, against doing it point by point."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tiny import tiny_rays
from torch import Tensor

from edge_se_sampler.occupancy.grid import OccupancyGrid
from edge_se_sampler.occupancy.hull import Hull

SIDE = 0.25
ALL = np.ones((7, 5, 6), dtype=bool)
SOME = np.random.default_rng(0).random(ALL.shape) < 0.3


def hull_of(occupied: np.ndarray) -> Hull:
    """A hull around the origin."""
    return Hull(-np.array(occupied.shape) * SIDE / 2, SIDE, occupied)


def grid_of(occupied: np.ndarray) -> OccupancyGrid:
    return OccupancyGrid.from_hull(hull_of(occupied)).double()


def random_points() -> Tensor:
    """(5000, 3) points in the box of the grids and around it."""
    return torch.from_numpy(np.random.default_rng(1).uniform(-1.5, 1.5, (5000, 3)))


def in_cells(positions: Tensor, occupied: np.ndarray) -> np.ndarray:
    """Whether points are in a cell, one coordinate after the other."""
    index = np.floor((positions.numpy() + np.array(occupied.shape) * SIDE / 2) / SIDE).astype(int)
    in_box = ((index >= 0) & (index < occupied.shape)).all(axis=1)
    found = np.zeros(len(index), dtype=bool)
    found[in_box] = occupied[tuple(index[in_box].T)]
    return found


def test_a_point_is_where_its_coordinates_say() -> None:
    positions = random_points()
    found = grid_of(SOME).contains(positions).numpy()
    assert 0.01 < found.mean() < 0.3
    np.testing.assert_array_equal(found, in_cells(positions, SOME))


@pytest.mark.parametrize("jittered", [True, False])
def test_samples_are_those_of_every_ray_that_lie_in_a_cell(jittered: bool) -> None:
    grid, rays, step = grid_of(SOME), tiny_rays(200), 0.11
    jitter = torch.from_numpy(np.random.default_rng(2).random((200, 1))) if jittered else None
    samples = grid.march(rays, step, jitter)
    # brute force: the same distances, continued far beyond the box
    begin, _ = grid._span(rays)
    distances = begin + (torch.arange(100) + (0.5 if jitter is None else jitter)) * step
    positions = rays.origins[:, None] + distances[..., None] * rays.directions[:, None]
    inside = in_cells(positions.reshape(-1, 3), SOME).reshape(distances.shape)
    assert 200 < inside.sum() == len(samples.t)
    torch.testing.assert_close(samples.t, distances[torch.from_numpy(inside)])
    torch.testing.assert_close(samples.positions, positions[torch.from_numpy(inside)])
    np.testing.assert_array_equal(samples.ray_indices.numpy(), np.nonzero(inside)[0])
    np.testing.assert_array_equal(samples.ray_starts.numpy(), np.cumsum(inside.sum(1)) - inside.sum(1))
    assert bool(grid.occupied.reshape(-1)[samples.cell_indices].all())
    assert torch.equal(samples.cell_indices, grid.locate(samples.positions))


def test_no_part_of_a_ray_in_a_cell_is_left_out() -> None:
    """All cells occupied: as many samples as steps fit between the box's faces."""
    rays, step = tiny_rays(100), 0.01
    grid = grid_of(ALL)
    grid.occupied.copy_(grid.static_mask)
    samples = grid.march(rays, step, None)
    inverse = 1 / rays.directions
    half = torch.tensor(ALL.shape) * SIDE / 2
    one, other = (-half - rays.origins) * inverse, (half - rays.origins) * inverse
    length = (torch.maximum(one, other).amin(1) - torch.minimum(one, other).amax(1)).clamp(min=0)
    counts = torch.bincount(samples.ray_indices, minlength=100)
    assert bool((counts > 0).any())
    assert float((counts * step - length).abs().max()) <= step + 1e-9


def test_samples_lie_between_the_depths() -> None:
    rays = tiny_rays(300)
    grid = grid_of(ALL)
    whole, part = (grid.march(rays, 0.02, None, depths) for depths in ((0, np.inf), (3.4, 3.7)))
    depth = part.t / rays.metadata["directions_norm"][part.ray_indices, 0]
    assert 3.4 <= float(depth.min()) < 3.43
    assert 3.67 < float(depth.max()) < 3.7
    among = whole.t / rays.metadata["directions_norm"][whole.ray_indices, 0]
    expected = int(((among >= 3.4) & (among < 3.7)).sum())
    assert len(part.t) == pytest.approx(expected, rel=0.05)


def test_rays_that_miss_and_no_rays_have_no_samples() -> None:
    grid, rays = grid_of(SOME), tiny_rays(20)
    away = type(rays)(rays.origins, -rays.directions, rays.camera_indices, rays.metadata)
    assert len(grid.march(away, 0.1, None).t) == 0
    assert len(grid.march(rays[:0], 0.1, None).t) == 0


def test_a_direction_along_an_axis_is_no_division_by_zero() -> None:
    grid, rays = grid_of(ALL), tiny_rays(1)
    along = type(rays)(
        torch.tensor([[-4.0, 0.1, 0.1]]).double(), torch.tensor([[1.0, 0.0, 0.0]]).double(), rays.camera_indices,
        rays.metadata,
    )  # fmt: skip
    samples = grid.march(along, 0.05, None)
    assert len(samples.t) == pytest.approx(7 * SIDE / 0.05, abs=1)


# -- pruning and subdividing


def test_pruning_keeps_dense_cells_and_their_neighbors_within_the_hull() -> None:
    occupied = ALL.copy()
    occupied[0] = False
    grid = grid_of(occupied)
    samples = grid.march(tiny_rays(500), 0.1, None)
    middle = torch.tensor([[0.0, 0.0, 0.1]], dtype=torch.float64)
    cell = grid.locate(middle)
    grid.update_max_density(samples, torch.where(samples.cell_indices == cell, 5.0, 0.5).double())
    none = torch.zeros_like(grid.static_mask)
    grid.prune(1.0, none)
    index = np.unravel_index(int(cell), grid.static_mask.shape)
    expected = torch.zeros_like(grid.static_mask)
    expected[tuple(slice(at - 1, at + 2) for at in index)] = True
    assert torch.equal(grid.occupied, expected & grid.static_mask)
    assert not bool(grid.max_density.any())  # starts from 0

    reactivated = none.clone()
    reactivated[2, 1, 1] = reactivated[0, 0, 0] = True
    grid.prune(1.0, reactivated)
    assert torch.nonzero(grid.occupied).tolist() == [[2, 1, 1]]  # not the rim's


def test_the_largest_density_of_a_cell_counts() -> None:
    grid = grid_of(ALL)
    samples = grid.march(tiny_rays(300), 0.05, None)
    density = torch.from_numpy(np.random.default_rng(0).random(len(samples.t)))
    for part in (density, density / 2):
        grid.update_max_density(samples, part)
    expected = np.zeros(grid.static_mask.numel())
    np.maximum.at(expected, samples.cell_indices.numpy(), density.numpy())
    np.testing.assert_array_equal(grid.max_density.reshape(-1).numpy(), expected)


def test_subdividing_keeps_the_box_and_what_is_occupied() -> None:
    points, hull = random_points(), hull_of(SOME)
    grid, whole = OccupancyGrid.from_hull(hull, 2).double(), grid_of(SOME)
    for level in (1, 2):
        grid.subdivide()
        assert torch.equal(grid.contains(points), whole.contains(points))
        assert (float(grid.initial_cell_size), float(grid.cell_size)) == (SIDE, SIDE / 2**level)
        torch.testing.assert_close(grid.center, whole.center)
        assert float(grid.half_extent) == float(whole.half_extent)
        assert torch.equal(grid.static_mask_at(0), whole.static_mask)
    loaded = OccupancyGrid.from_state(grid.float().state_dict())
    assert loaded.state_dict().keys() == grid.state_dict().keys()
    assert all(torch.equal(value, grid.state_dict()[key]) for key, value in loaded.state_dict().items())
    assert not loaded.is_of_the_same_scene(whole.float())  # may be subdivided, that one not
    assert loaded.is_of_the_same_scene(OccupancyGrid.from_hull(hull, 2))


def test_coarse_cells_cover_the_hull_and_subdivided_ones_equal_it() -> None:
    points, hull = random_points(), hull_of(SOME)
    grid, whole = OccupancyGrid.from_hull(hull, 2, 2).double(), grid_of(SOME)
    inside = whole.contains(points)
    assert float(grid.cell_size) == 4 * SIDE
    cell = grid.locate(points)
    assert torch.equal(grid.contains(points), torch.isin(cell, cell[inside]))
    rim = torch.ones_like(grid.static_mask)
    rim[1:-1, 1:-1, 1:-1] = False
    assert not bool((grid.static_mask & rim).any())
    for _ in range(2):
        grid.subdivide()
    assert torch.equal(grid.contains(points), inside)
    first = OccupancyGrid.from_hull(hull, 2, 2)
    assert first.is_of_the_same_scene(OccupancyGrid.from_state(grid.float().state_dict()))
    assert not first.is_of_the_same_scene(OccupancyGrid.from_hull(hull, 2, 1))
    larger = (first.aabb_min, float(first.cell_size), first.hull, 2)
    assert not first.is_of_the_same_scene(OccupancyGrid(*larger, coarsening=1))  # of a hull in cells twice as large
