"""The visual hull (Laurentini 1994): what of a box may hold something, from the silhouettes that alpha shows.

X      centre of a cell of side h, world units
x, y, z  X in a view's camera: right, down, ahead
a_x, ...  half of the cell along those axes: h/2 times the sum of |rotation| over the world's axes
u, v   pixels right and down; f, c: focal length and principal point, pixels

A point of the cell lies at (x + e_x, z + e_z) with |e_x| <= a_x, |e_z| <= a_z, so its pixel is within
f (a_x z + |x| a_z) / (z (z - a_z)) = (f a_x + |u - c| a_z) / (z - a_z) of the centre's. A cell goes only where that
whole rectangle and a margin are background in several views: a mask that is a little too small, or shifted, or empty
in one view, carves nothing away.
What lies outside of an image counts as background if its silhouette keeps clear of the border, for then the image
shows the whole object. Carving begins with large cells and splits those that stay.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.views import Views

MARGIN = 2
"""Pixels that a silhouette may be too small, or moved."""
MIN_EMPTY_VIEWS = 2
"""Views that must see a cell to be empty, where there are as many."""
FIRST_CELLS = 16
"""Cells along the box when carving begins."""
FEWER = 0.8
"""Share of cells still in question below which the others are dropped: copying costs, too."""
IN_FRONT, STRADDLING, BEHIND = 1, 0, -1
"""Where a cell is, seen from a camera's plane."""


@dataclass(frozen=True)
class Hull:
    """Cubic cells in a box around the scene."""

    corner: np.ndarray
    """(3,) float64, world units: where the box has its least coordinates."""
    side: float
    """h, world units."""
    cells: np.ndarray
    """(X, Y, Z) bool: may hold something."""


@dataclass(frozen=True)
class Silhouette:
    """What one view says of where the object is."""

    count: np.ndarray
    """(H + 1, W + 1) int32: foreground pixels above and left of a corner."""
    whole: bool
    """It keeps clear of the image's border, which therefore shows all of the object."""

    def shows(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """(m,) bool: rectangles of u, v (2, m) that have foreground in them, or MARGIN pixels around."""
        height, width = self.count.shape
        left, top = _within(np.floor(low[0]) - MARGIN, width), _within(np.floor(low[1]) - MARGIN, height) * width
        right, bottom = _within(np.ceil(high[0]) + MARGIN, width), _within(np.ceil(high[1]) + MARGIN, height) * width
        count = self.count.reshape(-1)
        return count[bottom + right] - count[top + right] > count[bottom + left] - count[top + left]


@dataclass(frozen=True)
class Box:
    """A cube around what all cameras look at."""

    middle: np.ndarray
    """(3,) float64."""
    half: float
    """Half its side, world units."""


def box_of(views: Views, near: float, far: float) -> Box:
    """The cube around the point nearest to all optical axes that reaches as far as sampling does, along every axis;
    where that point is not what is sampled (the axes run side by side, or apart), around the middle of what is.

    Args:
        near, far: depths between which rays are sampled, world units.
    """
    position, ahead = _optical_axes(views.cameras)
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    middle = np.linalg.lstsq(across.sum(axis=0), (across @ position[:, :, None]).sum(axis=0)[:, 0], rcond=None)[0]
    depth = ((middle - position) * ahead).sum(axis=1)
    if not near < np.median(depth) < far:
        middle = (position + ahead * (near + far) / 2).mean(axis=0)
        depth = ((middle - position) * ahead).sum(axis=1)
    return Box(middle, float(np.maximum(far - depth, depth - near).clip(min=0).max()))


def footprint(views: Views, box: Box) -> float:
    """Median size of a pixel at the box's middle, world units: depth / focal length."""
    position, ahead = _optical_axes(views.cameras)
    depth = ((box.middle - position) * ahead).sum(axis=1).clip(min=1e-6)
    focal = (views.cameras.fx + views.cameras.fy)[:, 0].numpy() / 2
    return float(np.median(depth / focal))


def _optical_axes(cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Of each camera, where it is and the unit vector along which it looks, (n, 3) each."""
    poses = cameras.camera_to_worlds.numpy()
    return poses[:, :, 3], -poses[:, :, 2]


def silhouettes(views: Views) -> dict[int, Silhouette]:
    """By number, of the views that show both foreground and background; what is masked may be either."""
    found = {}
    for i, image in enumerate(views.images):
        shown = image[..., 3] > 0 if image.shape[2] == 4 else np.ones(image.shape[:2], dtype=bool)
        if shown.any() and not shown.all():
            found[i] = _silhouette(shown if views.masks is None else shown | ~views.masks[i])
    return found


def _within(places: np.ndarray, size: int) -> np.ndarray:
    """Whole numbers, as near to those places as there are among `size`."""
    return places.clip(0, size - 1).astype(np.int64)


def _silhouette(mask: np.ndarray) -> Silhouette:
    inner = mask[MARGIN:-MARGIN, MARGIN:-MARGIN]
    return Silhouette(cv2.integral(mask.astype(np.uint8)), np.count_nonzero(inner) == np.count_nonzero(mask))


def carve(views: Views, shown: dict[int, Silhouette], box: Box, side: float) -> Hull | None:
    """The cells of a box that may hold something, None if there are none; without silhouettes, all that views see.

    Args:
        shown: silhouettes by the number of their view.
        side: of a cell, world units.
    """
    splits = max(0, int(np.ceil(np.log2(2 * box.half / (FIRST_CELLS * side)))))
    corner = box.middle - side * FIRST_CELLS * 2**splits / 2
    kept = _grid(FIRST_CELLS)
    for split in range(splits + 1):
        if split:
            kept = (2 * kept[:, None] + _grid(2)).reshape(-1, 3)
        size = side * 2 ** (splits - split)
        centers = corner + (kept + 0.5) * size
        in_box = (np.abs(centers - box.middle) < box.half + size / 2).all(axis=1)
        kept = kept[in_box][_stays(views, shown, centers[in_box], size)]
    if not len(kept):
        return None
    low, high = kept.min(axis=0), kept.max(axis=0)
    cells = np.zeros(high - low + 1, dtype=bool)
    cells[tuple((kept - low).T)] = True
    return Hull(corner + low * side, side, cells)


def _grid(size: int) -> np.ndarray:
    """All (i, j, k) below a size, (size^3, 3) int64."""
    return np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def _stays(views: Views, shown: dict[int, Silhouette], centers: np.ndarray, side: float) -> np.ndarray:
    """(m,) bool: cells that some view sees and that too few see to be empty."""
    witnesses = min(MIN_EMPTY_VIEWS, max(1, len(shown)))
    stays = np.zeros(len(centers), dtype=bool)
    left = np.arange(len(centers))  # those that are not known to be empty, and some that are
    empty = np.zeros(len(centers), dtype=np.int32)
    seen = np.zeros(len(centers), dtype=bool)
    for number, image in enumerate(views.images):
        low, high, where = projected(views.cameras, number, centers[left], side)
        height, width = image.shape[:2]
        ahead = where == IN_FRONT
        inside = (high[0] > 0) & (high[1] > 0) & (low[0] < width) & (low[1] < height)
        seen |= inside & ahead | (where == STRADDLING)
        if number in shown:
            silhouette = shown[number]
            whole = (low[0] >= 0) & (low[1] >= 0) & (high[0] <= width) & (high[1] <= height)
            told = ahead if silhouette.whole else ahead & whole
            empty += told & ~silhouette.shows(low, high)
            asked = empty < witnesses
            if np.count_nonzero(asked) < FEWER * len(asked):
                left, seen, empty = left[asked], seen[asked], empty[asked]
    stays[left] = seen & (empty < witnesses)
    return stays


def projected(
    cameras: Cameras, camera: int, centers: np.ndarray, side: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rectangles that cells project into: least and greatest u, v (2, m), and whether each cell is all IN_FRONT, all
    BEHIND, or STRADDLING the camera's plane (m,); only those in front have a rectangle that means something."""
    coords, z = (values.numpy() for values in cameras.project(camera, torch.from_numpy(centers)))
    rotation = cameras.camera_to_worlds[camera, :, :3].numpy()
    half_x, half_y, half_z = side / 2 * np.abs(rotation).sum(axis=0)
    where = np.where(z > half_z, IN_FRONT, np.where(z < -half_z, BEHIND, STRADDLING))
    closest = np.where(where == IN_FRONT, z - half_z, np.inf)
    low, high = np.empty((2, 2, len(z)))
    for k, (center, focal, principal, half) in enumerate(
        (
            (coords[:, 1], cameras.fx, cameras.cx, half_x),
            (coords[:, 0], cameras.fy, cameras.cy, half_y),
        )
    ):
        extent = (half * float(focal[camera]) + np.abs(center - float(principal[camera])) * half_z) / closest
        low[k], high[k] = center - extent, center + extent
    return low, high, where
