"""Points and splats of a known ball: where they are, which way they face, and the formats that others read."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from exported import CELL, OPACITY, RADIUS, ball_model, ball_run, color_at, read_ply
from tiny import ball_views

from edge_se_sampler.export.points import PointCloud, find_points

for package in ("manifold3d", "scipy", "skimage", "trimesh"):
    pytest.importorskip(package)
VIEWS = ball_views(6, 48, RADIUS)
SEEN_RADIUS = RADIUS - CELL * np.log(2 * np.log(2) / -np.log(1 - OPACITY)) / 2
"""At which half of the light is lost on the way to the center: density's logarithm rises by 2 from cell to cell."""
GAUSSIAN = [
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(45)),
    "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
]  # fmt: skip
"""Properties of a file that 3D Gaussian Splatting's code writes, in its order."""


def points_of(num_points: int = 1500, seed: int = 0, views=VIEWS, model=None) -> PointCloud:
    return find_points(model or ball_model(), views, num_points, np.random.default_rng(seed))


def stacked(columns: dict[str, np.ndarray], *names: str) -> np.ndarray:
    return np.stack([columns[name] for name in names], axis=1).astype(np.float64)


def test_points_lie_on_the_surface_and_face_outwards_in_its_colors() -> None:
    cloud = points_of()
    assert len(cloud.positions) == 1500
    radius = np.linalg.norm(cloud.positions, axis=1)
    assert radius.min() > SEEN_RADIUS - 0.3 * CELL
    assert radius.max() < RADIUS  # at its edge, where rays graze it
    assert abs(np.median(radius) - SEEN_RADIUS) < 0.3 * CELL
    cosine = (cloud.normals * cloud.positions).sum(axis=1) / radius
    assert np.quantile(cosine, 0.01) > 0.9
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1)
    np.testing.assert_allclose(cloud.colors, color_at(cloud.positions), atol=0.02)
    assert (cloud.opacity > 0.5).all()


def test_spacing_is_the_mean_distance_to_the_three_nearest() -> None:
    cloud = points_of(200)
    between = np.linalg.norm(cloud.positions[:, None] - cloud.positions, axis=2)
    np.testing.assert_allclose(cloud.spacing, np.sort(between, axis=1)[:, 1:4].mean(axis=1))


def test_pixels_are_drawn_by_the_seed_and_none_twice() -> None:
    first, again, other = (points_of(300, seed).positions for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.isin(first[:, 0], other[:, 0]).all()
    everything = points_of(10**6).positions
    assert 1500 < len(everything) < 6 * 48 * 48
    assert len(np.unique(everything, axis=0)) == len(everything)


def test_every_pixel_is_its_own_views() -> None:
    """Views of one pixel, which looks at the origin."""
    views, model = ball_views(20, 1, RADIUS), ball_model()
    model.supersampled.fill_(False)  # of such pixels the corners see nothing
    positions = points_of(20, views=views, model=model).positions
    directions = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    expected = views.cameras.camera_to_worlds[:, :, 3].numpy() / 4
    np.testing.assert_allclose(
        directions[np.argsort(directions[:, 0])], expected[np.argsort(expected[:, 0])], atol=1e-3
    )


def test_masked_pixels_give_no_points() -> None:
    mask = np.zeros((48, 48), dtype=bool)
    mask[:, :24] = True
    cloud = points_of(10**6, views=replace(VIEWS, masks=(mask, *(np.zeros_like(mask),) * 5)))
    coords, _ = VIEWS.cameras.project(0, torch.from_numpy(cloud.positions))
    assert len(cloud.positions) > 100
    assert coords[:, 1].max() < 24


def test_the_mean_of_two_surfaces_is_no_point() -> None:
    """Half of the light passes a sheet in front of a larger one: where both are seen, the mean depth is between them,
    where nothing is."""
    model = ball_model()
    cells = torch.zeros((40, 40, 40), dtype=torch.bool)
    cells[:, :, 5:7] = cells[12:28, 12:28, 33:35] = True
    model.grid = type(model.grid).from_cells(model.grid.aabb_min, CELL, cells)
    model.density = torch.nn.Parameter(torch.full((model.grid.num_rows, 1), float(np.log(0.4))))
    model.features = torch.nn.Parameter(torch.zeros((model.grid.num_rows, 16)))
    pose = torch.eye(4, dtype=torch.float64)[None, :3]
    pose[0, 2, 3] = 4
    views = ball_views(1, 16, 0.5)
    views = replace(views, cameras=replace(views.cameras, camera_to_worlds=pose))
    cloud = points_of(100, views=views, model=model)
    assert cloud.positions[:, 2].max() < -0.6
    np.testing.assert_allclose(cloud.colors, 1 / (1 + np.exp(3)), atol=0.01)  # without the white behind
    model.density.data.fill_(3)
    assert points_of(100, views=views, model=model).positions[:, 2].max() > 0.6


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_points_are_read_back(scale: float, tmp_path: Path, edge_se: Callable) -> None:
    path = tmp_path / "points.ply"
    answer = edge_se("export", ball_run(tmp_path, scale), "points", "--output-path", path, "--num-points", 700)
    assert answer.code == 0, answer.err
    assert "700 points" in answer.out
    columns = read_ply(path)
    assert list(columns) == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"]  # 3DGS's order, and OpenSplat's
    positions = stacked(columns, "x", "y", "z")
    radius = np.linalg.norm(positions, axis=1) / scale
    assert SEEN_RADIUS - 0.3 * CELL < radius.min() < radius.max() < RADIUS
    colors = stacked(columns, "red", "green", "blue") / 255
    np.testing.assert_allclose(colors, color_at(positions / scale), atol=0.02)
    loaded = pytest.importorskip("trimesh").load(path, process=False)
    np.testing.assert_array_equal(loaded.vertices, positions)
    np.testing.assert_array_equal(loaded.colors[:, :3] / 255, colors)


def test_plyfile_reads_points(tmp_path: Path, edge_se: Callable) -> None:
    """As 3D Gaussian Splatting's loader does."""
    plyfile, path = pytest.importorskip("plyfile"), tmp_path / "points.ply"
    assert edge_se("export", ball_run(tmp_path), "points", "--output-path", path, "--num-points", 100).code == 0
    vertices = plyfile.PlyData.read(path)["vertex"]
    assert len(vertices["x"]) == 100
    assert {vertices[name].dtype.itemsize for name in ("red", "green", "blue")} == {1}


def test_open3d_reads_points(tmp_path: Path, edge_se: Callable) -> None:
    """As nerfstudio's splatfacto does."""
    open3d, path = pytest.importorskip("open3d"), tmp_path / "points.ply"
    assert edge_se("export", ball_run(tmp_path), "points", "--output-path", path, "--num-points", 100).code == 0
    cloud = open3d.io.read_point_cloud(str(path))
    assert len(cloud.points) == len(cloud.colors) == len(cloud.normals) == 100


def test_splats_are_flat_gaussians_on_the_surface(tmp_path: Path, edge_se: Callable) -> None:
    run, flags = ball_run(tmp_path), ("--num-points", 500, "--seed", 3)
    for kind in ("points", "splats"):
        assert edge_se("export", run, kind, "--output-path", tmp_path / f"{kind}.ply", *flags).code == 0
    points, splats = (read_ply(tmp_path / f"{kind}.ply") for kind in ("points", "splats"))
    assert list(splats) == GAUSSIAN
    for name in ("x", "y", "z", "nx", "ny", "nz"):
        np.testing.assert_array_equal(points[name], splats[name])
    colors = 0.5 + 0.28209479 * stacked(splats, "f_dc_0", "f_dc_1", "f_dc_2")
    np.testing.assert_allclose(colors, stacked(points, "red", "green", "blue") / 255, atol=0.51 / 255)
    assert not stacked(splats, *(f"f_rest_{i}" for i in range(45))).any()
    opacity = 1 / (1 + np.exp(-splats["opacity"].astype(float)))
    assert (opacity > 0.5).all()
    assert np.median(opacity) == pytest.approx(0.99)  # of a solid, as near to 1 as a logit should be
    scales = np.exp(stacked(splats, "scale_0", "scale_1", "scale_2"))
    positions = stacked(splats, "x", "y", "z")
    between = np.sort(np.linalg.norm(positions[:, None] - positions, axis=2), axis=1)
    np.testing.assert_allclose(scales[:, :2], between[:, 1:4].mean(axis=1, keepdims=True).repeat(2, 1) / 2, rtol=1e-4)
    assert (scales[:, 2] < 0.2 * scales[:, 0]).all()
    w, x, y, z = stacked(splats, "rot_0", "rot_1", "rot_2", "rot_3").T  # a unit quaternion's third column
    axis = np.stack((2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)), axis=1)
    np.testing.assert_allclose(w * w + x * x + y * y + z * z, 1, rtol=1e-5)
    np.testing.assert_allclose(np.abs((axis * stacked(splats, "nx", "ny", "nz")).sum(axis=1)), 1, atol=1e-5)


def test_any_model_that_renders_has_points(tmp_path: Path, run: Path, edge_se: Callable) -> None:
    """A dense network, too, unless it has learned nothing."""
    answer = edge_se("export", run, "points", "--output-path", tmp_path / "points.ply", "--num-points", 20)
    assert (answer.code, "learned nothing" in answer.err) in {(0, False), (2, True)}
    assert (tmp_path / "points.ply").exists() == (answer.code == 0)


def test_nothing_opaque_is_an_error_and_no_file(tmp_path: Path, edge_se: Callable) -> None:
    run = ball_run(tmp_path, empty=True)
    for kind in ("points", "splats"):
        answer = edge_se("export", run, kind, "--output-path", tmp_path / "points.ply")
        assert answer.code == 2
        assert answer.err.startswith("edge-se: ")
        assert answer.err.count("\n") == 1
    assert not (tmp_path / "points.ply").exists()


REFUSED = {
    "mesh": [
        ("--output-path", "mesh.obj"), ("--output-path", "nowhere/mesh.ply"), ("--keep-components", "-1"),
        ("--tolerance", "-1"), ("--tolerance", "inf"), ("--picture", "mesh.jpg"), ("--picture", "nowhere/mesh.png"),
    ],
    "points": [("--output-path", "points.glb"), ("--num-points", "3")],
    "splats": [("--output-path", "."), ("--num-points", "0")],
    "cameras": [("--output-path", "cameras.txt"), ("--output-path", "nowhere/transforms.json")],
}  # fmt: skip


@pytest.mark.parametrize(("kind", "flags"), [(kind, flags) for kind, each in REFUSED.items() for flags in each])
def test_bad_flags_are_refused(
    kind: str, flags: tuple[str, str], tmp_path: Path, edge_se: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = ball_run(tmp_path)
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    answer = edge_se("export", run, kind, *flags)
    assert answer.code == 2
    assert flags[0] in answer.err
    assert answer.err.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("kind", ["mesh", "points", "splats"])
def test_without_the_extra_the_message_says_how_to_install_it(
    kind: str, tmp_path: Path, edge_se: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "trimesh" if kind == "mesh" else "scipy", None)
    answer = edge_se("export", ball_run(tmp_path), kind, "--output-path", tmp_path / "out.ply")
    assert answer.code == 2
    assert "pip install 'edge-se-sampler[export]'" in answer.err


@pytest.mark.parametrize("kind", ["mesh", "points", "cameras"])
def test_an_interrupted_export_leaves_the_file_that_was_there(
    kind: str, tmp_path: Path, edge_se: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, path = ball_run(tmp_path), tmp_path / f"out.{'json' if kind == 'cameras' else 'ply'}"
    before = '{"exported_by": "edge-se export"}'  # or it would not be replaced
    path.write_text(before)
    names = sorted(tmp_path.iterdir())

    def interrupt(_: int) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("edge_se_sampler.engine.files.os.fsync", interrupt)
        assert edge_se("export", run, kind, "--output-path", path).code == 130
    assert path.read_text() == before
    assert sorted(tmp_path.iterdir()) == names
    assert edge_se("export", run, kind, "--output-path", path).code == 0
    assert path.read_bytes() != before.encode()
