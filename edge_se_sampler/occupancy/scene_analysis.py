"""The cells of a scene, derived from its cameras and its alpha: with which ones training begins, and how often they are
to be subdivided."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from edge_se_sampler.data.views import Views
from edge_se_sampler.errors import InputError
from edge_se_sampler.occupancy.bricks import BrickGrid
from edge_se_sampler.occupancy.hull import (
    Box,
    Hull,
    Silhouette,
    carve,
    find_box,
    find_focus,
    find_hit_pixels,
    find_silhouettes,
    show_whole_object,
)

MAX_INITIAL_CELLS = 2**18
"""Of the cells with which training begins: more take long to carve."""
MIN_LEVELS = 2
"""How often these are subdivided at least."""
MAX_MISSED_FRACTION = 0.01
"""Share of the foreground's pixels whose rays may miss a carved hull: stray ones do."""


@dataclass(frozen=True)
class SceneAnalysis:
    """What `analyze_scene` derives."""

    box: Box
    num_silhouettes: int
    """Views whose alpha tells the object from the background; 0: nothing was carved."""
    is_carved_close: bool
    """Whether most of them show all of the object, so that the hull is little larger than it."""
    hull: Hull
    """The cells with which training begins: those that may hold something."""
    max_level: int
    """How often training subdivides them."""
    hit_pixels: list[np.ndarray]
    """(H, W) bool of each view: the pixels whose rays hit the hull, and few others."""
    num_pixels: int
    """Pixels of all views that are trained on and show something: as alpha has it, where that carved the hull."""
    focus: np.ndarray
    """(5,) float64, as `BrickGrid`'s."""

    def grid(self) -> BrickGrid:
        """The cells with which training begins, with nothing else around them."""
        hull = self.hull
        cells = torch.from_numpy(hull.cells)
        corner = torch.from_numpy(hull.aabb_min)
        focus = torch.from_numpy(self.focus)
        grid = BrickGrid.from_cells(corner, hull.cell_size, cells, self.max_level, self.num_pixels, focus)
        grid.is_carved_close = self.is_carved_close
        return grid


def analyze_scene(
    views: Views, near: float, far: float, *, voxel_size_px: float, by_alpha: bool, near_share: float = 0.0
) -> SceneAnalysis:
    """Derive the cells of a scene from its training views, whose rays are sampled between depths near and far.

    Args:
        voxel_size_px: size of the cells that are wanted in the end, in footprints of a pixel. Training begins with
            cells 2^k times as large, k at least MIN_LEVELS, of which at most MAX_INITIAL_CELLS fill the hull.
        by_alpha: whether the visual hull is carved from alpha.
        near_share: of the way to what a view looks at, that share has nothing in it.

    Raises:
        InputError: the cameras see nothing between near and far.
    """
    box = find_box(views, near, far)
    finest = voxel_size_px * box.pixel_footprint
    silhouettes = find_silhouettes(views) if by_alpha else {}
    hull, max_level = _carve_initial(views, silhouettes, box, finest)
    hit_pixels = [] if hull is None else find_hit_pixels(views, hull)
    if silhouettes and (hull is None or _missed_fraction(views, silhouettes, hit_pixels) > MAX_MISSED_FRACTION):
        _warn_of_masks(near, far)
        silhouettes = {}
        hull, max_level = _carve_initial(views, {}, box, finest)
        hit_pixels = [] if hull is None else find_hit_pixels(views, hull)
    if hull is None:
        raise _nothing_seen(box)
    num_pixels = sum(_count_shown(views, i, bool(silhouettes)) for i in range(len(views.images)))
    cameras = views.leave_out_far().cameras
    point, _ = find_focus(cameras)
    focus = np.array([*point, near_share, cameras.find_distances(point).max()])
    return SceneAnalysis(
        box, len(silhouettes), show_whole_object(silhouettes), hull, max_level, hit_pixels, num_pixels, focus
    )


def _count_shown(views: Views, view: int, by_alpha: bool) -> int:
    """Pixels of a view that are trained on and show something: where alpha tells, those that are not transparent."""
    image = views.images[view]
    shown = np.ones(image.shape[:2], dtype=bool) if views.masks is None else views.masks[view]
    return int(np.count_nonzero(shown & _foreground(image) if by_alpha and image.shape[2] == 4 else shown))


def _carve_initial(
    views: Views, silhouettes: dict[int, Silhouette], box: Box, finest: float
) -> tuple[Hull | None, int]:
    """The hull in the cells with which training begins, and how often they are to be subdivided."""
    hull = carve(views, silhouettes, box, finest * 2**MIN_LEVELS, MAX_INITIAL_CELLS)
    return hull, MIN_LEVELS if hull is None else round(math.log2(hull.cell_size / finest))


def _missed_fraction(views: Views, silhouettes: Mapping[int, Silhouette], hit_pixels: list[np.ndarray]) -> float:
    """Share of the foreground's pixels whose rays miss the hull."""
    foreground = {i: _foreground(views.images[i]) for i in silhouettes}
    missed = sum(np.count_nonzero(mask & ~hit_pixels[i]) for i, mask in foreground.items())
    return missed / sum(np.count_nonzero(mask) for mask in foreground.values())


def _foreground(image: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels of an image (H, W, 4) that are not transparent."""
    return image[..., 3] > 0


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
