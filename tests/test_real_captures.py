"""Captures that nobody here made, in the folder that EDGE_SE_SCENES names."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge_se_sampler.data.dataset import DataSettings, read_split
from edge_se_sampler.data.lens import Intrinsics
from edge_se_sampler.data.views import Views
from edge_se_sampler.masks.segmentation import segment
from edge_se_sampler.occupancy.depths import find_depths


def read(name: str, split: str = "train", **settings: int) -> Views:
    scenes = os.environ.get("EDGE_SE_SCENES")
    if not scenes:
        pytest.skip("EDGE_SE_SCENES does not name a folder of real scenes")
    if not (Path(scenes) / name).is_dir():
        pytest.skip(f"EDGE_SE_SCENES has no {name}")
    views = read_split(Path(scenes) / name, split, DataSettings(**settings))  # type: ignore[arg-type]
    assert views is not None
    return views


def test_fox(capsys: pytest.CaptureFixture[str]) -> None:
    """instant-ngp's: 50 of the 67 listed images exist, the lens distorts, nothing is split."""
    train = read("fox", downscale=8)
    assert capsys.readouterr().err.count("17 of the 67 listed images do not exist") == 1
    test = read("fox", "test", downscale=8)
    assert (len(train.names), len(test.names)) == (43, 7)
    assert train.masks is None
    assert train.images[0].shape == (240, 135, 3)
    # the zoom that leaves nothing unknown
    assert 1375.52 < 8 * float(train.cameras.fx[0]) < 1.02 * 1375.52
    found = find_depths(train)
    assert found.source == "features that several images show"
    assert 0.4 < found.near_share < 0.55
    assert 1.5 < found.near < 2
    assert 9 < found.far < 11


@pytest.mark.slow
def test_colmap_mug() -> None:
    """Every point that a view sees lies in its image, in front of it."""
    train = read("colmap_mug", downscale=4)
    assert (len(train.names), len(read("colmap_mug", "test", downscale=4).names)) == (67, 10)
    assert train.points is not None
    import torch

    for i, points in enumerate(train.points):
        coords, depth = train.cameras.project(i, torch.from_numpy(points))
        assert float(depth.min()) > 0
        inside = ((coords > -1) & (coords < torch.tensor([151, 201]))).all(dim=1)
        assert float(inside.double().mean()) > 0.995
    found = find_depths(train)
    assert found.source == "the points of the reconstruction"
    assert 0 < found.near < 4 < found.far < 20
    without = find_depths(replace(read("colmap_mug", downscale=2), points=None))
    assert without.source == "features that several images show"
    assert 0 < without.near < found.near
    assert without.far == pytest.approx(found.far, rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "near", "far", "source"),
    [
        ("dtu_scan24", (1.9, 2.2), (4.0, 5.2), "features that several images show"),
        ("ethiopianHead", (2.9, 3.3), (5.1, 5.5), "the silhouettes"),
    ],
)
def test_masked_objects(name: str, near: tuple[float, float], far: tuple[float, float], source: str) -> None:
    """The first leaves all images."""
    views = read(name)
    assert views.data_format == "blender"
    found = find_depths(views)
    assert found.source == source
    assert near[0] < found.near < near[1]
    assert far[0] < found.far < far[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "near", "far"), [("dtu_scan24", (1.8, 2.2), (4.0, 5.2)), ("ethiopianHead", (2.8, 3.3), (5.1, 6.5))]
)
def test_objects_without_masks(name: str, near: tuple[float, float], far: tuple[float, float]) -> None:
    """Features alone find what silhouettes do, and leave more room behind."""
    views = read(name)
    found = find_depths(replace(views, images=tuple(image[..., :3].copy() for image in views.images)))
    assert found.source == "features that several images show"
    assert near[0] < found.near < near[1]
    assert far[0] < found.far < far[1]


def test_nerf_synthetic_is_read_as_ever() -> None:
    views = read("chair", downscale=8)
    assert views.depths == (2.0, 6.0)
    np.testing.assert_allclose(views.cameras.fx[0], 1111.1110311937682 / 8, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("background", [255, 128])
@pytest.mark.parametrize("name", ["dtu_scan24", "ethiopianHead"])
def test_masks_are_found_in_front_of_a_plain_background(name: str, background: int, tmp_path: Path) -> None:
    """As they were made by hand; the background is noisy, for of one that is the same everywhere all would be clear."""
    rng, views = np.random.default_rng(0), read(name)
    images, truth = [], [image[..., 3] > 127 for image in views.images]
    for image in views.images:
        alpha = image[..., 3:] / 255
        wall = background + rng.normal(0, 2, image.shape[:2])[..., None]
        images.append((alpha * image[..., :3] + (1 - alpha) * wall).clip(0, 255).round().astype(np.uint8))
    cameras = views.cameras
    intrinsics = zip(*(getattr(cameras, key)[:, 0].tolist() for key in ("fx", "fy", "cx", "cy")), strict=True)
    lenses = [Intrinsics(*values) for values in intrinsics]
    found = segment(images, lenses, list(cameras.camera_to_worlds.numpy()))
    shares = [(one & other).sum() / (one | other).sum() for one, other in zip(found, truth, strict=True)]
    print(f"{name} on {background}: IoU {np.median(shares):.3f}, at least {min(shares):.3f}")
    assert np.median(shares) >= 0.95
