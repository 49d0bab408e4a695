"""Pictures of meshes: what a camera sees of triangles, and the file."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from exported import CELL, RADIUS, ball_run
from tiny import ball_views

from edge_se_sampler.export import picture
from edge_se_sampler.export.picture import rasterize

trimesh = pytest.importorskip("trimesh")
for package in ("manifold3d", "skimage"):
    pytest.importorskip(package)
VIEWS = ball_views(6, 24, RADIUS)


@pytest.mark.parametrize(("at_once", "order"), [(2**22, 1), (50, 1), (50, -1)])
def test_a_camera_sees_the_front_of_a_ball(at_once: int, order: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many triangles are looked at together, and in whatever order."""
    monkeypatch.setattr(picture, "PIXELS_AT_ONCE", at_once)
    ball, camera = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS), VIEWS.cameras[[1]]
    vertices, triangles = np.array(ball.vertices), np.array(ball.faces)[::order]
    face, shares, depth = rasterize(vertices, triangles, camera)
    hit = face >= 0
    silhouette = VIEWS.images[1][..., 3] > 0
    assert (silhouette != hit).sum() <= 0.03 * silhouette.sum()
    points = (shares[..., None] * vertices[triangles[face]]).sum(axis=2)[hit]
    coords, distance = camera.project(0, torch.from_numpy(points))
    np.testing.assert_allclose(coords, np.argwhere(hit) + 0.5, atol=1e-6)
    np.testing.assert_allclose(distance, depth[hit])
    back = camera.camera_to_worlds[0, :, 2].numpy()
    assert (points @ back > 0).all()  # not of the ball's back
    assert np.isinf(depth[~hit]).all()


def test_what_is_not_in_front_of_the_camera_or_in_the_image_is_not_seen() -> None:
    camera = VIEWS.cameras[[0]]
    pose = camera.camera_to_worlds[0].numpy()
    corners = np.array([[-1.0, -1, -2], [1, -1, -2], [0, 1, -2]])  # in the camera's axes
    for moved in (corners * (1, 1, -1), corners - (5, 0, 0), corners * (1, 0, 1)):
        assert (rasterize(moved @ pose[:, :3].T + pose[:, 3], np.array([[0, 1, 2]]), camera)[0] == -1).all()
    assert (rasterize(corners @ pose[:, :3].T + pose[:, 3], np.array([[0, 1, 2]]), camera)[0] == 0).any()


def test_the_picture_shows_truth_rendering_and_mesh(tmp_path: Path, edge_se: Callable) -> None:
    run, path = ball_run(tmp_path), tmp_path / "mesh.png"
    shutil.copy(tmp_path / "scene" / "transforms_train.json", tmp_path / "scene" / "transforms_test.json")
    flags = ("--output-path", tmp_path / "mesh.ply", "--picture", path, "--picture-view")
    answer = edge_se("export", run, "mesh", *flags, 2)
    assert answer.code == 0, answer.err
    truth, rendered, colored, lit = np.split(iio.imread(path) / 255, 4, axis=1)
    silhouette = iio.imread(tmp_path / "scene" / "2.png")[..., 3] > 0
    for image in (truth, rendered, colored, lit):
        assert ((image.min(axis=2) < 0.99) != silhouette).mean() < 0.05
    inside = np.all([np.roll(silhouette, by, axis) for axis in (0, 1) for by in (3, -3)], axis=0)
    assert np.abs(colored - rendered)[inside].max() < 0.06
    assert (lit.max(axis=2) == lit.min(axis=2)).all()
    assert lit[inside].max() > 0.95 > 0.8 > lit[inside].min()
    found = re.search(r"mesh is (\S+) pixels", answer.out)
    assert found is not None
    # the rendered depth is about a cell within the surface
    assert 0.5 < float(found[1]) / (CELL / (4 - RADIUS) * 1.4 * 48) < 1.5
    for view in (6, -1):
        answer = edge_se("export", run, "mesh", *flags, view)
        assert answer.code == 2
        assert "--picture-view" in answer.err
    answer = edge_se("export", run, "mesh", *flags[:2], "--picture-view", 1)
    assert answer.code == 2
    assert "--picture" in answer.err
