"""Cameras that move through a scene: they follow it wherever it is, however it is turned, and whatever its size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import tiny_views

from edge_se_sampler.data.cameras import Cameras, rotation_power
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.trajectories import find_up, spiral, through

TILT = rotation_power(torch.linalg.qr(torch.randn((3, 3), generator=torch.Generator().manual_seed(2)).double())[0], 2)
CENTER, SCALE = np.array([30.0, -7.0, 11.0]), 5.0


def looking_at_origin(azimuths: np.ndarray, elevations: np.ndarray, distance: float = 4.0) -> np.ndarray:
    """(n, 3, 4) poses with z up; angles in degrees."""
    azimuth, elevation = np.radians(azimuths), np.radians(elevations)
    flat = np.stack((np.cos(azimuth), np.sin(azimuth), 0 * azimuth), axis=1)
    back = np.cos(elevation)[:, None] * flat + np.sin(elevation)[:, None] * (0, 0, 1)
    right = np.cross((0, 0, 1), flat)
    return np.stack((right, np.cross(back, right), back, distance * back), axis=2)


def views_of(poses: np.ndarray, moved: bool = False) -> Views:
    """Views from these poses; moved: the scene is tilted, larger, and somewhere else."""
    if moved:
        tilt = TILT.numpy()
        poses = np.concatenate((tilt @ poses[:, :, :3], SCALE * (tilt @ poses[:, :, 3:]) + CENTER[:, None]), axis=2)
    cameras = Cameras.of(poses, fx=7, fy=8, cx=3, cy=4, width=6, height=8)
    return replace(tiny_views(len(poses)), cameras=cameras)


def depths(moved: bool) -> tuple[float, float]:
    return (2 * SCALE, 6 * SCALE) if moved else (2.0, 6.0)


RNG = np.random.default_rng(4)
DOME = looking_at_origin(RNG.uniform(0, 360, 200), RNG.uniform(10, 50, 200))
ARC = looking_at_origin(RNG.uniform(-40, 40, 100), RNG.uniform(20, 40, 100))


def scene_axes(cameras: Cameras, moved: bool) -> tuple[np.ndarray, np.ndarray]:
    """Positions and rotations in the axes and units of the scene that was moved."""
    poses = cameras.camera_to_worlds.numpy()
    if not moved:
        return poses[:, :, 3], poses[:, :, :3]
    tilt = TILT.numpy()
    return (poses[:, :, 3] - CENTER) @ tilt / SCALE, tilt.T @ poses[:, :, :3]


@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("poses", [DOME, ARC], ids=["dome", "arc"])
def test_every_camera_is_upright_and_looks_at_what_the_training_views_look_at(poses: np.ndarray, moved: bool) -> None:
    cameras = spiral(views_of(poses, moved), depths(moved), 17)
    positions, rotations = scene_axes(cameras, moved)
    np.testing.assert_allclose(
        rotations.transpose(0, 2, 1) @ rotations, np.broadcast_to(np.eye(3), (17, 3, 3)), atol=1e-9
    )
    assert (np.linalg.det(rotations) > 0).all()
    np.testing.assert_allclose(positions, 4 * rotations[:, :, 2], atol=1e-6)  # at the median distance
    np.testing.assert_allclose(rotations[:, 2, 0], 0, atol=0.05)  # right is level
    assert (rotations[:, 2, 1] > 0.5).all()  # up is up


@pytest.mark.parametrize("moved", [False, True])
def test_views_all_around_are_circled_once_between_the_quartiles_of_their_elevation(moved: bool) -> None:
    positions, _ = scene_axes(spiral(views_of(DOME, moved), depths(moved), 360), moved)
    azimuth = np.unwrap(np.arctan2(positions[:, 1], positions[:, 0]))
    assert abs(azimuth[-1] - azimuth[0]) == pytest.approx(2 * np.pi * 359 / 360, rel=0.01)
    elevation = np.degrees(np.arcsin(positions[:, 2] / 4))
    assert elevation.min() == pytest.approx(20, abs=3)
    assert elevation.max() == pytest.approx(40, abs=3)


@pytest.mark.parametrize("moved", [False, True])
def test_views_on_one_side_are_not_left(moved: bool) -> None:
    positions, _ = scene_axes(spiral(views_of(ARC, moved), depths(moved), 60), moved)
    azimuth = np.degrees(np.arctan2(positions[:, 1], positions[:, 0]))
    elevation = np.degrees(np.arcsin(positions[:, 2] / 4))
    assert np.abs(azimuth).max() < 30
    assert np.ptp(azimuth) > 20
    assert 20 < elevation.min() < elevation.max() < 40
    steps = np.linalg.norm(np.diff(positions, axis=0, append=positions[:1]), axis=1)
    assert steps.max() < 0.3  # it closes


@pytest.mark.parametrize("width", [80, 210])
@pytest.mark.parametrize("middle", range(0, 360, 45))
def test_the_arc_may_lie_where_angles_jump(middle: float, width: float) -> None:
    arc = looking_at_origin(middle + np.linspace(-width / 2, width / 2, 50), np.full(50, 30))
    positions = spiral(views_of(arc), (2.0, 6.0), 60).camera_to_worlds[:, :, 3].numpy()
    azimuth = np.degrees(np.arctan2(positions[:, 1], positions[:, 0]))
    off = (azimuth - middle + 180) % 360 - 180
    assert (off.min(), off.max()) == pytest.approx((-width / 4, width / 4), abs=2)


def test_up_is_vertical_though_views_on_one_side_look_down() -> None:
    half = views_of(looking_at_origin(np.linspace(-90, 90, 40), np.full(40, 45)))
    assert find_up(half.cameras)[2] > np.cos(np.radians(3))
    assert half.cameras.camera_to_worlds[:, 2, 1].mean() < np.cos(np.radians(40))  # unlike the mean of their ups


def test_a_camera_alone_has_a_path_too() -> None:
    views = views_of(DOME[:1])
    for trajectory in (spiral, through):
        poses = trajectory(views, (2.0, 6.0), 3).camera_to_worlds.numpy()
        np.testing.assert_allclose(poses, np.repeat(DOME[:1], 3, axis=0), atol=0.2)


@pytest.mark.parametrize("moved", [False, True])
def test_interpolation_passes_through_every_pose_in_order_without_a_kink(moved: bool) -> None:
    views = views_of(DOME[:20], moved)
    poses = through(views, depths(moved), 19 * 100 + 1).camera_to_worlds.numpy()
    np.testing.assert_allclose(poses[::100], views.cameras.camera_to_worlds.numpy(), atol=1e-9)
    velocity = np.diff(poses, axis=0)
    kinks = np.abs(np.diff(velocity, axis=0)).max(axis=(1, 2))
    assert kinks[99::100].max() <= 2 * kinks.max(initial=0, where=np.arange(len(kinks)) % 100 != 99)
    rotation = poses[:, :, :3]
    np.testing.assert_allclose(
        rotation.transpose(0, 2, 1) @ rotation, np.broadcast_to(np.eye(3), rotation.shape), atol=1e-9
    )


def test_interpolation_turns_evenly_through_any_number_of_turns() -> None:
    views = views_of(looking_at_origin(np.linspace(0, 1440, 60), np.full(60, 30)))
    rotations = through(views, (2.0, 6.0), 600).camera_to_worlds[:, :, :3].numpy()
    steps = np.linalg.norm(np.diff(rotations, axis=0), axis=(1, 2))
    assert steps.max() < 1.3 * np.median(steps)


def test_interpolation_goes_around_what_is_looked_at() -> None:
    """Though the views are on opposite sides of it."""
    views = views_of(looking_at_origin(np.array([0, 170, 340, 150]), np.full(4, 30)))
    positions = through(views, (2.0, 6.0), 100).camera_to_worlds[:, :, 3].norm(dim=1)
    assert float(positions.min()) > 3.5


def test_intrinsics_and_size_are_the_first_cameras() -> None:
    views = views_of(DOME[:5])
    for trajectory in (spiral, through):
        cameras = trajectory(views, (2.0, 6.0), 7)
        assert len(cameras) == 7
        for key in ("fx", "fy", "cx", "cy", "width", "height"):
            assert getattr(cameras, key).tolist() == [getattr(views.cameras, key)[0].tolist()] * 7
