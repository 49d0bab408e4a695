"""Lens distortion, undone by OpenCV: what a pinhole camera of the same focal lengths would have seen.

x, y   of an undistorted point in the camera: right / depth, down / depth
r      their length; theta = atan(r)
Brown-Conrady: x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), y likewise
fisheye:       x theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) / r, y likewise
(OpenCV's calib3d documentation.) Both polynomials may turn back far out, where a pixel would be shown twice.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

NUM_RADII = 2000
"""At which a polynomial is looked at for where it turns back."""


@dataclass(frozen=True)
class Lens:
    """A lens that distorts, in OpenCV's terms."""

    fisheye: bool
    coefficients: tuple[float, ...]
    """Of a fisheye k1 k2 k3 k4; else k1 k2 p1 p2 k3."""


@dataclass(frozen=True)
class Intrinsics:
    """A camera's projection onto an image whose first pixel has its center at (0.5, 0.5)."""

    fx: float
    """Focal lengths and principal point, pixels."""
    fy: float
    cx: float
    cy: float
    lens: Lens | None = None
    """None: a pinhole."""

    def scaled(self, x: float, y: float) -> Intrinsics:
        """Those of the image resized by these factors."""
        return Intrinsics(x * self.fx, y * self.fy, x * self.cx, y * self.cy, self.lens)


def find_sources(camera: Intrinsics, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the image of a camera with a lens shows what a pinhole would show at each pixel of an image of that size.

    Returns:
        x, y (2, H, W) float32 in OpenCV's pixels, whose centers are whole numbers; (H, W) bool: whether that is in the
        image and shown nowhere else.
    """
    assert camera.lens is not None
    coefficients, size = np.array(camera.lens.coefficients), (width, height)
    matrix = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
    find = cv2.fisheye.initUndistortRectifyMap if camera.lens.fisheye else cv2.initUndistortRectifyMap
    with np.errstate(all="ignore"):  # absurd coefficients overflow: no pixel is left then
        x, y = find(matrix, coefficients, np.eye(3), matrix, size, cv2.CV_32FC1)
        inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
        u, v = (np.arange(width) - matrix[0, 2]) / camera.fx, (np.arange(height) - matrix[1, 2]) / camera.fy
        r = np.hypot(u, v[:, None])
        inside &= r <= _largest_radius(camera.lens, float(r.max()))
    return np.stack((x, y)), inside


def _largest_radius(lens: Lens, largest: float) -> float:
    """The r, at most `largest`, up to which a point that is farther out is shown farther out."""
    r = np.linspace(0, largest, NUM_RADII)
    if lens.fisheye:
        angle, k = np.arctan(r), lens.coefficients
    else:
        angle, k = r, (*lens.coefficients[:2], lens.coefficients[4])
    shown = angle * (1 + sum(k[i] * angle ** (2 * i + 2) for i in range(len(k))))
    turns = np.flatnonzero(~(np.diff(shown) > 0))
    return float(r[turns[0]]) if len(turns) else largest


def undistort(values: np.ndarray, sources: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """(H, W) or (H, W, 3|4) uint8, the last one's alpha straight, as a pinhole would have seen it, between pixels by
    bilinear interpolation; 0 where nothing is shown. Colors are interpolated premultiplied by alpha."""
    x, y = np.where(inside, sources, 0).astype(np.float32)
    if values.ndim == 3 and values.shape[2] == 4:
        alpha = values[..., 3:].astype(np.float32)
        layers = np.concatenate((values[..., :3] * alpha, alpha), axis=2)
        layers = cv2.remap(layers, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        alpha = layers[..., 3:]
        np.divide(layers[..., :3], alpha, out=layers[..., :3], where=alpha > 0)
        result = np.rint(layers).astype(np.uint8)
    else:
        result = cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    result[~inside] = 0
    return result
