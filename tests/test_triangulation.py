"""Points where rays through features meet that images share."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.views import Views
from edge_se_sampler.occupancy import triangulation
from edge_se_sampler.occupancy.depths import find_depths
from edge_se_sampler.occupancy.triangulation import find_points

SIDE, FOCAL_LENGTH, DISTANCE = 160, 180.0, 4.0


def looking_at_the_origin(positions: np.ndarray) -> Cameras:
    """Cameras at (n, 3) positions."""
    back = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    right = np.cross((0.0, 1.0, 0.0), back)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.stack((right, np.cross(back, right), back, positions), axis=2)
    sizes = np.full(len(positions), SIDE)
    focal = np.full(len(positions), FOCAL_LENGTH)
    return Cameras.of(poses, fx=focal, fy=focal, cx=sizes / 2, cy=sizes / 2, width=sizes, height=sizes)


def plane_views(positions: np.ndarray) -> Views:
    """Images of a plane, z = 0, that is painted with blots."""
    noise = np.random.default_rng(0).random((768, 768), dtype=np.float32)
    blots = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 4.0), None, 0, 255, cv2.NORM_MINMAX)  # pyright: ignore
    cameras, images = looking_at_the_origin(positions), []
    for i in range(len(positions)):
        rays = cameras.image_rays(i)
        hit = rays.origins - rays.origins[:, 2:] / rays.directions[:, 2:] * rays.directions
        x, y = ((hit[:, :2] + 3) * 128).reshape(SIDE, SIDE, 2).float().unbind(dim=2)
        seen = cv2.remap(blots, x.numpy(), y.numpy(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        images.append(np.repeat(seen[..., None], 3, axis=2).astype(np.uint8))
    names = tuple(f"{i}.png" for i in range(len(images)))
    return Views(names, tuple(images), None, cameras, depths=None)


@pytest.fixture(scope="module")
def plane() -> Views:
    angles = np.linspace(-0.5, 0.5, 6)
    return plane_views(DISTANCE * np.stack((np.sin(angles), 0.1 * angles, np.cos(angles)), axis=1))


def all_points(views: Views | None) -> np.ndarray:
    assert views is not None
    assert views.points is not None
    return np.concatenate(views.points)


def test_points_lie_where_the_images_show_something(plane: Views) -> None:
    points = all_points(find_points(plane))
    assert len(points) > 500
    assert (np.abs(points[:, 2]) < 0.1).mean() > 0.98
    assert np.ptp(points[:, 0]) > 2


def test_they_are_seen_by_the_views_they_are_listed_for(plane: Views) -> None:
    found = find_points(plane)
    assert found is not None
    for i, points in enumerate(found.points or ()):
        coords, depth = found.cameras.project(i, torch.from_numpy(points))
        assert len(points) > 50
        assert bool((depth > 0).all())
        assert bool(((coords > -1) & (coords < SIDE + 1)).all())


def test_depths_follow_from_them(plane: Views) -> None:
    """Of each camera, the plane begins at no less than 3.2 of 4."""
    found = find_depths(plane)
    assert found.source == "features that several images show"
    assert 0.6 < found.near_share < 0.85
    assert found.near == pytest.approx(found.near_share * DISTANCE, rel=0.02)
    assert 5 < found.far < 8


def cut_out(views: Views, left: float) -> Views:
    """The views with alpha: of the plane only x from left to 1, and y from -1 to 1, is there."""
    images = []
    for i, image in enumerate(views.images):
        rays = views.cameras.image_rays(i)
        hit = rays.origins - rays.origins[:, 2:] / rays.directions[:, 2:] * rays.directions
        there = (hit[:, 0] > left) & (hit[:, 0] < 1) & (hit[:, 1].abs() < 1)
        alpha = 255 * there.byte().numpy().reshape(SIDE, SIDE, 1)
        images.append(np.concatenate((image, alpha), axis=2))
    return replace(views, images=tuple(images))


def test_they_count_where_images_cut_the_object_off(plane: Views) -> None:
    """The plane goes on beyond the left edge of all images."""
    views = cut_out(plane, left=-9)
    found = find_depths(views)
    assert found.source == "features that several images show"
    assert found.near == pytest.approx(found.near_share * DISTANCE, rel=0.02)
    flat = tuple(np.where([1, 1, 1, 0], 200, image).astype(np.uint8) for image in views.images)
    assert "cameras" in find_depths(replace(views, images=flat)).source


def test_silhouettes_of_the_whole_object_need_none(plane: Views, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(triangulation, "_find_features", lambda *_: pytest.fail("features were looked for"))
    assert find_depths(cut_out(plane, left=-1)).source == "the silhouettes"


def test_what_is_unknown_has_no_features(plane: Views) -> None:
    """Of each image the left half is masked."""
    known = np.zeros((SIDE, SIDE), bool)
    known[:, SIDE // 2 :] = True
    found = find_points(plane.with_masks([known] * len(plane.names)))
    assert found is not None
    for i, points in enumerate(found.points or ()):
        coords, _ = found.cameras.project(i, torch.from_numpy(points))
        assert float(coords[:, 1].min()) > SIDE / 2 - 2


def test_images_that_show_nothing_have_none(plane: Views) -> None:
    flat = replace(plane, images=tuple(np.full_like(image, 200) for image in plane.images))
    assert find_points(flat) is None
    assert "cameras" in find_depths(flat).source
    assert find_points(plane.subset([0])) is None


@pytest.mark.parametrize("shape", [(1, 1, 3), (2, 900, 3), (7, 3, 4)])
def test_images_of_any_size_are_looked_at(shape: tuple[int, int, int], plane: Views) -> None:
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    assert find_points(replace(plane, images=(image,) * len(plane.images))) is None


def test_cameras_that_only_turn_tell_no_depth(plane: Views) -> None:
    poses = plane.cameras.camera_to_worlds.clone()
    poses[:, :, 3] = poses[0, :, 3]
    assert find_points(replace(plane, cameras=replace(plane.cameras, camera_to_worlds=poses))) is None


def test_rays_that_are_almost_parallel_tell_no_depth() -> None:
    angles = np.radians(np.linspace(-0.9, 0.9, 4))
    assert find_points(plane_views(DISTANCE * np.stack((np.sin(angles), 0 * angles, np.cos(angles)), axis=1))) is None


def test_wrong_matches_show_by_the_cameras(plane: Views) -> None:
    """Each image is moved down by other pixels: the rays through what two of them share miss each other."""
    moved = tuple(np.roll(image, 12 * i, axis=0) for i, image in enumerate(plane.images))
    found = find_points(replace(plane, images=moved))
    assert found is None or len(all_points(found)) < 0.02 * len(all_points(find_points(plane)))


def test_some_of_many_views_are_enough(plane: Views, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(triangulation, "MAX_VIEWS", 3)
    found = find_points(plane)
    assert found is not None
    assert len(found.names) == len(found.points or ()) == 3
    assert found.names[0] == "0.png"
    assert found.names[-1] == "5.png"


def test_a_model_is_asked_for_no_features_where_points_or_depths_are_known(
    plane: Views, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(triangulation, "_find_features", lambda *_: pytest.fail("features were looked for"))
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    assert "reconstruction" in find_depths(replace(plane, points=(points,) * len(plane.names))).source
    assert find_depths(replace(plane, depths=(2.0, 6.0))).near == 2
