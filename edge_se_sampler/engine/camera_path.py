"""Cameras that nobody photographed: the spiral on which a trained scene is shown."""

from __future__ import annotations

import math

import torch

from edge_se_sampler.data.cameras import Cameras


def spiral(like: Cameras, count: int) -> Cameras:
    """A turn around the origin at the cameras' median distance, rising and falling between 15 and 45 degrees.

    Args:
        like: cameras whose first one lends its lens and size.
        count: number of views.
    """
    radius = float(like.camera_to_worlds[:, :, 3].norm(dim=1).median())
    turn = torch.arange(count) / count * 2 * math.pi
    elevation = math.radians(30) + math.radians(15) * torch.sin(2 * turn)
    back = torch.stack(
        (elevation.cos() * turn.cos(), elevation.cos() * turn.sin(), elevation.sin()), dim=1
    )  # unit vectors from the origin to the eye
    right = torch.stack((-turn.sin(), turn.cos(), torch.zeros(count)), dim=1)
    up = torch.linalg.cross(back, right)
    poses = torch.stack((right, up, back, back * radius), dim=2)
    lens = {key: value[:1].expand(count, 1) for key, value in vars(like).items() if key != "camera_to_worlds"}
    return Cameras(camera_to_worlds=poses, **lens)
