"""Synthetic scenes: where the views look from, and where in them the object is seen."""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_se_sampler.data.synthetic.cameras import DISTANCE, Placement, Split, framing, poses
from edge_se_sampler.data.synthetic.catalogue import SCENE_NAMES, synthetic_scene
from edge_se_sampler.data.synthetic.render import render
from edge_se_sampler.data.synthetic.scene import Material, SceneBuilder

SPLITS: tuple[Split, ...] = ("train", "val", "test")
OFFSET = (0.2, -0.15)


@pytest.mark.parametrize("split", SPLITS)
def test_view_i_does_not_depend_on_how_many(split: Split) -> None:
    many = poses(split, 23, seed=5)
    for count in (0, 1, 4, 22):
        np.testing.assert_array_equal(poses(split, count, seed=5), many[:count])


def test_seed_moves_train_and_val_but_not_test() -> None:
    for split in ("train", "val"):
        assert not np.array_equal(poses(split, 3, seed=0), poses(split, 3, seed=1))
    np.testing.assert_array_equal(poses("test", 3, seed=0), poses("test", 3, seed=1))
    views = [pose.tobytes() for split in SPLITS for seed in (0, 1, 2**31 - 1) for pose in poses(split, 5, seed)]
    assert len(set(views)) == 5 * (3 + 3 + 1)


@pytest.mark.parametrize("split", SPLITS)
def test_cameras_look_at_the_origin_from_the_upper_hemisphere(split: Split) -> None:
    for pose in poses(split, 40):
        rotation, eye = pose[:3, :3], pose[:3, 3]
        assert np.linalg.norm(eye) == pytest.approx(DISTANCE, abs=1e-9)
        np.testing.assert_allclose(rotation[:, 2], eye / DISTANCE, atol=1e-9)  # back; the camera looks along -z
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-9)
        assert np.linalg.det(rotation) == pytest.approx(1)
        assert rotation[2, 0] == 0  # the horizon is level
        assert rotation[2, 1] > 0  # and the right way up
        assert eye[2] > 0


def test_train_cameras_are_uniform_in_area() -> None:
    eyes = np.array(poses("train", 4000))[:, :3, 3] / DISTANCE
    height = np.sort((eyes[:, 2] - 0.02) / 0.96)
    azimuth = np.sort(np.arctan2(eyes[:, 1], eyes[:, 0]) / (2 * np.pi) % 1)
    ideal = (np.arange(4000) + 0.5) / 4000
    for values in (height, azimuth):  # Kolmogorov's distance; 2.7 / sqrt(n) is exceeded once in a million
        assert np.abs(values - ideal).max() < 2.7 / math.sqrt(4000)


def test_test_cameras_are_spread_evenly() -> None:
    for count in (5, 10, 33):
        eyes = np.array(poses("test", count))[:, :3, 3]
        azimuth = np.sort(np.arctan2(eyes[:, 1], eyes[:, 0])) / (2 * np.pi)
        gaps = np.diff(np.append(azimuth, azimuth[0] + 1))
        assert gaps.max() < 2 / count + 1e-9
        elevation = np.degrees(np.arcsin(eyes[:, 2] / DISTANCE))
        assert elevation.min() >= 15
        assert elevation.max() <= 45
        assert np.ptp(elevation) > 10


@pytest.mark.parametrize("name", SCENE_NAMES)
def test_shifted_and_padded_are_the_centered_picture_pasted(name: str) -> None:
    scene = synthetic_scene(name)
    pose = poses("train", 2)[1]
    size, frame = 40, 24
    placements: list[tuple[Placement, int, int]] = [("shifted", 8, -6), ("padded", 0, 0)]
    for placement, dx, dy in placements:
        pasted = np.zeros((size, size, 4), dtype=np.uint8)
        top, left = (size - frame) // 2 + dy, (size - frame) // 2 + dx
        pasted[top : top + frame, left : left + frame] = render(scene, framing(frame).camera(pose))
        placed = render(scene, framing(size, placement, OFFSET).camera(pose))
        np.testing.assert_array_equal(placed, pasted)
        assert (placed[..., 3] > 0).any()


@pytest.mark.parametrize("size", [40, 41, 100])
def test_rotated_shows_the_origin_where_shifted_does(size: int) -> None:
    shifted, rotated = framing(size, "shifted", OFFSET), framing(size, "rotated", OFFSET)
    assert shifted.focal == rotated.focal
    assert rotated.principal == (size / 2, size / 2)
    assert shifted.principal == (size / 2 + round(0.2 * size), size / 2 + round(-0.15 * size))
    for pose in poses("train", 8):
        camera = rotated.camera(pose)
        x, y, z = np.linalg.inv(camera.to_world)[:3, 3]  # the origin, in the camera's frame
        seen_at = (size / 2 - camera.focal * x / z, size / 2 + camera.focal * y / z)
        assert seen_at == pytest.approx(shifted.principal, abs=1e-8)
        np.testing.assert_array_equal(camera.to_world[:3, 3], pose[:3, 3])
        rotation = camera.to_world[:3, :3]
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-11)
        assert np.linalg.det(rotation) == pytest.approx(1)
        angle = math.acos((np.trace(rotation.T @ pose[:3, :3]) - 1) / 2)  # no more than the tilt: no roll
        assert angle == pytest.approx(math.acos(-z / DISTANCE), abs=1e-6)


@pytest.mark.parametrize("name", SCENE_NAMES)
def test_default_offset_clips_nothing_when_rotated(name: str) -> None:
    frame = framing(100, "rotated", (0.2, 0.15))
    for pose in (*poses("train", 2), poses("test", 1)[0]):
        alpha = render(synthetic_scene(name), frame.camera(pose))[..., 3]
        border = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
        assert alpha.any()
        assert not border.any()


def test_default_offset_holds_the_whole_ball_when_rotated() -> None:
    frame = framing(100, "rotated", (0.2, 0.15))
    camera = frame.camera(poses("train", 1)[0])
    builder = SceneBuilder()
    builder.sphere((0, 0, 0), 1, Material((0.5, 0.5, 0.5)))
    alpha = render(builder.build(), camera)[..., 3]
    assert not np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]]).any()
