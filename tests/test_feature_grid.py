"""Features in between corners, against formulas."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from edge_se_sampler.occupancy.features import FeatureGrid
from edge_se_sampler.occupancy.grid import OccupancyGrid, upsample
from edge_se_sampler.occupancy.hull import Hull

SIDE = 0.5
AABB_MIN = np.array([-1.0, 0.5, 2.0])


def grid(shown: np.ndarray, max_level: int = 0) -> OccupancyGrid:
    return OccupancyGrid.from_hull(Hull(AABB_MIN, SIDE, shown), max_level).double()


def inside(shown: np.ndarray, count: int = 300) -> torch.Tensor:
    """Points in cells."""
    rng = np.random.default_rng(0)
    cells = np.argwhere(shown)
    at = cells[rng.integers(len(cells), size=count)] + rng.random((count, 3))
    return torch.from_numpy(AABB_MIN + at * SIDE)


def features_at(features: FeatureGrid, points: torch.Tensor) -> torch.Tensor:
    (cells,) = features.grid
    return features(points, cells.locate(points))


def some_cells() -> np.ndarray:
    return np.random.default_rng(3).random((4, 3, 5)) < 0.4


def test_a_corner_is_stored_once_and_only_corners_of_cells() -> None:
    assert len(FeatureGrid(grid(np.ones((2, 1, 1), dtype=bool)), 3).table) == 12
    apart = np.zeros((5, 1, 1), dtype=bool)
    apart[[0, 4]] = True
    assert len(FeatureGrid(grid(apart), 3).table) == 16


def test_interpolation_of_a_linear_function_is_exact() -> None:
    shown = some_cells()
    cells = grid(shown)
    features = FeatureGrid(cells, 4).double()
    rng = np.random.default_rng(1)
    slope, offset = torch.from_numpy(rng.normal(size=(3, 4))), torch.from_numpy(rng.normal(size=4))
    corners = torch.tensor(list(itertools.product((0, 1), repeat=3)))
    with torch.no_grad():
        positions = cells.aabb_min + (features.cell_origin[:, None] + corners) * SIDE
        features.table[features.rows] = positions @ slope + offset
    points = inside(shown)
    torch.testing.assert_close(features_at(features, points), points @ slope + offset)


def test_gradients_of_the_table_against_finite_differences() -> None:
    shown = some_cells()
    cells = grid(shown)
    features = FeatureGrid(cells, 2).double()
    points = inside(shown, 7)
    table = torch.randn(features.table.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def of(values: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(features, {"table": values}, (points, cells.locate(points)))

    assert torch.autograd.gradcheck(of, (table.requires_grad_(),))


def test_features_do_not_jump_between_cells() -> None:
    shown = np.ones((3, 3, 3), dtype=bool)
    features = FeatureGrid(grid(shown), 5).double()
    with torch.no_grad():
        features.table.copy_(torch.randn(features.table.shape, generator=torch.Generator().manual_seed(0)))
    face = torch.tensor([[-0.5, 0.8, 2.7], [0.0, 1.3, 3.1]], dtype=torch.float64)
    step = torch.tensor([1e-9, 0, 0], dtype=torch.float64)
    one, other = (features_at(features, face + sign * step) for sign in (-1, 1))
    torch.testing.assert_close(one, other, rtol=0, atol=1e-6)


def test_features_are_0_at_first() -> None:
    shown = some_cells()
    assert not bool(features_at(FeatureGrid(grid(shown), 4).double(), inside(shown)).any())


# -- refined cells


def random_features(cells: OccupancyGrid) -> FeatureGrid:
    features = FeatureGrid(cells, 3).double()
    with torch.no_grad():
        features.table.normal_(generator=torch.Generator().manual_seed(0))
    return features


def refine_some(shown: np.ndarray, max_level: int = 1) -> tuple[FeatureGrid, torch.Tensor]:
    """A grid subdivided to a level, about half of its cells refined, and which these are."""
    cells = grid(shown, max_level)
    features = random_features(cells)
    refined = cells.static_mask & (
        torch.rand(cells.static_mask.shape, generator=torch.Generator().manual_seed(1)) < 0.5
    )
    for _ in range(max_level):
        refined = upsample(refined)
        features.refine(refined)
    return features, refined


@pytest.mark.parametrize("max_level", [1, 2])
def test_refining_changes_no_feature(max_level: int) -> None:
    shown, points = some_cells(), inside(some_cells())
    features, refined = refine_some(shown, max_level)
    before = random_features(grid(shown))
    (cells,) = features.grid
    assert float(cells.cell_size) == SIDE / 2**max_level
    assert 0.2 < refined.reshape(-1)[cells.locate(points)].double().mean() < 0.8
    torch.testing.assert_close(features_at(features, points), features_at(before, points))


def test_refined_cells_have_corners_of_their_own_and_others_the_coarse_ones() -> None:
    features, refined = refine_some(some_cells())
    before, points = random_features(grid(some_cells())), inside(some_cells())
    (cells,) = features.grid
    inner = refined.reshape(-1)[cells.locate(points)]
    with torch.no_grad():
        features.table[len(before.table) :] += 1
    after = features_at(features, points) - features_at(before, points)
    torch.testing.assert_close(after[inner], torch.ones_like(after[inner]))
    torch.testing.assert_close(after[~inner], torch.zeros_like(after[~inner]))
    with torch.no_grad():
        features.table[: len(before.table)] += 2
    after = features_at(features, points) - features_at(before, points)
    torch.testing.assert_close(after[~inner], torch.full_like(after[~inner], 2))


def test_corners_of_refined_cells_are_stored_once() -> None:
    one = np.zeros((3, 1, 1), dtype=bool)
    one[1] = True
    features, _ = refine_some(one, 0)
    (cells,) = features.grid
    assert len(features.table) == 8
    cells.max_level.fill_(1)
    features.refine(upsample(cells.static_mask))
    assert len(features.table) == 8 + 27


def test_cells_refined_later_begin_with_the_features_there() -> None:
    features, refined = refine_some(some_cells())
    with torch.no_grad():  # the levels have gone apart
        features.table.normal_(generator=torch.Generator().manual_seed(2))
    (cells,) = features.grid
    points = inside(some_cells())
    apart = ~F.max_pool3d(refined.double()[None, None], 3, 1, 1)[0, 0].bool().reshape(-1)[cells.locate(points)]
    inner = refined.reshape(-1)[cells.locate(points)]
    before, rows = features_at(features, points), len(features.table)
    features.refine(cells.static_mask.clone())
    assert len(features.table) > rows
    assert int(apart.sum()) > 5
    after = features_at(features, points)
    torch.testing.assert_close(after[apart], before[apart])
    torch.testing.assert_close(after[inner], before[inner])
