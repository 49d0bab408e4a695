"""Lens distortion, undone: what a pinhole camera of the same focal lengths would have seen.

x, y   of an undistorted point in the camera: right / depth, down / depth
r      their length; theta = atan(r)
Brown-Conrady: x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), y likewise
fisheye:       x theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) / r, y likewise
(OpenCV's calib3d documentation.) Both polynomials may turn back far out, where a pixel would be shown twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

NUM_RADII = 2000
"""At which a polynomial is looked at for where it turns back."""
ROWS_AT_ONCE = 64
"""Of an image, whose sources are found."""
MIN_ZOOM, MAX_ZOOM = 0.5, 2.0
"""Of a pinhole's focal lengths, in those of the lens whose image it shows."""


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


@lru_cache
def find_pinhole(camera: Intrinsics, width: int, height: int) -> Intrinsics:
    """The pinhole whose image of the same size shows as much of a lens's as can be without showing what lies outside:
    focal lengths between half and twice the lens's. Where that cannot be (a principal point outside, a polynomial that
    turns back at once), they stay. A pinhole is returned as it is."""
    if camera.lens is None:
        return camera
    across, down = np.linspace(0, width - 1, 65), np.linspace(0, height - 1, 65)
    edges = [(across, np.full(65, y)) for y in (0.0, height - 1.0)] + [
        (np.full(65, x), down) for x in (0.0, width - 1.0)
    ]
    x, y = np.concatenate(edges, axis=1)
    low, high = MIN_ZOOM, MAX_ZOOM
    if not _all_inside(camera, _zoom(camera, high), width, height, x, y):
        return _zoom(camera, 1.0)
    while high - low > 1e-4:
        middle = (low + high) / 2
        low, high = (low, middle) if _all_inside(camera, _zoom(camera, middle), width, height, x, y) else (middle, high)
    return _zoom(camera, high)


def _zoom(camera: Intrinsics, factor: float) -> Intrinsics:
    return Intrinsics(factor * camera.fx, factor * camera.fy, camera.cx, camera.cy)


def _all_inside(camera: Intrinsics, pinhole: Intrinsics, width: int, height: int, x: np.ndarray, y: np.ndarray) -> bool:
    """Whether the image of a lens shows what a pinhole shows at pixels x, y (m,)."""
    return bool(locate(camera, pinhole, width, height, x[None], y[None])[1].all())


@lru_cache(maxsize=1)  # most captures have one camera
def find_sources(camera: Intrinsics, pinhole: Intrinsics, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the image of a camera with a lens shows what a pinhole shows at each pixel; both images are of that size.

    Returns:
        x, y (2, H, W) float32 in OpenCV's pixels, whose centers are whole numbers; (H, W) bool: whether that is in the
        image and shown nowhere else; where it is not, x and y are 0.
    """
    sources, inside = np.zeros((2, height, width), dtype=np.float32), np.zeros((height, width), dtype=bool)
    for start in range(0, height, ROWS_AT_ONCE):  # in float64 all rows would take many times the image's memory
        rows = slice(start, min(start + ROWS_AT_ONCE, height))
        y = np.arange(rows.start, rows.stop)[:, None]
        found, inside[rows] = locate(camera, pinhole, width, height, np.arange(width)[None], y)
        sources[:, rows] = np.where(inside[rows], found, 0)
    return sources, inside


def locate(
    camera: Intrinsics, pinhole: Intrinsics, width: int, height: int, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`find_sources` at pixels x, y, whole numbers at their centers, which broadcast to (H, W)."""
    assert camera.lens is not None
    k = camera.lens.coefficients
    with np.errstate(all="ignore"):  # absurd coefficients overflow: no pixel is left then
        u, v = np.broadcast_arrays((x + 0.5 - pinhole.cx) / pinhole.fx, (y + 0.5 - pinhole.cy) / pinhole.fy)
        square = u * u + v * v
        if camera.lens.fisheye:
            r = np.sqrt(square)
            angle = np.arctan(r)
            factor = np.divide(angle, r, out=np.ones_like(r), where=r > 0) * _polynomial(k, angle * angle)
            shown_u, shown_v = factor * u, factor * v
        else:
            factor = _polynomial((k[0], k[1], k[4]), square)
            shown_u = factor * u + 2 * k[2] * u * v + k[3] * (square + 2 * u * u)
            shown_v = factor * v + k[2] * (square + 2 * v * v) + 2 * k[3] * u * v
        shown_x, shown_y = camera.fx * shown_u + camera.cx - 0.5, camera.fy * shown_v + camera.cy - 0.5
        inside = (shown_x >= -0.5) & (shown_x <= width - 0.5) & (shown_y >= -0.5) & (shown_y <= height - 0.5)
        inside &= square <= _largest_radius(camera.lens, float(np.sqrt(square.max(initial=0.0)))) ** 2
        return np.stack((shown_x, shown_y)), inside


def _polynomial(k: Sequence[float], square: np.ndarray) -> np.ndarray:
    """1 + k_1 s + k_2 s^2 + ..."""
    return 1 + square * sum((k[i] * square**i for i in range(1, len(k))), k[0])


def _largest_radius(lens: Lens, largest: float) -> float:
    """The r up to which a point that is farther out is shown farther out; infinity if that is beyond `largest`."""
    if lens.fisheye:
        angle, k = np.linspace(0, np.arctan(largest), NUM_RADII), lens.coefficients
        r = np.tan(angle)
    else:
        angle = r = np.linspace(0, largest, NUM_RADII)
        k = (*lens.coefficients[:2], lens.coefficients[4])
    shown = angle * _polynomial(k, angle * angle)
    turns = np.flatnonzero(~(np.diff(shown) > 0))
    return float(r[turns[0]]) if len(turns) else np.inf


def undistort(values: np.ndarray, sources: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """(H, W) or (H, W, 3|4) uint8, the last one's alpha straight, as a pinhole would have seen it, between pixels by
    bilinear interpolation; 0 where nothing is shown. Colors are interpolated premultiplied by alpha."""
    x, y = sources
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
