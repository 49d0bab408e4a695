"""What a scene needs, derived from its cameras and its alpha: where to look, and how closely."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from edge_se_sampler.data.views import Views
from edge_se_sampler.errors import InputError
from edge_se_sampler.occupancy.grid import MAX_OCCUPIED_CELLS, OccupancyGrid
from edge_se_sampler.occupancy.hull import (
    IN_FRONT,
    STRADDLING,
    Box,
    Hull,
    Silhouette,
    box_of,
    carve,
    footprint,
    projected,
    silhouettes,
)

MAX_GRID_CELLS = 2**24
"""Cells of the box around them, which grids have a number for, occupied or not."""
TOLERATED = 0.01
"""Share of the foreground's pixels that may meet no cell, by stray ones."""
COARSENING = 1
"""How often a carved hull's cells are doubled where training subdivides them."""
LOOKED_AT = 4096
ROUGH = 64
"""Cells along the box of a first hull, which tells how many finer ones there will be."""


@dataclass(frozen=True)
class SceneAnalysis:
    """Of a scene."""

    box: Box
    footprint: float
    """Of a pixel at the box's middle, world units."""
    silhouettes: int
    """Views whose alpha tells the object from the background."""
    hull: Hull
    """The cells that may hold something."""
    coarsening: int
    """How often these cells are doubled for training to begin with."""
    max_level: int
    """How often training may subdivide them."""

    def grid(self) -> OccupancyGrid:
        """The cells with which training begins."""
        return OccupancyGrid.from_hull(self.hull, self.max_level, self.coarsening)


def analyze_scene(
    views: Views, *, near: float, far: float, voxel_size_px: float, by_alpha: bool, prunable: bool
) -> SceneAnalysis:
    """Derive the cells of a scene from its training views.

    Args:
        near, far: depths between which rays are sampled, world units.
        voxel_size_px: size of a cell, in footprints of a pixel.
        by_alpha: whether the visual hull is carved from alpha.
        prunable: whether training prunes cells. It then begins with larger ones, to subdivide those that stay: twice as
            large as a carved hull's; in an uncarved box, as large as lets all be subdivided once.

    Raises:
        InputError: the cameras see nothing of what they look at.
    """
    at_first = MAX_OCCUPIED_CELLS // 8 if prunable else MAX_OCCUPIED_CELLS
    box = box_of(views, near, far)
    pixel = footprint(views, box)
    side = voxel_size_px * pixel
    shown = silhouettes(views) if by_alpha else {}
    hull = _hull(views, shown, box, side, MAX_OCCUPIED_CELLS if shown else at_first)
    if shown and (hull is None or _missed(views, shown, hull) > TOLERATED):
        print(
            "the views' alpha masks do not agree on where the object is, or show too little of it: they carve nothing "
            "away",
            file=sys.stderr,
        )
        shown, hull = {}, _hull(views, {}, box, side, at_first)
    if hull is None:
        raise InputError(
            "no training view sees anything of what lies between --pipeline.model.near and far around "
            f"({', '.join(f'{x:.2f}' for x in box.middle)}): check the cameras' poses and principal points"
        )
    coarsening = COARSENING if prunable and shown else 0
    max_level = coarsening or (_max_level(hull, side) if prunable else 0)
    return SceneAnalysis(box, pixel, len(shown), hull, coarsening, max_level)


def _max_level(hull: Hull, side: float) -> int:
    """How often the hull's cells are to be subdivided to have that size, as far as the grid does not get too large."""
    wanted, possible = np.log2(hull.side / side), np.log2(MAX_GRID_CELLS / hull.cells.size) / 3
    return max(0, int(min(np.round(wanted), np.floor(possible))))


def _hull(views: Views, shown: dict[int, Silhouette], box: Box, side: float, most: int) -> Hull | None:
    """Of cells of that side, or larger ones where there would be more than `most`; None if nothing is left."""
    rough = carve(views, shown, box, 2 * box.half / ROUGH)
    if rough is None:
        return None
    volume = max(rough.cells.sum() / most, rough.cells.size / MAX_GRID_CELLS) * rough.side**3
    return carve(views, shown, box, max(side, float(np.cbrt(volume))))


def _missed(views: Views, shown: dict[int, Silhouette], hull: Hull) -> float:
    """Share of the foreground's pixels, or of some of them, whose ray meets no cell."""
    some = spread_pixels({i: views.images[i][..., 3] > 0 for i in shown}, LOOKED_AT)
    rays = views.cameras.to(dtype=torch.float32).pixel_rays(some)
    met = OccupancyGrid.from_hull(hull).march(rays, hull.side / 4, None).ray_indices
    return 1 - len(met.unique()) / len(some)


def spread_pixels(masks: Mapping[int, np.ndarray], most: int) -> torch.Tensor:
    """At most so many of the pixels in masks (H, W) of images by number, evenly spread: (n, 3) image, row, column."""
    counts = [np.count_nonzero(mask) for mask in masks.values()]
    ends = np.cumsum(counts)
    chosen = np.linspace(0, ends[-1] - 1, min(most, ends[-1])).astype(int)
    found = []
    for (number, mask), count, end in zip(masks.items(), counts, ends, strict=True):
        mine = chosen[(chosen >= end - count) & (chosen < end)] - (end - count)
        row, column = np.divmod(np.flatnonzero(mask)[mine], mask.shape[1])
        found.append(np.stack((np.full(len(mine), number), row, column), axis=1))
    return torch.from_numpy(np.concatenate(found))


def live_pixels(views: Views, hull: Hull) -> list[np.ndarray]:
    """(H, W) bool of each view: all pixels whose ray meets a cell of the hull, and few others."""
    centers = hull.corner + (np.argwhere(_outermost(hull.cells)) + 0.5) * hull.side
    return [_covered(views, number, centers, hull.side) for number in range(len(views.images))]


def _outermost(cells: np.ndarray) -> np.ndarray:
    """(X, Y, Z) bool: cells with one of the 26 around them empty; a ray from outside meets one of these first."""
    inner = np.pad(cells, 1)
    for axis in range(3):
        inner = inner & np.roll(inner, 1, axis) & np.roll(inner, -1, axis)
    return cells & ~inner[1:-1, 1:-1, 1:-1]


def _covered(views: Views, number: int, centers: np.ndarray, side: float) -> np.ndarray:
    """Pixels covered by cells: their middles, made as large as the largest of their rectangles; all of them, if a cell
    is around the camera or as large as the image."""
    height, width = views.images[number].shape[:2]
    low, high, where = projected(views.cameras, number, centers, side)
    shown = (where == IN_FRONT) & (high[0] > 0) & (high[1] > 0) & (low[0] < width) & (low[1] < height)
    low, high = low[:, shown], high[:, shown]
    reach = int(np.ceil((high - low).max(initial=0) / 2)) + 1
    if (where == STRADDLING).any() or reach > max(height, width):
        return np.ones((height, width), dtype=bool)
    column, row = np.floor((low + high) / 2).astype(np.int64) + reach
    wide = np.zeros((height + 2 * reach, width + 2 * reach), dtype=np.uint8)
    wide[row, column] = 1
    count, size = cv2.integral(wide), 2 * reach + 1
    return count[size:, size:] - count[:-size, size:] - count[size:, :-size] + count[:-size, :-size] > 0
