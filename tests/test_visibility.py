"""Up to which depth an image's rays are empty: against samples of every ray, and renderings that do not know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import tiny_model

from edge_se_sampler.data.cameras import Cameras, RayBundle
from edge_se_sampler.engine.frames import find_depth_range, render_frame
from edge_se_sampler.engine.rendering import CameraRays, Picture, render_outputs, render_view
from edge_se_sampler.models.config import LeanModelConfig
from edge_se_sampler.models.ensemble import Ensemble
from edge_se_sampler.models.lean import LeanModel
from edge_se_sampler.occupancy.bricks import BRICK, BrickGrid
from edge_se_sampler.occupancy.visibility import find_empty_depths

WIDTH, HEIGHT = 180, 148
EVERY = 37
"""How many pixels there are for one whose rays are followed."""
OUTPUTS = "rgb_fine", "accumulation_fine", "depth_fine", "background"


def looking(position: tuple[float, float, float], focal: float = 160.0, seed: int = 0) -> Cameras:
    """From there at about the origin, turned at random about the axis, with another principal point than the middle."""
    rng = np.random.default_rng(seed)
    back = np.array(position) + rng.normal(scale=0.1, size=3)
    back /= np.linalg.norm(back)
    right = np.cross(rng.normal(size=3), back)
    right /= np.linalg.norm(right)
    pose = np.stack((right, np.cross(back, right), back, position), axis=1)[None]
    return Cameras.of(pose, fx=focal, fy=1.2 * focal, cx=68.0, cy=84.0, width=WIDTH, height=HEIGHT)


def random_cells(share: float, size: int = 40) -> torch.Tensor:
    """Some in a ball."""
    middle = torch.arange(size) + 0.5 - size / 2
    radius = torch.stack(torch.meshgrid(middle, middle, middle, indexing="ij")).norm(dim=0)
    return (torch.from_numpy(np.random.default_rng(3).random((size,) * 3)) < share) & (radius < size / 3)


def grid_of(cells: torch.Tensor, focus: tuple[float, ...] | None = None) -> BrickGrid:
    """In a box of two units around the origin."""
    focus_of = None if focus is None else torch.tensor(focus)
    return BrickGrid.from_cells(torch.full((3,), -1.0), 2 / len(cells), cells, focus=focus_of)


def first_depths(grid: BrickGrid, camera: Cameras, begin: float) -> torch.Tensor:
    """(m,) least depth, of many along the rays through a pixel's quarters, in an occupied cell, of one in EVERY
    pixels; inf: none is."""
    rays = camera.image_rays(0)[torch.arange(0, WIDTH * HEIGHT, EVERY)]
    directions, norm = rays.split_pixels()
    depths = torch.linspace(begin, 6.0, 2000, dtype=torch.float64)[1:]
    found = torch.full((len(rays),), torch.inf, dtype=torch.float64)
    for i, along in enumerate(directions * norm):
        positions = rays.origins[i] + depths[:, None, None] * along
        inside = grid.contains(positions.reshape(-1, 3)).reshape(-1, 4).any(dim=1)
        if inside.any():
            found[i] = depths[inside].min()
    return found


@pytest.mark.parametrize(
    ("position", "focus"),
    [
        ((0.5, -3.0, 1.0), None),
        ((1.3, 0.2, 0.6), None),  # so near that bricks differ much in size
        ((0.1, 0.2, 0.1), None),  # in the middle of the cells
        ((1.3, 0.2, 0.6), (0.0, 0.0, 0.0, 0.4, 9.0)),  # rays begin inside
    ],
)
def test_no_ray_is_in_a_cell_before_the_depth_that_is_found(
    position: tuple[float, float, float], focus: tuple[float, ...] | None
) -> None:
    grid, camera = grid_of(random_cells(0.01), focus), looking(position)
    empty = find_empty_depths(grid, camera)[::EVERY]
    begin = float(grid.empty_depth(camera.camera_to_worlds[:, :, 3]))
    expected = first_depths(grid, camera, begin)
    assert empty.shape == expected.shape
    assert (empty <= expected).all()
    if position[1] == -3.0:  # what is found is of use: to a few pixels, and a few bricks
        assert empty.isinf().sum() > 0.7 * expected.isinf().sum() > 100
        seen, brick = expected.isfinite(), BRICK * float(grid.cell_size)
        assert (expected - empty)[seen].median() < 3 * brick


@pytest.mark.parametrize("seed", range(40))
def test_every_ray_that_hits_a_brick_knows(seed: int) -> None:
    """By the planes of its sides, from near and in wide angles; some from within."""
    rng = np.random.default_rng(seed)
    corner = 4 * rng.integers(0, 10, 3)
    cells = torch.zeros((40, 40, 40), dtype=torch.bool)
    cells[tuple(slice(start, start + 4) for start in corner)] = True
    grid, position = grid_of(cells), rng.normal(scale=1.2, size=3) if seed > 4 else (corner + 1.5) / 20 - 1
    camera = looking((*position,), focal=float(rng.uniform(30, 200)), seed=seed)
    rays = camera.image_rays(0)
    directions, norm = rays.split_pixels()
    sides = torch.from_numpy(np.stack((corner, corner + 4))) * float(grid.cell_size) - 1.0
    hits = (sides[:, None, None] - rays.origins[:, None]) / (directions * norm)
    enter, leave = hits.amin(dim=0).amax(dim=2), hits.amax(dim=0).amin(dim=2)
    depth = torch.where((enter < leave) & (leave > 0), enter.clamp(min=0), torch.inf).amin(dim=1)
    assert (find_empty_depths(grid, camera) <= depth + 1e-4).all()


def test_bricks_in_which_no_cell_is_sampled_do_not_count() -> None:
    grid, camera = grid_of(random_cells(0.2)), looking((0.5, -3.0, 1.0))
    before = find_empty_depths(grid, camera)
    grid.set_sampled(torch.where(grid.bricks[:, 0] < 5, grid.sampled, 0))
    after = find_empty_depths(grid, camera)
    assert (after >= before).all()
    assert after.isinf().sum() > before.isinf().sum() + 1000
    grid.set_sampled(torch.zeros_like(grid.sampled))
    assert find_empty_depths(grid, camera).isinf().all()


def ball_model(seed: int) -> LeanModel:
    rng, config = np.random.default_rng(seed), LeanModelConfig(size="tiny", max_memory=1.0)
    model = LeanModel(config, rng, grid_of(random_cells(0.3))).eval()
    with torch.no_grad():
        model.density.copy_(torch.from_numpy(rng.normal(size=model.density.shape)))
        model.features.mul_(100)
    return model


def outputs_of(model: LeanModel | Ensemble, rays: RayBundle) -> dict[str, torch.Tensor]:
    return render_outputs(model, rays, OUTPUTS)


@pytest.mark.parametrize("supersampled", [False, True])
def test_what_is_rendered_does_not_depend_on_it(supersampled: bool) -> None:
    model, camera = ball_model(1), looking((0.5, -3.0, 1.0))
    model.supersampled.fill_(supersampled)
    rays = CameraRays.of(model, camera)
    empty = rays.empty_depths
    assert empty is not None
    assert 0.2 < empty.isinf().double().mean() < 0.8
    found = outputs_of(model, rays[0 : WIDTH * HEIGHT])
    expected = outputs_of(model, rays.camera.image_rays(0))
    assert expected["accumulation_fine"].max() > 0.9
    for key in OUTPUTS:
        torch.testing.assert_close(found[key], expected[key], rtol=0, atol=1e-4)


def test_a_view_is_background_where_nothing_is(monkeypatch: pytest.MonkeyPatch) -> None:
    model, camera = ball_model(1), looking((0.5, -3.0, 1.0))
    picture = Picture("view", np.zeros((HEIGHT, WIDTH, 3), np.uint8), camera)
    found = render_view(model, picture)
    monkeypatch.setattr(LeanModel, "find_empty_depths", lambda self, camera: None)
    expected = render_view(model, picture)
    assert (expected == 1).any()
    assert (expected < 0.9).any()
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_frames_are_those_of_a_model_that_does_not_know(monkeypatch: pytest.MonkeyPatch) -> None:
    model, camera = ball_model(1), looking((0.5, -3.0, 1.0))
    names = ("rgb", "rgba", "accumulation", "depth", "raw-depth")
    found = render_frame(model, camera, 0, names, 1e-3)
    monkeypatch.setattr(LeanModel, "find_empty_depths", lambda self, camera: None)
    expected = render_frame(model, camera, 0, names, 1e-3)
    for name in names:
        assert np.abs(found[name].astype(int) - expected[name]).max() <= 1
        assert found[name].max() > 100


def test_several_models_are_empty_where_all_of_them_are() -> None:
    first, second = ball_model(1), ball_model(2)
    first.grid.set_sampled(torch.where(first.grid.bricks[:, 0] < 5, first.grid.sampled, 0))
    second.grid.set_sampled(torch.where(second.grid.bricks[:, 1] < 5, second.grid.sampled, 0))
    model, camera = Ensemble([first, second]), looking((0.5, -3.0, 1.0))
    rays = CameraRays.of(model, camera)
    found, expected = outputs_of(model, rays[0 : WIDTH * HEIGHT]), outputs_of(model, rays.camera.image_rays(0))
    for key in OUTPUTS:
        torch.testing.assert_close(found[key], expected[key], rtol=0, atol=1e-4)


@pytest.mark.parametrize("factor", [0.35, 3.0])
def test_a_camera_path_sees_what_training_views_had_no_depth_for(factor: float) -> None:
    """Of a ball of a radius of two thirds, from so many times the distance of about 3."""
    model, camera = ball_model(1), looking((0.5 * factor, -3.0 * factor, factor), 160.0 * factor)
    model.config = replace(model.config, near=2.0, far=4.0)
    names, depths = ("accumulation", "raw-depth"), find_depth_range(model, camera)
    found = render_frame(model, camera, 0, names, 1e-3, depths)
    seen = found["raw-depth"][found["accumulation"] > 200]
    distance = 1e3 * factor * 10.25**0.5
    assert len(seen) > 1000
    assert distance - 700 < seen.min() < distance - 300
    assert depths[0] <= seen.min() / 1e3 < seen.max() / 1e3 < depths[1]
    assert render_frame(model, camera, 0, names, 1e-3)["accumulation"].max() == 0  # as a held-out view would be


def test_the_dense_networks_are_sampled_between_their_depths_alone() -> None:
    grid = ball_model(1).grid
    model, camera = tiny_model(grid=grid, near=2.0, far=4.0), looking((1.5, -9.0, 3.0), 480.0)
    assert find_depth_range(model, camera) == (2.0, 4.0)
    rays = CameraRays.of(model, camera, everything=True)[0:4]
    assert "nears" not in rays.metadata


def test_depths_stay_where_they_show_all_cells() -> None:
    model = ball_model(1)
    model.config = replace(model.config, near=0.5, far=9.0)
    assert find_depth_range(model, looking((0.5, -3.0, 1.0))) == (0.5, 9.0)
    model.grid = None  # pyright: ignore[reportAttributeAccessIssue]
    assert find_depth_range(model, looking((0.5, -30.0, 1.0))) == (0.5, 9.0)
