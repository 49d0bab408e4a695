"""Pixels -> rays, with nerfstudio's names.

Camera axes are OpenGL's: x right, y up, z back. Pixel (row, column) has its centre at (column + 0.5, row + 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class RayBundle:
    """n rays."""

    origins: Tensor
    """(n, 3) world units."""
    directions: Tensor
    """(n, 3) unit vectors."""
    camera_indices: Tensor
    """(n, 1) int64."""
    metadata: dict[str, Tensor]
    """"directions_norm" (n, 1): length of the direction whose depth along the optical axis is 1."""

    def __len__(self) -> int:
        return len(self.origins)

    def __getitem__(self, rows: slice) -> RayBundle:
        metadata = {key: value[rows] for key, value in self.metadata.items()}
        return RayBundle(self.origins[rows], self.directions[rows], self.camera_indices[rows], metadata)


@dataclass(frozen=True)
class Cameras:
    """n pinhole cameras."""

    camera_to_worlds: Tensor
    """(n, 3, 4) float32: rotation | position."""
    fx: Tensor
    """(n, 1) pixels."""
    fy: Tensor
    """(n, 1) pixels."""
    cx: Tensor
    """(n, 1) pixels."""
    cy: Tensor
    """(n, 1) pixels."""
    width: Tensor
    """(n, 1) int64 pixels."""
    height: Tensor
    """(n, 1) int64 pixels."""

    def __len__(self) -> int:
        return len(self.camera_to_worlds)

    def to(self, device: torch.device | str) -> Cameras:
        """The same cameras on a device."""
        return Cameras(**{key: value.to(device) for key, value in vars(self).items()})

    def between(self, first: int, second: int, share: float) -> Cameras:
        """One camera on the way from one to another, with the first one's lens and size.

        It turns at an even rate, and the world's origin moves evenly in its view: between cameras that look at one
        point it looks there too.

        Args:
            share: of the way, in [0, 1].
        """
        a, b = self.camera_to_worlds[first].double(), self.camera_to_worlds[second].double()
        rotation = a[:, :3] @ rotation_power(a[:, :3].T @ b[:, :3], share)
        seen = torch.lerp(a[:, :3].T @ a[:, 3], b[:, :3].T @ b[:, 3], share)
        pose = torch.cat((rotation, (rotation @ seen)[:, None]), dim=1).to(self.camera_to_worlds)
        lens = {key: value[first : first + 1] for key, value in vars(self).items() if key != "camera_to_worlds"}
        return Cameras(camera_to_worlds=pose[None], **lens)

    def generate_rays(self, camera_indices: Tensor, coords: Tensor) -> RayBundle:
        """One ray for each coordinate.

        Args:
            camera_indices: (n, 1) int64.
            coords: (n, 2) float: y, x in pixels (a pixel's centre is its row + 0.5, column + 0.5).
        """
        c = camera_indices[:, 0]
        x = (coords[:, 1:] - self.cx[c]) / self.fx[c]
        y = -(coords[:, :1] - self.cy[c]) / self.fy[c]
        in_camera = torch.cat((x, y, -torch.ones_like(x)), dim=1)
        pose = self.camera_to_worlds[c]
        directions = (pose[:, :, :3] @ in_camera[:, :, None])[:, :, 0]
        norm = directions.norm(dim=1, keepdim=True)
        return RayBundle(pose[:, :, 3], directions / norm, camera_indices, {"directions_norm": norm})


def rotation_power(rotation: Tensor, share: float) -> Tensor:
    """A share of a rotation's angle about its axis, (3, 3) -> (3, 3) float64; of half a turn, in either sense."""
    rotation = rotation.double()
    axis = torch.linalg.eigh((rotation + rotation.T) / 2).eigenvectors[:, 2]  # of the eigenvalue 1, the largest
    x, y, z = axis.tolist()
    skew = rotation.new_tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sine = (skew * rotation).sum() / 2  # the trace is 1 + 2 cos, the skew part the axis times sin
    angle = share * torch.atan2(sine, (rotation.trace() - 1) / 2)
    return torch.eye(3).to(rotation) + angle.sin() * skew + (1 - angle.cos()) * skew @ skew


class RayGenerator:
    """Sampled pixels -> their rays."""

    def __init__(self, cameras: Cameras) -> None:
        self.cameras = cameras

    def __call__(self, ray_indices: Tensor) -> RayBundle:
        """(n, 3) int64 camera, row, column -> n rays."""
        ray_indices = ray_indices.to(self.cameras.fx.device)
        return self.cameras.generate_rays(ray_indices[:, :1], ray_indices[:, 1:] + 0.5)

    def image(self, camera: int) -> RayBundle:
        """All rays of one camera, row-major."""
        size = int(self.cameras.height[camera]), int(self.cameras.width[camera])
        row, column = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
        rows = torch.stack((torch.full_like(row, camera), row, column), dim=-1)
        return self(rows.reshape(-1, 3))
