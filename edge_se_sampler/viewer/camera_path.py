"""Cameras of viser and of nerfstudio's camera path files, and ours."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import viser
import viser.transforms as tf

from edge_se_sampler.data.camera_path import MAX_SIDE
from edge_se_sampler.data.cameras import Cameras, rotation_power
from edge_se_sampler.engine.trajectories import catmull_rom

FLIP = np.diag([1.0, -1.0, -1.0])
"""Between OpenCV's camera axes, which viser has (x right, y down, z forward), and OpenGL's."""
FPS = 24


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
    def of(cls, camera: viser.CameraHandle) -> View:
        """What viser's camera sees."""
        rotation = tf.SO3(camera.wxyz).as_matrix() @ FLIP
        return cls(np.column_stack((rotation, camera.position)), camera.fov, camera.aspect)

    @classmethod
    def of_training(cls, cameras: Cameras, k: int) -> View:
        """About what one of our cameras sees: the principal point is in the middle."""
        height, width = int(cameras.height[k]), int(cameras.width[k])
        fov = 2 * math.atan(height / 2 / float(cameras.fy[k]))
        return cls(cameras.camera_to_worlds[k].cpu().double().numpy(), fov, width / height)

    @property
    def wxyz(self) -> np.ndarray:
        """viser's rotation, a quaternion."""
        return tf.SO3.from_matrix(self.pose[:, :3] @ FLIP).wxyz

    def camera(self, height: int) -> Cameras:
        """One camera of so many rows."""
        width, focal = max(1, round(height * self.aspect)), height / 2 / math.tan(self.fov / 2)
        middle = {"cx": width / 2, "cy": height / 2}
        return Cameras.of(self.pose[None], fx=focal, fy=focal, **middle, width=width, height=height)

    def draw(self, scene: Any, name: str, scale: float, color: tuple[int, int, int], image: Any = None) -> Any:
        """Add a frustum to viser's scene."""
        lens, pose = {"fov": self.fov, "aspect": self.aspect}, {"wxyz": self.wxyz, "position": self.pose[:, 3]}
        line = {"thickness": 1.5, "thickness_units": "screen", "color": color}
        return scene.add_camera_frustum(name, **lens, **pose, **line, scale=0.03 * scale, image=image)


def camera_path(keyframes: list[View], seconds: float, height: int) -> dict[str, Any]:
    """The content of a camera_path.json, as nerfstudio's viewer writes it (1.1.5), in the data's world units, through
    keyframes: positions on a Catmull-Rom spline, rotations at an even rate between two, the first one's aspect, and at
    most MAX_SIDE pixels wide and high."""
    rotations = torch.from_numpy(np.stack([view.pose[:, :3] for view in keyframes]))
    values = np.stack([np.append(view.pose[:, 3], view.fov) for view in keyframes])
    last, aspect, frames = len(keyframes) - 1, keyframes[0].aspect, []
    times = np.linspace(0, last, max(1, round(seconds * FPS)))
    for t, (x, y, z, fov) in zip(times, catmull_rom(values, times), strict=True):
        k = min(int(t), max(0, last - 1))
        turned = rotation_power(rotations[k].T @ rotations[min(k + 1, last)], t - k)
        matrix = np.eye(4)
        matrix[:3] = np.column_stack(((rotations[k] @ turned).numpy(), (x, y, z)))
        frame = {"camera_to_world": matrix.ravel().tolist(), "fov": math.degrees(fov), "aspect": aspect}
        frames.append(frame)
    height = max(1, min(height, MAX_SIDE, int(MAX_SIDE / aspect)))
    size = {"render_height": height, "render_width": min(MAX_SIDE, max(1, round(height * aspect)))}
    return {"camera_type": "perspective", **size, "fps": FPS, "seconds": seconds, "camera_path": frames}
