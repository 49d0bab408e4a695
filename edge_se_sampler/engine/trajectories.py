"""Cameras that move through a scene, by its training views.

focus      the point that the training cameras look at
azimuth    angle of a camera around the vertical axis through the focus, radians
elevation  its angle above the horizontal plane through the focus, radians
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.views import Views
from edge_se_sampler.occupancy.hull import find_box

LEVEL = 0.02
"""How much less than the mean up the cameras' horizons count where they agree on a plane."""
ALL_AROUND = math.radians(135)
"""Views stand all around the scene if no gap between the azimuths of neighbours is wider."""


def find_up(cameras: Cameras) -> np.ndarray:
    """The scene's vertical, a unit vector (3,): the cameras' mean up, made perpendicular to their right axes where
    these span a plane; cameras are seldom rolled, but often look down."""
    poses = cameras.camera_to_worlds.numpy()
    mean_up = poses[:, :, 1].mean(axis=0) + 1e-9 * np.eye(3)[2]  # if all cancels out: z
    right = poses[:, :, 0]
    up = np.linalg.solve(right.T @ right / len(poses) + LEVEL * np.eye(3), mean_up)
    return up / np.linalg.norm(up)


def spiral(views: Views, depths: tuple[float, float], count: int) -> Cameras:
    """Cameras that look at the focus from the median distance of the training views, with the first one's intrinsics
    and size: once around, rising and falling twice between the quartiles of their elevation; or, where the views do not
    stand all around, on an ellipse between the quartiles of azimuth and elevation. depths: near and far."""
    poses = views.cameras.camera_to_worlds.numpy()
    focus, up = find_box(views, *depths).center, find_up(views.cameras)
    front = np.linalg.svd(up[None])[2][1]  # any direction in the horizontal plane: azimuth 0
    side = np.cross(up, front)
    offset = poses[:, :, 3] - focus
    x, y, z = offset @ front, offset @ side, offset @ up
    low, high = np.quantile(np.arctan2(z, np.hypot(x, y)), (0.25, 0.75))
    azimuths = np.sort(np.arctan2(y, x))
    phase = np.arange(count) / count * 2 * math.pi
    gaps = np.diff(azimuths, append=azimuths[0] + 2 * math.pi)
    if gaps.max() <= ALL_AROUND:
        azimuth, wave = phase, np.sin(2 * phase)
    else:
        azimuths = np.unwrap(np.roll(azimuths, -1 - gaps.argmax()))  # from the widest gap's end to its start
        first, last = np.quantile(azimuths, (0.25, 0.75))
        azimuth, wave = (first + last) / 2 + (last - first) / 2 * np.cos(phase), np.sin(phase)
    elevation = (low + high) / 2 + (high - low) / 2 * wave
    flat = np.multiply.outer(np.cos(azimuth), front) + np.multiply.outer(np.sin(azimuth), side)
    back = np.cos(elevation)[:, None] * flat + np.multiply.outer(np.sin(elevation), up)
    right = np.cross(up, flat)
    position = focus + back * np.median(np.linalg.norm(offset, axis=1))
    return _with_poses(views.cameras, np.stack((right, np.cross(back, right), back, position), axis=2))


def through(views: Views, depths: tuple[float, float], count: int) -> Cameras:
    """Cameras that pass smoothly through the poses of the training views, in their order and from the first to the
    last, with the first one's intrinsics and size. They turn by cubic interpolation of quaternions, while the focus
    moves likewise in their view: so they go around what they look at, not through it. depths: near and far."""
    poses = views.cameras.camera_to_worlds.numpy()
    focus, rotation = find_box(views, *depths).center, poses[:, :, :3]
    focus_in_camera = (rotation.transpose(0, 2, 1) @ (focus - poses[:, :, 3])[:, :, None])[:, :, 0]
    knots = np.concatenate((_quaternions(rotation), focus_in_camera), axis=1)
    values = catmull_rom(knots, np.linspace(0, len(knots) - 1, count))
    rotation = _rotations(values[:, :4])
    position = focus - (rotation @ values[:, 4:, None])[:, :, 0]
    return _with_poses(views.cameras, np.concatenate((rotation, position[:, :, None]), axis=2))


def _with_poses(like: Cameras, poses: np.ndarray) -> Cameras:
    """Cameras (n, 3, 4) with the first one's intrinsics and size."""
    first = like[[0] * len(poses)]
    return replace(first, camera_to_worlds=first.camera_to_worlds.new_tensor(poses))


def catmull_rom(knots: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Cubic curve through knots (n, d), numbered from 0, at parameters (m,) in [0, n - 1]: (m, d). Its slope at a knot
    is that between the knots before and after it (Catmull and Rom 1974)."""
    start = at.astype(int).clip(0, max(len(knots) - 2, 0))
    before, a, b, after = (knots[(start + step).clip(0, len(knots) - 1)] for step in (-1, 0, 1, 2))
    t = (at - start)[:, None]
    linear, square, cube = b - before, 2 * before - 5 * a + 4 * b - after, 3 * (a - b) + after - before
    return a + t / 2 * (linear + t * (square + t * cube))


def _quaternions(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions w, x, y, z (n, 4) of rotations (n, 3, 3), each with the sign that is nearer to the one before:
    eigenvectors of a symmetric matrix (Bar-Itzhack 2000)."""
    r = rotations
    twist = np.stack((r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]), axis=1)
    trace = np.trace(r, axis1=1, axis2=2)[:, None, None]
    matrix = np.concatenate((twist[:, None], r + r.transpose(0, 2, 1) - trace * np.eye(3)), axis=1)
    matrix = np.concatenate((np.concatenate((trace, twist[:, :, None]), axis=1), matrix), axis=2)
    found = np.linalg.eigh(matrix)[1][:, :, 3]  # of the largest eigenvalue
    turned = np.where((found[1:] * found[:-1]).sum(axis=1) < 0, -1, 1)
    return found * np.cumprod(np.concatenate(([1], turned)))[:, None]


def _rotations(quaternions: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) of quaternions (n, 4) w, x, y, z of any length."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.moveaxis(np.array(rows), 2, 0)
