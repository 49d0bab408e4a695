"""Meshes: where the surface of a known ball lies, whether it is closed, its colors, and its two formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from exported import CELL, OPACITY, RADIUS, ball_model, ball_run, color_at, read_ply, surface_of

from edge_se_sampler.export import surface
from edge_se_sampler.export.mesh import render_colors, to_glb
from edge_se_sampler.export.surface import find_surface, keep_largest, simplify
from edge_se_sampler.occupancy.bricks import BrickGrid

trimesh = pytest.importorskip("trimesh")
for package in ("manifold3d", "skimage"):
    pytest.importorskip(package)


def mesh_of(vertices: np.ndarray, triangles: np.ndarray):
    return trimesh.Trimesh(vertices, triangles, process=False)


@pytest.mark.parametrize("block", [16, 2, 3])
def test_the_surface_of_a_ball_is_a_closed_sphere_however_it_is_cut_into_blocks(
    block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = surface_of(ball_model())
    monkeypatch.setattr(surface, "BLOCK", block)
    vertices, triangles = surface_of(ball_model())
    mesh = mesh_of(vertices, triangles)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)  # negative, were it inside out
    assert np.abs(np.linalg.norm(vertices, axis=1) - RADIUS).max() < 0.05 * CELL
    assert (len(vertices), len(triangles)) == (len(whole[0]), len(whole[1]))
    assert mesh.euler_number == 2
    assert mesh.area_faces.min() > 0


def test_a_lower_opacity_is_further_out() -> None:
    """The logarithm of density falls by 2 from cell to cell."""
    radius = [np.linalg.norm(surface_of(ball_model(), opacity)[0], axis=1).mean() for opacity in (OPACITY, 0.04)]
    expected = np.log(np.log(1 - OPACITY) / np.log(1 - 0.04)) / 2
    assert (radius[1] - radius[0]) / CELL == pytest.approx(expected, abs=0.02)


def test_smaller_cells_than_the_finest_were_to_be_need_more_density_to_be_as_opaque() -> None:
    """Raw density is of the finest size, whatever the cells became."""
    model = ball_model()
    model.grid.finest_size *= 3
    inside = np.linalg.norm(surface_of(model)[0], axis=1).mean()
    assert (RADIUS - inside) / CELL == pytest.approx(np.log(3) / 2, abs=0.02)


def test_where_no_cell_is_occupied_the_surface_closes() -> None:
    """Inside a hollow ball, and at the ends of a box that is dense all over: each at most half a cell beyond."""
    vertices, triangles = surface_of(ball_model(hollow=True))
    parts = mesh_of(vertices, triangles).split(only_watertight=True)
    inner, outer = sorted((np.linalg.norm(part.vertices, axis=1) for part in parts), key=np.mean)
    assert np.abs(outer - RADIUS).max() < 0.05 * CELL
    assert inner.max() < RADIUS - 3 * CELL
    assert inner.min() > RADIUS - 6 * CELL
    model = ball_model()
    model.grid = type(model.grid).from_cells(torch.full((3,), -1.0), CELL, torch.ones((40, 39, 38), dtype=torch.bool))
    model.density = torch.nn.Parameter(torch.full((model.grid.num_rows, 1), 3.0))
    box = mesh_of(*surface_of(model))
    assert box.is_watertight
    sizes = np.array([40, 39, 38]) * CELL
    np.testing.assert_allclose(box.bounds, np.stack((np.full(3, -1.0), sizes - 1)), atol=0.5 * CELL)
    assert box.volume >= sizes.prod()


def test_the_largest_components_are_kept() -> None:
    everything = surface_of(ball_model(speck=True))
    ball, *both = (keep_largest(*everything, count) for count in (1, 2, 0))
    assert mesh_of(*ball).is_watertight
    assert np.linalg.norm(ball[0], axis=1) == pytest.approx(RADIUS, abs=0.05 * CELL)
    for vertices, triangles in both:
        assert len(vertices) == len(everything[0]) > len(ball[0])
        assert mesh_of(vertices, triangles).body_count == 2


def test_colors_are_those_of_the_surface() -> None:
    model = ball_model()
    vertices, triangles = surface_of(model)
    normals = np.array(mesh_of(vertices, triangles).vertex_normals)
    np.testing.assert_allclose(render_colors(model, vertices, normals, 2 * CELL), color_at(vertices), atol=0.02)


def test_colors_are_those_of_the_surface_however_much_is_empty_before_cameras() -> None:
    model = ball_model()
    position = np.array([[0.0, 0.0, RADIUS], [RADIUS, 0.0, 0.0]])
    model.grid.focus[:] = torch.tensor([0.0, 0.0, 0.0, 0.9, 9.0])  # else rays begin at 0.9 of the way to the center
    colors = render_colors(model, position, position / RADIUS, 2 * CELL)
    np.testing.assert_allclose(colors, color_at(position), atol=0.02)


def test_colors_are_asked_from_outside() -> None:
    """Were each vertex seen from within, the ball would show its other side."""
    model = ball_model()
    position = np.array([[0.0, 0.0, RADIUS], [0.0, 0.0, -RADIUS]])
    colors = render_colors(model, position, position / RADIUS, 2 * CELL)
    np.testing.assert_allclose(colors, color_at(position), atol=0.02)


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_ply_and_glb_have_the_same_surface(scale: float, tmp_path: Path, edge_se: Callable) -> None:
    run = ball_run(tmp_path, scale)
    for name in ("mesh.ply", "mesh.glb"):
        answer = edge_se("export", run, "mesh", "--output-path", tmp_path / name)
        assert answer.code == 0, answer.err
        assert "watertight" in answer.out
    ply = trimesh.load(tmp_path / "mesh.ply", process=False)
    glb = next(iter(trimesh.load(tmp_path / "mesh.glb", process=False).geometry.values()))
    assert ply.is_watertight
    assert glb.is_watertight
    np.testing.assert_allclose(np.linalg.norm(ply.vertices, axis=1), RADIUS * scale, atol=0.5 * CELL * scale)
    x, y, z = ply.vertices.T
    np.testing.assert_allclose(glb.vertices, np.stack((x, z, -y), axis=1), rtol=1e-6)  # y is up
    assert (glb.faces == ply.faces).all()
    for mesh in (ply, glb):
        directions = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
        assert (mesh.vertex_normals * directions).sum(axis=1).min() > 0.99
    colors = ply.visual.vertex_colors[:, :3] / 255
    np.testing.assert_allclose(colors, color_at(ply.vertices / scale), atol=0.02)
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(glb.visual.vertex_attributes["color"], linear, atol=0.01)
    columns = read_ply(tmp_path / "mesh.ply")
    assert list(columns) == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"]


def test_a_glb_is_shown_unlit_and_its_colors_are_no_bytes() -> None:
    """8 bits of linear light are too few for dark colors."""
    dark = np.full((3, 3), 0.03)
    text = to_glb(np.eye(3), np.eye(3), dark, np.array([[0, 1, 2]]))
    assert b"KHR_materials_unlit" in text
    assert np.float32(0.03 / 12.92).tobytes() * 9 in text


def test_nothing_dense_is_an_error_and_no_file(tmp_path: Path, edge_se: Callable) -> None:
    run, path = ball_run(tmp_path, empty=True), tmp_path / "mesh.ply"
    answer = edge_se("export", run, "mesh", "--output-path", path)
    assert answer.code == 2
    assert answer.err.count("\n") == 1
    assert "--opacity-threshold" in answer.err
    assert not path.exists()


def test_a_simplified_surface_has_moved_by_no_more_than_the_tolerance() -> None:
    vertices, triangles = surface_of(ball_model())
    for tolerance in (0.05, 0.3):
        mesh = mesh_of(*simplify(vertices, triangles, tolerance * CELL))
        assert mesh.is_watertight
        assert len(mesh.faces) < (1 - tolerance) * len(triangles)
        radius = np.linalg.norm(mesh.triangles.mean(axis=1), axis=1)  # of the faces' middles, the farthest inside
        assert np.abs(radius - RADIUS).max() < (tolerance + 0.05) * CELL
        assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.03)


@pytest.mark.parametrize("seed", range(3))
def test_a_rough_surface_stays_closed(seed: int) -> None:
    """Full of handles and holes, as of a short training."""
    grid = BrickGrid.from_cells(torch.zeros(3), 1.0, torch.ones((20, 20, 20), dtype=torch.bool))
    values = np.random.default_rng(seed).normal(size=grid.num_rows).astype(np.float32)
    vertices, triangles = find_surface(grid, torch.from_numpy(values))
    mesh = mesh_of(*simplify(vertices, triangles, 0.5))
    assert mesh_of(vertices, triangles).is_watertight
    assert mesh.is_watertight
    assert 0 < len(mesh.faces) < 0.8 * len(triangles)


def test_a_simplified_mesh_has_colors_and_normals_of_its_own(tmp_path: Path, edge_se: Callable) -> None:
    run, path = ball_run(tmp_path), tmp_path / "mesh.ply"
    assert edge_se("export", run, "mesh", "--output-path", path).code == 0
    full = trimesh.load(path, process=False)
    assert edge_se("export", run, "mesh", "--output-path", path, "--tolerance", 0.2).code == 0
    mesh = trimesh.load(path, process=False)
    assert mesh.is_watertight
    assert len(mesh.faces) < 0.5 * len(full.faces)
    directions = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    assert (mesh.vertex_normals * directions).sum(axis=1).min() > 0.9
    np.testing.assert_allclose(mesh.visual.vertex_colors[:, :3] / 255, color_at(mesh.vertices), atol=0.02)


def test_a_tolerance_larger_than_the_surface_is_an_error_and_no_file(tmp_path: Path, edge_se: Callable) -> None:
    path = tmp_path / "mesh.ply"
    answer = edge_se("export", ball_run(tmp_path), "mesh", "--output-path", path, "--tolerance", 1000)
    assert answer.code == 2
    assert "--tolerance is 1000" in answer.err
    assert answer.err.count("\n") == 1
    assert not path.exists()


def test_vertices_on_one_edge_are_one_and_a_vertex_within_a_cell_stays() -> None:
    vertices = np.array([[1, 2, 3.25], [1, 2, 3.25 + 1e-6], [1, 2, 4.25], [1.5, 2.5, 3.5], [1, 2.004, 3]])
    kept, triangles = surface._weld(vertices, np.array([[0, 2, 3], [1, 3, 4]]))
    assert len(kept) == 4
    np.testing.assert_allclose(kept[triangles], vertices[[[0, 2, 3], [1, 3, 4]]], atol=1e-5)


@pytest.mark.parametrize("value", ["0", "1", "-1", "nan"])
def test_an_opacity_is_between_0_and_1(value: str, tmp_path: Path, edge_se: Callable) -> None:
    answer = edge_se("export", ball_run(tmp_path), "mesh", "--opacity-threshold", value)
    assert answer.code == 2
    assert "--opacity-threshold" in answer.err
