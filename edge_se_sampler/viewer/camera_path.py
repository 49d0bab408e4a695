"""Cameras of viser and of nerfstudio's camera path files, and ours."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import viser.transforms as tf

from edge_se_sampler.data.cameras import Cameras, rotation_power

FLIP = np.diag([1.0, -1.0, -1.0])
"""Between OpenCV's camera axes, which viser has (x right, y down, z forward), and OpenGL's."""


@dataclass(frozen=True)
class View:
    """Where a browser looks from."""

    pose: np.ndarray
    """(3, 4): OpenGL's camera axes | position in world units."""
    fov: float
    """Angle from the upper to the lower border, radians."""
    aspect: float
    """Width over height."""

    @classmethod
    def of(cls, camera: Any) -> View:
        """What viser's camera sees."""
        rotation = tf.SO3(camera.wxyz).as_matrix() @ FLIP
        return cls(np.column_stack((rotation, camera.position)), camera.fov, camera.aspect)

    @classmethod
    def of_training(cls, cameras: Cameras, k: int) -> View:
        """About what one of our cameras sees: the principal point is in the middle."""
        height, width = int(cameras.height[k]), int(cameras.width[k])
        fov = 2 * math.atan(height / 2 / float(cameras.fy[k]))
        return cls(cameras.camera_to_worlds[k].double().cpu().numpy(), fov, width / height)

    @property
    def wxyz(self) -> np.ndarray:
        """viser's rotation, a quaternion."""
        return tf.SO3.from_matrix(self.pose[:, :3] @ FLIP).wxyz

    def camera(self, height: int) -> Cameras:
        """One camera of so many rows."""
        width = max(1, round(height * self.aspect))
        focal = height / 2 / math.tan(self.fov / 2)
        size = {"width": width, "height": height}
        return Cameras.of(self.pose[None], fx=focal, fy=focal, cx=width / 2, cy=height / 2, **size)


def camera_path(keyframes: list[View], seconds: float, fps: int, height: int) -> dict[str, Any]:
    """The content of a camera_path.json of nerfstudio's viewer (1.1.5) that leads through keyframes, in the data's
    world units: positions on a Catmull-Rom spline, rotations at an even rate between two, the first one's aspect."""
    rotations = torch.from_numpy(np.stack([view.pose[:, :3] for view in keyframes]))
    values = np.stack([np.append(view.pose[:, 3], view.fov) for view in keyframes])
    values = np.concatenate((values[:1], values, values[-1:]))
    aspect, frames = keyframes[0].aspect, []
    for t in np.linspace(0, len(keyframes) - 1, max(1, round(seconds * fps))):
        k = min(int(t), max(len(keyframes) - 2, 0))
        u, following = t - k, min(k + 1, len(keyframes) - 1)
        turned = rotation_power(rotations[k].T @ rotations[following], u)
        a, b, c, d = (values[min(k + i, len(values) - 1)] for i in range(4))
        at = b + u * (c - a + u * (2 * a - 5 * b + 4 * c - d + u * (3 * b - 3 * c + d - a))) / 2
        frames.append({"camera_to_world": _matrix((rotations[k] @ turned).numpy(), at[:3]), **_lens(at[3], aspect)})
    ends = [
        {"matrix": _matrix(view.pose[:, :3], view.pose[:, 3]), **_lens(view.fov, view.aspect)} for view in keyframes
    ]
    return {
        "default_fov": math.degrees(keyframes[0].fov),
        "default_transition_sec": seconds / max(1, len(keyframes) - 1),
        "keyframes": ends,
        "camera_type": "perspective",
        "render_height": height,
        "render_width": max(1, round(height * aspect)),
        "fps": fps,
        "seconds": seconds,
        "is_cycle": False,
        "smoothness_value": 0.0,
        "camera_path": frames,
    }


def _lens(fov: float, aspect: float) -> dict[str, float]:
    return {"fov": math.degrees(fov), "aspect": aspect}


def _matrix(rotation: np.ndarray, position: np.ndarray) -> list[float]:
    """(4, 4), row by row."""
    return np.vstack((np.column_stack((rotation, position)), (0.0, 0.0, 0.0, 1.0))).ravel().tolist()
