"""The visual hull (Laurentini 1994): the cells of a box that may hold something, by the silhouettes in the alpha masks.

h      size of a cell: its edge, world units
X      center of a cell, world units
x, y, z  X in a view's camera: right, down, forward
a_x, ...  half extents of the cell along those axes: h/2 times the sum of |rotation| over the world's axes
u, v   pixels right and down; f, c: focal length and principal point, pixels

A point of the cell lies at (x + e_x, z + e_z) with |e_x| <= a_x, |e_z| <= a_z, so its pixel is within
f (a_x z + |x| a_z) / (z (z - a_z)) = (f a_x + |u - c| a_z) / (z - a_z) of the center's. A cell is carved away only if
that whole rectangle and a margin are background in several views, or in all that see it: a mask that is a little too
small, or shifted, or empty in one view, carves nothing away that others see. What lies outside an image counts as
background if the silhouette keeps clear of the border, for then the image shows the whole object. Carving begins with
large cells and subdivides those it keeps.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.views import Views

MARGIN = 2
"""Pixels by which a silhouette may be too small, or moved."""
MIN_EMPTY_VIEWS = 2
"""Views that must show a cell to be empty, if another may see something in it."""
INITIAL_RESOLUTION = 16
"""Cells along the box when carving begins."""
MIN_CANDIDATES = 0.8
"""Share of the cells still undecided below which the others are dropped; not at once, for copying takes time, too."""
MIN_ANGLE = 1e-3
"""Radians that optical axes deviate from parallel ones, root mean square, if they are to meet somewhere."""
IN_FRONT, STRADDLING, BEHIND = 1, 0, -1
"""Where a cell is, relative to a camera's plane."""


@dataclass(frozen=True)
class Hull:
    """Cubic cells in a box around the scene."""

    aabb_min: np.ndarray
    """(3,) float64, world units: the box's least coordinates."""
    cell_size: float
    """h."""
    cells: np.ndarray
    """(X, Y, Z) bool: cells that may hold something."""


@dataclass(frozen=True)
class Silhouette:
    """The foreground of one view."""

    integral_image: np.ndarray
    """(H + 1, W + 1) int32: number of foreground pixels above and left of a pixel corner."""
    uncropped: bool
    """Whether it keeps clear of the image's border, which therefore shows all of the object."""

    def overlaps(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """(m,) bool: whether rectangles, least and greatest u, v (2, m), widened by MARGIN have any foreground."""
        height, width = self.integral_image.shape
        low, high = np.floor(low) - MARGIN, np.ceil(high) + MARGIN
        left, right = (u.clip(0, width - 1).astype(np.int64) for u in (low[0], high[0]))
        top, bottom = (v.clip(0, height - 1).astype(np.int64) * width for v in (low[1], high[1]))
        count = self.integral_image.reshape(-1)
        return count[bottom + right] - count[top + right] > count[bottom + left] - count[top + left]


@dataclass(frozen=True)
class Box:
    """A cube around what the cameras look at."""

    center: np.ndarray
    """(3,) float64, world units."""
    half_extent: float
    """Half its edge, world units."""
    pixel_footprint: float
    """Median size of a pixel at the center, world units: depth / focal length."""


def find_box(views: Views, near: float, far: float) -> Box:
    """The cube around the point nearest to all optical axes that reaches as far along every axis as rays are sampled,
    from depth near to far, world units. Where that point is not between these (axes that are parallel, or diverge), it
    is around the mean point halfway between them."""
    cameras = views.leave_out_far().cameras
    center, depth = find_focus(cameras)
    if not near < np.median(depth) < far:
        poses = cameras.camera_to_worlds.numpy()
        position, forward = poses[:, :, 3], -poses[:, :, 2]
        center = (position + forward * (near + far) / 2).mean(axis=0)
        depth = ((center - position) * forward).sum(axis=1)
    half_extent = float(np.maximum(far - depth, depth - near).clip(min=0).max())
    focal = (cameras.fx + cameras.fy)[:, 0].numpy() / 2
    return Box(center, half_extent, float(np.median(depth.clip(min=1e-6 * half_extent) / focal)))


def find_focus(cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """The point (3,) nearest to all optical axes, world units, and its depth (n,) in each camera; depths of 0 where the
    axes are parallel, or there is only one, so that many points are as near."""
    poses = cameras.camera_to_worlds.numpy()
    position, forward = poses[:, :, 3], -poses[:, :, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    center = np.linalg.lstsq(across.sum(axis=0), (across @ position[:, :, None]).sum(axis=0)[:, 0], rcond=None)[0]
    if np.linalg.eigvalsh(across.sum(axis=0))[0] < MIN_ANGLE**2 * len(forward):
        return center, np.zeros(len(forward))
    return center, ((center - position) * forward).sum(axis=1)


def find_silhouettes(views: Views) -> dict[int, Silhouette]:
    """Silhouettes of the views that show both foreground and background, by the view's index; pixels that must not be
    trained on count as foreground."""
    found = {}
    for i, image in enumerate(views.images):
        foreground = image[..., 3] > 0 if image.shape[2] == 4 else np.ones(image.shape[:2], dtype=bool)
        if foreground.any() and not foreground.all():
            mask = foreground if views.masks is None else foreground | ~views.masks[i]
            height, width = image.shape[:2]
            uncropped = bool(mask[MARGIN : height - MARGIN, MARGIN : width - MARGIN].sum() == mask.sum())
            found[i] = Silhouette(cv2.integral(mask.astype(np.uint8)), uncropped)
    return found


def show_whole_object(silhouettes: dict[int, Silhouette]) -> bool:
    """Whether most silhouettes keep clear of their images' borders: others hardly tell how near the object comes."""
    return 2 * sum(silhouette.uncropped for silhouette in silhouettes.values()) > len(silhouettes)


def carve(
    views: Views, silhouettes: dict[int, Silhouette], box: Box, cell_size: float, max_cells: float = np.inf
) -> Hull | None:
    """The cells of a box that may hold something, None if there are none; without silhouettes (by the view's index),
    all that views see. They are of that size, or 2, 4, ... times as large where they would be more than max_cells."""
    levels = max(0, int(np.ceil(np.log2(2 * box.half_extent / (INITIAL_RESOLUTION * cell_size)))))
    size = cell_size * 2**levels
    aabb_min = box.center - size * INITIAL_RESOLUTION / 2
    kept = _select_cells(views, silhouettes, box, aabb_min, size, _grid_indices(INITIAL_RESOLUTION))
    for _ in range(levels):
        children = (2 * kept[:, None] + _grid_indices(2)).reshape(-1, 3)
        children = _select_cells(views, silhouettes, box, aabb_min, size / 2, children)
        if len(children) > max_cells:
            break
        kept, size = children, size / 2
    if not len(kept):
        return None
    low, high = kept.min(axis=0), kept.max(axis=0)
    cells = np.zeros(high - low + 1, dtype=bool)
    cells[tuple((kept - low).T)] = True
    return Hull(aabb_min + low * size, size, cells)


def _select_cells(
    views: Views, silhouettes: dict[int, Silhouette], box: Box, aabb_min: np.ndarray, size: float, indices: np.ndarray
) -> np.ndarray:
    """Those of the cells (m, 3), by their index from a corner, that are in the box and may hold something."""
    centers = aabb_min + (indices + 0.5) * size
    in_box = (np.abs(centers - box.center) < box.half_extent + size / 2).all(axis=1)
    return indices[in_box][_may_hold_something(views, silhouettes, centers[in_box], size)]


def _grid_indices(size: int) -> np.ndarray:
    """All (i, j, k) below a size, (size^3, 3) int64."""
    return np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def _may_hold_something(
    views: Views, silhouettes: dict[int, Silhouette], centers: np.ndarray, cell_size: float
) -> np.ndarray:
    """(m,) bool: cells in which some view may see something, and that fewer than MIN_EMPTY_VIEWS show to be empty."""
    if not silhouettes:
        return _is_seen(views, centers, cell_size)
    candidates = np.arange(len(centers))  # all that are not known to be empty, and maybe some that are
    empty_views, supported = np.zeros(len(centers), dtype=np.int32), np.zeros(len(centers), dtype=bool)
    for i, image in enumerate(views.images):
        low, high, side = project_cells(views.cameras, i, centers[candidates], cell_size)
        height, width = image.shape[:2]
        empty = np.zeros(len(candidates), dtype=bool)
        if i in silhouettes:
            all_in_image = (low[0] >= 0) & (low[1] >= 0) & (high[0] <= width) & (high[1] <= height)
            known = (side == IN_FRONT) & (all_in_image | silhouettes[i].uncropped)
            empty = known & ~silhouettes[i].overlaps(low, high)
        empty_views += empty
        supported |= _in_view(low, high, side, width, height) & ~empty
        undecided = empty_views < MIN_EMPTY_VIEWS
        if np.count_nonzero(undecided) < MIN_CANDIDATES * len(undecided):
            candidates, supported, empty_views = candidates[undecided], supported[undecided], empty_views[undecided]
    result = np.zeros(len(centers), dtype=bool)
    result[candidates] = supported & (empty_views < MIN_EMPTY_VIEWS)
    return result


def _is_seen(views: Views, centers: np.ndarray, cell_size: float) -> np.ndarray:
    """(m,) bool: cells that some view sees a part of."""
    unseen = np.arange(len(centers))
    for i, image in enumerate(views.images):
        low, high, side = project_cells(views.cameras, i, centers[unseen], cell_size)
        unseen = unseen[~_in_view(low, high, side, *image.shape[1::-1])]
    seen = np.ones(len(centers), dtype=bool)
    seen[unseen] = False
    return seen


def project_cells(
    cameras: Cameras, camera: int, centers: np.ndarray, cell_size: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The rectangles into which one camera projects cells, by their centers (m, 3), world units.

    Returns:
        least and greatest u, v (2, m) each, 0 for cells that are not in front of the camera; whether each cell is all
        IN_FRONT, all BEHIND, or STRADDLING the camera's plane, (m,).
    """
    coords, z = (values.numpy() for values in cameras.project(camera, torch.from_numpy(centers)))
    rotation = cameras.camera_to_worlds[camera, :, :3].numpy()
    half_x, half_y, half_z = cell_size / 2 * np.abs(rotation).sum(axis=0)
    side = np.where(z > half_z, IN_FRONT, np.where(z < -half_z, BEHIND, STRADDLING))
    in_front = side == IN_FRONT
    closest = np.where(in_front, z - half_z, np.inf)
    low, high = np.empty((2, 2, len(z)))
    axes = ((coords[:, 1], cameras.fx, cameras.cx, half_x), (coords[:, 0], cameras.fy, cameras.cy, half_y))
    for k, (center, focal, principal, half) in enumerate(axes):
        center = np.where(in_front, center, 0)  # on the camera's plane it is infinite
        extent = (half * float(focal[camera]) + np.abs(center - float(principal[camera])) * half_z) / closest
        low[k], high[k] = center - extent, center + extent
    return low, high, side


def _in_image(low: np.ndarray, high: np.ndarray, width: int, height: int) -> np.ndarray:
    """(m,) bool: whether rectangles (2, m) have any part in the image."""
    return (high[0] > 0) & (high[1] > 0) & (low[0] < width) & (low[1] < height)


def _in_view(low: np.ndarray, high: np.ndarray, side: np.ndarray, width: int, height: int) -> np.ndarray:
    """(m,) bool: whether cells, by what `project_cells` returns, may have any part in the image."""
    return (side == STRADDLING) | (side == IN_FRONT) & _in_image(low, high, width, height)


def find_hit_pixels(views: Views, hull: Hull) -> list[np.ndarray]:
    """(H, W) bool of each view: all pixels whose rays hit the hull, and few others."""
    inner = np.pad(hull.cells, 1)
    for axis in range(3):
        inner = inner & np.roll(inner, 1, axis) & np.roll(inner, -1, axis)
    # a ray from outside first hits a cell that has one of the 26 around it empty
    outermost = np.argwhere(hull.cells & ~inner[1:-1, 1:-1, 1:-1])
    centers = hull.aabb_min + (outermost + 0.5) * hull.cell_size
    return [_covered_pixels(views, i, centers, hull.cell_size) for i in range(len(views.images))]


def _covered_pixels(views: Views, index: int, centers: np.ndarray, cell_size: float) -> np.ndarray:
    """(H, W) bool: pixels around the centers of the cells' rectangles, as far as the largest rectangle reaches; all of
    them, if a cell is around the camera or as large as the image."""
    height, width = views.images[index].shape[:2]
    low, high, side = project_cells(views.cameras, index, centers, cell_size)
    visible = (side == IN_FRONT) & _in_image(low, high, width, height)
    low, high = low[:, visible], high[:, visible]
    radius = int(np.ceil((high - low).max(initial=0) / 2)) + 1
    if (side == STRADDLING).any() or radius > max(height, width):
        return np.ones((height, width), dtype=bool)
    column, row = np.floor((low + high) / 2).astype(np.int64) + radius
    padded = np.zeros((height + 2 * radius, width + 2 * radius), dtype=np.uint8)
    padded[row, column] = 1
    count, size = cv2.integral(padded), 2 * radius + 1
    return count[size:, size:] - count[:-size, size:] - count[size:, :-size] + count[:-size, :-size] > 0
