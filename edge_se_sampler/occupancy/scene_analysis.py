"""The cells of a scene, derived from its cameras and its alpha: where networks are evaluated, and how finely."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch

from edge_se_sampler.data.views import Views
from edge_se_sampler.errors import InputError
from edge_se_sampler.occupancy.bricks import BrickGrid
from edge_se_sampler.occupancy.grid import MAX_OCCUPIED_CELLS, OccupancyGrid
from edge_se_sampler.occupancy.hull import Box, Hull, Silhouette, carve, find_box, find_silhouettes

MAX_GRID_CELLS = 2**24
"""Cells of a grid's box, occupied or not: each takes memory."""
MAX_MISSED_FRACTION = 0.01
"""Share of the foreground's pixels whose rays may miss a carved hull: stray ones do."""


@dataclass(frozen=True)
class SceneAnalysis:
    """What `analyze_scene` derives."""

    box: Box
    num_silhouettes: int
    """Views whose alpha tells the object from the background; 0: nothing was carved."""
    hull: Hull
    """The cells that may hold something."""
    coarsening: int
    """How often these cells are doubled for training to begin with."""
    max_level: int
    """How often training may subdivide them."""

    def grid(self) -> OccupancyGrid:
        """The cells with which training begins."""
        return OccupancyGrid.from_hull(self.hull, self.max_level, self.coarsening)

    def brick_grid(self) -> BrickGrid:
        """The same, sparse."""
        hull = self.hull
        cells = torch.from_numpy(hull.cells)
        return BrickGrid.from_cells(torch.from_numpy(hull.aabb_min), hull.cell_size, cells, self.max_level)


def analyze_levels(views: Views, near: float, far: float, *, voxel_size_px: float, by_alpha: bool) -> SceneAnalysis:
    """As `analyze_scene`, for cells that training subdivides again and again: it begins with cells of 2^k times the
    size that is wanted in the end, k at least 2, and large enough for MAX_OCCUPIED_CELLS of them to fill the hull."""
    box = find_box(views, near, far)
    finest = voxel_size_px * box.pixel_footprint
    silhouettes = find_silhouettes(views) if by_alpha else {}
    hull, max_level = _initial_hull(views, silhouettes, box, finest)
    if silhouettes and (hull is None or _missed_fraction(views, silhouettes, hull) > MAX_MISSED_FRACTION):
        _warn_of_masks(near, far)
        silhouettes = {}
        hull, max_level = _initial_hull(views, {}, box, finest)
    if hull is None:
        raise _nothing_seen(box)
    return SceneAnalysis(box, len(silhouettes), hull, 0, max_level)


def _initial_hull(views: Views, silhouettes: dict[int, Silhouette], box: Box, finest: float) -> tuple[Hull | None, int]:
    """The hull in the cells with which training begins, and how often they are to be subdivided."""
    level = 2
    while True:
        size = finest * 2**level
        # a box of more cells takes long to carve
        within = (2 * box.half_extent / size) ** 3 <= 64 * MAX_OCCUPIED_CELLS
        hull = carve(views, silhouettes, box, size) if within else None
        if within and (hull is None or hull.cells.sum() <= MAX_OCCUPIED_CELLS):
            return hull, level
        level += 1


def _warn_of_masks(near: float, far: float) -> None:
    print(
        f"the views' alpha masks carve nothing away: the object does not lie between near {near:g} and far "
        f"{far:g} (set both), or they do not agree on where it is, or show too little of it",
        file=sys.stderr,
    )


def _nothing_seen(box: Box) -> InputError:
    return InputError(
        "no training view sees anything of what lies between --pipeline.model.near and far around "
        f"({', '.join(f'{x:.2f}' for x in box.center)}): check the cameras' poses and principal points"
    )


def analyze_scene(
    views: Views, near: float, far: float, *, voxel_size_px: float, by_alpha: bool, prunable: bool
) -> SceneAnalysis:
    """Derive the cells of a scene from its training views, whose rays are sampled between depths near and far.

    Args:
        voxel_size_px: size of a cell, in footprints of a pixel.
        by_alpha: whether the visual hull is carved from alpha.
        prunable: whether training prunes cells. It then begins with larger ones, to subdivide those that stay: twice as
            large as a carved hull's; in an uncarved box, as large as lets all be subdivided once.

    Raises:
        InputError: the cameras see nothing between near and far.
    """
    max_uncarved = MAX_OCCUPIED_CELLS // 8 if prunable else MAX_OCCUPIED_CELLS
    box = find_box(views, near, far)
    cell_size = voxel_size_px * box.pixel_footprint
    silhouettes = find_silhouettes(views) if by_alpha else {}
    hull = _bounded_hull(views, silhouettes, box, cell_size, MAX_OCCUPIED_CELLS if silhouettes else max_uncarved)
    if silhouettes and (hull is None or _missed_fraction(views, silhouettes, hull) > MAX_MISSED_FRACTION):
        _warn_of_masks(near, far)
        silhouettes, hull = {}, _bounded_hull(views, {}, box, cell_size, max_uncarved)
    if hull is None:
        raise _nothing_seen(box)
    coarsening = max_level = int(prunable and bool(silhouettes))
    if prunable and not silhouettes:
        wanted, possible = np.log2(hull.cell_size / cell_size), np.log2(MAX_GRID_CELLS / hull.cells.size) / 3
        max_level = max(0, int(min(np.round(wanted), np.floor(possible))))
    return SceneAnalysis(box, len(silhouettes), hull, coarsening, max_level)


def _bounded_hull(
    views: Views, silhouettes: dict[int, Silhouette], box: Box, cell_size: float, max_cells: int
) -> Hull | None:
    """The hull in cells of that size, or larger ones where there would be more than max_cells; None if it is empty."""
    rough = carve(views, silhouettes, box, box.half_extent / 32)  # tells how many finer cells there would be
    if rough is None:
        return None
    volume = max(rough.cells.sum() / max_cells, rough.cells.size / MAX_GRID_CELLS) * rough.cell_size**3
    return carve(views, silhouettes, box, max(cell_size, float(np.cbrt(volume))))


def _missed_fraction(views: Views, silhouettes: dict[int, Silhouette], hull: Hull) -> float:
    """Share of the foreground's pixels whose rays miss the hull, estimated on 4096 of them."""
    pixels = pick_pixels({i: views.images[i][..., 3] > 0 for i in silhouettes})
    rays = views.cameras.to(dtype=torch.float32).pixel_rays(pixels)
    hit = OccupancyGrid.from_hull(hull).march(rays, hull.cell_size / 4, None).ray_indices
    return 1 - len(hit.unique()) / len(pixels)


def pick_pixels(masks: Mapping[int, np.ndarray], max_pixels: int = 4096) -> torch.Tensor:
    """Pixels in masks (H, W) by image index, evenly spread and at most so many: (n, 3) int64 image, row, column."""
    ends = np.cumsum([0, *(int(mask.sum()) for mask in masks.values())])
    chosen = np.linspace(0, ends[-1] - 1, min(max_pixels, ends[-1])).astype(int)
    pixels = []
    for (index, mask), (begin, end) in zip(masks.items(), pairwise(ends), strict=True):
        in_mask = chosen[(chosen >= begin) & (chosen < end)] - begin
        pixels.append(np.insert(np.argwhere(mask)[in_mask], 0, index, axis=1))
    return torch.from_numpy(np.concatenate(pixels))
