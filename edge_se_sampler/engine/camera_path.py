"""Cameras that nobody photographed: the spiral on which a trained scene is shown."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from edge_se_sampler.data.cameras import Cameras


def spiral(like: Cameras, count: int) -> Cameras:
    """Cameras once around the origin at the median distance of `like`, rising and falling between 15 and 45 degrees.

    Args:
        like: cameras whose first one lends its intrinsics and size.
        count: number of views.
    """
    radius = float(like.camera_to_worlds[:, :, 3].norm(dim=1).median())
    azimuth = torch.arange(count).to(like.fx) / count * 2 * math.pi
    elevation = math.radians(30) + math.radians(15) * torch.sin(2 * azimuth)
    back = torch.stack(
        (elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()), dim=1
    )  # unit vectors from the origin to the eye
    right = torch.stack((-azimuth.sin(), azimuth.cos(), torch.zeros_like(azimuth)), dim=1)
    up = torch.linalg.cross(back, right)
    poses = torch.stack((right, up, back, back * radius), dim=2)
    return replace(like[[0] * count], camera_to_worlds=poses)
