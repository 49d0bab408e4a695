"""Meshes of dense networks, which have no cells of their own: of a ball whose density is known, and of a run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from exported import CELL, OPACITY, RADIUS, ball_run, color_at
from tiny import ball_views, tiny_model

from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.engine.config import override
from edge_se_sampler.engine.pipeline import analyze_views
from edge_se_sampler.engine.session import resolve_config
from edge_se_sampler.export import density
from edge_se_sampler.export.density import find_density
from edge_se_sampler.export.mesh import analyze_box, render_colors
from edge_se_sampler.export.surface import find_surface
from edge_se_sampler.methods import method_configs
from edge_se_sampler.occupancy.bricks import BrickGrid

trimesh = pytest.importorskip("trimesh")
for package in ("manifold3d", "skimage"):
    pytest.importorskip(package)


class DenseBall(torch.nn.Module):
    """A field in which a CELL has an opacity of OPACITY at a radius; a CELL deeper, density is e^2 times as high."""

    def __init__(self, radius: float) -> None:
        super().__init__()
        self.radius, self.num_evaluated = radius, 0
        self.weight = torch.nn.Parameter(torch.zeros(()))  # tells the model's device and type

    def forward(self, positions: torch.Tensor, directions: torch.Tensor, *_: object):
        self.num_evaluated += len(positions)
        density = -np.log(1 - OPACITY) / CELL * torch.exp(2 * (self.radius - positions.norm(dim=1)) / CELL)
        return density, torch.from_numpy(color_at(positions.double().numpy())).to(positions)


def ball(grid: BrickGrid | None = None, radius: float = RADIUS):
    model: Any = tiny_model(grid=grid, near=2.0, far=6.0, num_coarse_samples=64, num_importance_samples=64).float()
    model.fine = model.coarse = DenseBall(radius)
    return model.eval()


def find_box() -> BrickGrid:
    return analyze_views(ball_views(6, 24, RADIUS), ball().config).grid()


def test_the_surface_is_where_density_passes_the_threshold() -> None:
    """In cells that are found by halving those of the box that the views see, where these are dense."""
    model, box = ball(), find_box()
    grid, difference = find_density(model, OPACITY, find_box)
    assert grid.level == grid.max_level >= 2
    mesh = trimesh.Trimesh(*find_surface(grid, difference), process=False)
    assert mesh.is_watertight
    # half as large cells need twice as much density to be as opaque
    radius = RADIUS + CELL / 2 * np.log(float(grid.cell_size) / CELL)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - radius).max() < 0.2 * float(grid.cell_size)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.05)
    assert model.fine.num_evaluated < 0.5 * int(box.occupied.sum()) * 8 ** int(grid.max_level)
    colors = render_colors(model, mesh.vertices, mesh.vertex_normals, 2 * float(grid.cell_size))
    np.testing.assert_allclose(colors, color_at(mesh.vertices), atol=0.03)


def test_a_network_with_cells_is_evaluated_in_these_alone() -> None:
    cells = torch.ones((12, 12, 12), dtype=torch.bool)
    cells[:6] = False
    grid = BrickGrid.from_cells(torch.full((3,), -0.9), 0.15, cells, max_level=1)
    mesh = trimesh.Trimesh(*find_surface(*find_density(ball(grid), OPACITY, find_box)), process=False)
    assert mesh.is_watertight
    assert mesh.vertices[:, 0].min() > -0.0376
    assert mesh.vertices[:, 0].max() == pytest.approx(RADIUS, abs=0.0375)


def test_an_empty_network_has_no_surface() -> None:
    assert not len(find_surface(*find_density(ball(radius=-9.0), OPACITY, find_box))[1])


def test_cells_stay_large_where_there_would_be_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(density, "MAX_ROWS", find_box().num_rows)
    grid, _ = find_density(ball(), OPACITY, find_box)
    assert grid.level < grid.max_level
    assert grid.num_rows <= find_box().num_rows


def test_the_box_of_a_run_is_carved_by_silhouettes(tmp_path: Path) -> None:
    """Outside of them a dense network may have learned anything that looks like the background."""
    ball_run(tmp_path)
    config = override(method_configs()["edge-se-nerf"], {"data": tmp_path / "scene"})
    grid = analyze_box(resolve_config(config, read_blender(tmp_path / "scene", "train")))
    volume = float(grid.occupied.sum() * grid.cell_size**3)
    assert 1 < volume / (4 / 3 * np.pi * RADIUS**3) < 6  # in large cells


def test_a_run_has_a_mesh(run: Path, tmp_path: Path, edge_se: Callable) -> None:
    path = tmp_path / "mesh.ply"
    answer = edge_se("export", run, "mesh", "--output-path", path, "--opacity-threshold", 1e-6)
    assert answer.code == 0, answer.err
    assert trimesh.load(path, process=False).is_watertight
