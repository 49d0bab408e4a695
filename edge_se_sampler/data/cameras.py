"""Cameras: pixels to rays and points to pixels, with nerfstudio's names.

Camera axes are OpenGL's: x right, y up, z back. Pixel (row, column) has its center at (column + 0.5, row + 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

FAR = 5
"""In distances within which nine of ten cameras are."""


@dataclass(frozen=True)
class RayBundle:
    origins: Tensor  # (n, 3) world units
    directions: Tensor  # (n, 3) unit vectors
    camera_indices: Tensor  # (n, 1) int64
    metadata: dict[str, Tensor]
    """"directions_norm" (n, 1): length of the direction whose depth along the axis is 1; "pixel_axes" (n, 2, 3): what
    that changes by from a pixel to the one below, and to the one on the right. There may be "nears" and "fars" (n,
    1): distances from the origin, world units, between which models that `meets_all_cells` sample the ray instead of
    between their depths. Of a model that knows them, "empty_depths" (n, 1): `RayModel.find_empty_depths`."""

    def __len__(self) -> int:
        return len(self.origins)

    def __getitem__(self, rows: slice | Tensor) -> RayBundle:
        metadata = {key: value[rows] for key, value in self.metadata.items()}
        return RayBundle(self.origins[rows], self.directions[rows], self.camera_indices[rows], metadata)

    def split_pixels(self) -> tuple[Tensor, Tensor]:
        """Unit vectors (n, 4, 3) through the centers of each pixel's quarters, and their directions_norm (n, 4, 1)."""
        center = self.directions * self.metadata["directions_norm"]
        down, right = (self.metadata["pixel_axes"] / 4).unbind(dim=1)
        falling, rising = down + right, down - right  # diagonals
        quarters = torch.stack((center - falling, center - rising, center + rising, center + falling), dim=1)
        norm = quarters.norm(dim=2, keepdim=True)
        return quarters / norm, norm


@dataclass(frozen=True)
class Cameras:
    """n pinhole cameras, all tensors but the sizes of one floating-point type."""

    camera_to_worlds: Tensor  # (n, 3, 4): rotation | position in world units
    fx: Tensor  # (n, 1) focal length, pixels
    fy: Tensor  # (n, 1) pixels
    cx: Tensor  # (n, 1) principal point, pixels
    cy: Tensor  # (n, 1) pixels
    width: Tensor  # (n, 1) int64 pixels
    height: Tensor  # (n, 1) int64 pixels

    @classmethod
    def of(
        cls,
        camera_to_worlds: ArrayLike,
        *,
        fx: ArrayLike,
        fy: ArrayLike,
        cx: ArrayLike,
        cy: ArrayLike,
        width: ArrayLike,
        height: ArrayLike,
    ) -> Cameras:
        """Cameras in float64 from (n, 3|4, 4) matrices and intrinsics in pixels, (n,) or one number for all."""
        poses = np.asarray(camera_to_worlds, dtype=np.float64)[:, :3]

        def column(values: ArrayLike, dtype: type) -> Tensor:
            return torch.from_numpy(np.broadcast_to(values, len(poses)).astype(dtype)[:, None])

        return cls(
            torch.from_numpy(poses),
            *(column(values, np.float64) for values in (fx, fy, cx, cy)),
            *(column(values, np.int64) for values in (width, height)),
        )

    def __len__(self) -> int:
        return len(self.camera_to_worlds)

    def __getitem__(self, indices: slice | Sequence[int]) -> Cameras:
        return Cameras(**{key: value[indices] for key, value in vars(self).items()})

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Cameras:
        return Cameras(**{k: v.to(device, dtype if v.is_floating_point() else None) for k, v in vars(self).items()})

    def downscale(self, factor: int) -> Cameras:
        """The cameras of images in which every factor x factor pixels have become one; what is left over at the right
        and lower border is cut off."""
        intrinsics = {name: getattr(self, name) / factor for name in ("fx", "fy", "cx", "cy")}
        return replace(self, **intrinsics, width=self.width // factor, height=self.height // factor)

    def find_distances(self, point: np.ndarray) -> np.ndarray:
        """(n,) float64: how far each camera is from a point (3,), world units."""
        return np.linalg.norm(self.camera_to_worlds[:, :, 3].cpu().numpy() - point, axis=1)

    def generate_rays(self, camera_indices: Tensor, coords: Tensor) -> RayBundle:
        """A ray through each of coords (n, 2), float y, x in pixels, of the cameras (n, 1) int64, or of one (1, 1)."""
        c, n = camera_indices[:, 0], len(coords)
        right, up, back, origins = self.camera_to_worlds[c].unbind(dim=2)
        x, y = (coords[:, 1:] - self.cx[c]) / self.fx[c], (self.cy[c] - coords[:, :1]) / self.fy[c]
        directions = x * right + y * up - back
        norm = directions.norm(dim=1, keepdim=True)
        pixel_axes = torch.stack((-up / self.fy[c], right / self.fx[c]), dim=1).expand(n, 2, 3)
        metadata = {"directions_norm": norm, "pixel_axes": pixel_axes}
        return RayBundle(origins.expand(n, 3), directions / norm, camera_indices.expand(n, 1), metadata)

    def pixel_rays(self, pixels: Tensor) -> RayBundle:
        """Rays through the centers of pixels: (n, 3) int64 camera, row, column -> n rays."""
        pixels = pixels.to(self.fx.device)
        return self.generate_rays(pixels[:, :1], pixels[:, 1:] + 0.5)

    def image_rays(self, camera: int, pixels: slice | Tensor = slice(None)) -> RayBundle:
        """Rays of one camera, row by row: of all its pixels, or of some, (n,) int64 if not a slice, numbered in that
        order."""
        height, width = int(self.height[camera]), int(self.width[camera])
        if isinstance(pixels, slice):
            pixels = torch.arange(*pixels.indices(height * width))
        pixel = pixels.to(self.fx.device)
        coords = torch.stack((pixel // width, pixel % width), dim=1) + 0.5
        return self.generate_rays(torch.tensor([[camera]], device=pixel.device), coords)

    def project(self, camera: int, points: Tensor) -> tuple[Tensor, Tensor]:
        """Where one camera sees points (m, 3) in world units: the inverse of `generate_rays`. Returns coords (m, 2),
        y, x in pixels, which mean nothing behind the camera, and the depth (m,) along the optical axis in world units,
        positive in front of the camera."""
        pose = self.camera_to_worlds[camera]
        right, up, back = pose[:, :3].T @ (points - pose[:, 3]).T
        depth = -back
        y = self.cy[camera] - up / depth * self.fy[camera]
        x = self.cx[camera] + right / depth * self.fx[camera]
        return torch.stack((y, x), dim=1), depth

    def interpolate(self, first: int, second: int, fraction: float) -> Cameras:
        """One camera at a fraction, in [0, 1], of the way between two, with the first one's intrinsics and size. It
        rotates at an even rate, and the world's origin moves evenly in its view."""
        a, b = (self.camera_to_worlds[i].cpu().double() for i in (first, second))
        rotation = a[:, :3] @ rotation_power(a[:, :3].T @ b[:, :3], fraction)
        origin_in_camera = torch.lerp(a[:, :3].T @ a[:, 3], b[:, :3].T @ b[:, 3], fraction)
        pose = torch.cat((rotation, (rotation @ origin_in_camera)[:, None]), dim=1).to(self.camera_to_worlds)
        return replace(self[[first]], camera_to_worlds=pose[None])


def rotation_power(rotation: Tensor, exponent: float) -> Tensor:
    """The rotation (3, 3) float64 by `exponent` times a rotation's angle (pi: in either sense) about its axis."""
    axis = torch.linalg.eigh((rotation + rotation.T) / 2).eigenvectors[:, 2]  # of the eigenvalue 1, the largest
    x, y, z = axis.tolist()
    skew = rotation.new_tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sine = (skew * rotation).sum() / 2  # the trace is 1 + 2 cos, the skew part the axis times sin
    angle = exponent * torch.atan2(sine, (rotation.trace() - 1) / 2)
    return torch.eye(3).to(rotation) + angle.sin() * skew + (1 - angle.cos()) * skew @ skew


def find_far(positions: np.ndarray) -> tuple[np.ndarray, float]:
    """Which of positions (n, 3) are far from all others, (n,) bool, as those of wrong poses are, COLMAP's for one; and
    how far from the middle of all nine of ten are. Of fewer than five, none is."""
    distances = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    most = float(np.sort(distances)[int(0.9 * (len(positions) - 1))])
    return (distances > FAR * most) & (most > 0) & (len(positions) >= 5), most
