"""When and where training subdivides cells, and which of the others are refined later."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from tiny import cells, occupied_after, tiny_rays
from torch import Tensor

from edge_se_sampler.models import lean
from edge_se_sampler.models.config import LeanModelConfig
from edge_se_sampler.models.lean import MIN_OPTICAL_DEPTH, UPDATE_INTERVAL, LeanModel
from edge_se_sampler.occupancy.grid import OccupancyGrid
from edge_se_sampler.occupancy.hull import Hull

RAYS = 12
SIDE = 0.3
EARLY = UPDATE_INTERVAL // 2


def open_model(max_level: int = 1, **changes: Any) -> LeanModel:
    """In a cube of which nothing is known."""
    config = replace(
        LeanModelConfig(size="tiny", width=8, depth=2, position_frequencies=2, direction_frequencies=1, feature_dim=3),
        **changes,
    )
    grid = OccupancyGrid.from_hull(Hull(np.full(3, -1.2), SIDE, np.ones((8, 8, 8), dtype=bool)), max_level)
    return LeanModel(config, np.random.default_rng(0), grid).double().train()


def levels(model: LeanModel) -> tuple[int, int]:
    """How often the cells have been subdivided, and how often they may be."""
    return int(model.grid.level), int(model.grid.max_level)


def see_density(model: LeanModel, density: float) -> Tensor:
    """A cell in the middle in which training has seen a density, and none elsewhere: its index, (3,)."""
    where = torch.tensor(cells(model).static_mask.shape) // 2
    cells(model).max_density.zero_()
    cells(model).max_density[tuple(where)] = density
    return where


def test_dense_cells_are_subdivided_and_the_rendering_stays_the_same() -> None:
    model = open_model(step_size_voxels=0.5)
    with torch.no_grad():
        model.features.table.normal_(generator=torch.Generator().manual_seed(0))  # pyright: ignore
    where = see_density(model, 100.0)
    cells(model).occupied.copy_(cells(model).static_mask)
    before = {key: value.clone() for key, value in model.eval()(tiny_rays(RAYS)).items()}
    occupied_after(model.train(), 2 * EARLY)
    assert levels(model) == (1, 1)
    refined = torch.zeros_like(cells(model).static_mask)
    refined[tuple(slice(2 * int(at) - 2, 2 * int(at) + 4) for at in where)] = True
    assert torch.equal(cells(model).refined, refined)  # pyright: ignore
    assert bool(cells(model).occupied[refined].all())
    cells(model).occupied.copy_(cells(model).static_mask)
    model.config = replace(model.config, step_size_voxels=1.0)  # as long a step as before
    for key, value in model.eval()(tiny_rays(RAYS)).items():
        torch.testing.assert_close(value, before[key], rtol=0, atol=1e-9)


def test_subdivided_cells_stay_in_the_hull() -> None:
    shown = torch.rand((8, 8, 8), generator=torch.Generator().manual_seed(0)) < 0.5
    shown[3:5, 3:5, 3:5] = True
    grid = OccupancyGrid.from_hull(Hull(np.full(3, -1.2), SIDE, shown.numpy()), 1, 1)
    model = LeanModel(
        LeanModelConfig(size="tiny", width=8, depth=2, position_frequencies=2, direction_frequencies=1, feature_dim=3),
        np.random.default_rng(0),
        grid,
    )
    assert bool(cells(model).static_mask[2:4, 2:4, 2:4].all())  # of two cells each, and a rim
    see_density(model, 100.0)
    occupied_after(model, 2 * EARLY)
    expected = torch.zeros_like(cells(model).static_mask)
    expected[2:-2, 2:-2, 2:-2] = shown
    assert torch.equal(cells(model).static_mask, expected)
    assert bool(cells(model).occupied.any())
    assert not bool((cells(model).occupied & ~expected).any())
    refined = cells(model).refined  # pyright: ignore
    assert bool(refined.any())
    assert not bool((refined & ~expected).any())


@pytest.mark.parametrize("reason", ["no surface", "highest level", "not the time"])
def test_cells_stay_large(reason: str) -> None:
    model = open_model(0 if reason == "highest level" else 1)
    see_density(model, 0.9 * MIN_OPTICAL_DEPTH / SIDE if reason == "no surface" else 100.0)
    before = int(cells(model).occupied.sum())
    assert occupied_after(model, 3 * EARLY + 1 if reason == "not the time" else 2 * EARLY) == before
    assert levels(model)[0] == 0


@pytest.mark.parametrize("room", [6**3, 6**3 - 1])
def test_cells_are_subdivided_again_once_they_are_few_enough(room: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lean, "MAX_OCCUPIED_CELLS", room)
    model = open_model(2)
    for step in (2, 3):
        see_density(model, 100.0)
        occupied_after(model, step * EARLY)
    assert levels(model) == ((2, 2) if room == 6**3 else (1, 2))


def test_cells_pruned_by_mistake_are_reactivated_and_refined() -> None:
    model = open_model()
    assert model.features is not None
    see_density(model, 100.0)
    occupied_after(model, 2 * EARLY)
    refined, elsewhere = cells(model).refined.clone(), (3, 3, 3)
    assert not bool(refined[elsewhere])
    tried = torch.zeros_like(refined)
    for again in range(3, 200):
        occupied_after(model, again * UPDATE_INTERVAL)
        tried |= cells(model).occupied
    assert bool(tried[cells(model).static_mask].float().mean() > 0.8)
    cells(model).max_density[elsewhere] = 100.0
    occupied_after(model, 200 * UPDATE_INTERVAL)
    assert bool(cells(model).occupied[elsewhere])
    assert bool(cells(model).refined[elsewhere])
    assert torch.equal(cells(model).refined & refined, refined)


def test_a_state_with_subdivided_cells_is_loaded() -> None:
    model = open_model(2)
    for step in (2, 3):
        see_density(model, 100.0)
        occupied_after(model, step * EARLY)
    assert levels(model) == (2, 2)
    assert model.features is not None
    with torch.no_grad():
        model.features.table.normal_(generator=torch.Generator().manual_seed(0))
    rays = tiny_rays(RAYS)
    other = LeanModel(model.config, np.random.default_rng(5), OccupancyGrid.from_state(cells(model).state_dict()))
    other.double().load_state_dict(model.state_dict())
    assert torch.equal(other.eval()(rays)["rgb_fine"], model.eval()(rays)["rgb_fine"])
    assert torch.equal(other.grid.occupied, model.grid.occupied)
    assert other.grid.is_of_the_same_scene(open_model(2).grid)
    assert not other.grid.is_of_the_same_scene(open_model(1).grid)
