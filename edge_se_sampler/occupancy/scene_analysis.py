"""The cells of a scene, derived from its cameras and its alpha: with which ones training begins, and how often they are
to be subdivided."""

from __future__ import annotations

import math
import sys
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
    indices = views.find_near()
    near_views = views.subset(indices)
    silhouettes = find_silhouettes(near_views) if by_alpha else {}
    hull, max_level = _carve_initial(near_views, silhouettes, box, finest)
    hit_pixels = [] if hull is None else find_hit_pixels(views, hull)
    carved_by = [indices[i] for i in silhouettes]
    if silhouettes and (hull is None or _missed_fraction(views, carved_by, hit_pixels) > MAX_MISSED_FRACTION):
        _warn_of_masks(near, far)
        silhouettes = {}
        hull, max_level = _carve_initial(near_views, {}, box, finest)
        hit_pixels = [] if hull is None else find_hit_pixels(views, hull)
    if hull is None:
        raise _nothing_seen(box)
    num_pixels = sum(int(_find_shown(views, i, bool(silhouettes)).sum()) for i in range(len(views.images)))
    point, _ = find_focus(near_views.cameras)
    focus = np.array([*point, near_share, near_views.cameras.find_distances(point).max()])
    return SceneAnalysis(
        box, len(silhouettes), show_whole_object(silhouettes), hull, max_level, hit_pixels, num_pixels, focus
    )


def _find_shown(views: Views, view: int, by_alpha: bool) -> np.ndarray:
    """(H, W) bool: the pixels of a view that are trained on and show something: where alpha tells, those that are not
    transparent."""
    image = views.images[view]
    shown = np.ones(image.shape[:2], dtype=bool) if views.masks is None else views.masks[view]
    return shown & (image[..., 3] > 0) if by_alpha and image.shape[2] == 4 else shown


def _carve_initial(
    views: Views, silhouettes: dict[int, Silhouette], box: Box, finest: float
) -> tuple[Hull | None, int]:
    """The hull in the cells with which training begins, and how often they are to be subdivided."""
    hull = carve(views, silhouettes, box, finest * 2**MIN_LEVELS, MAX_INITIAL_CELLS)
    return hull, MIN_LEVELS if hull is None else round(math.log2(hull.cell_size / finest))


def _missed_fraction(views: Views, carved_by: list[int], hit_pixels: list[np.ndarray]) -> float:
    """Share of the foreground's pixels, of the views that carved the hull, whose rays miss it."""
    foreground = {i: _find_shown(views, i, by_alpha=True) for i in carved_by}
    missed = sum(np.count_nonzero(shown & ~hit_pixels[i]) for i, shown in foreground.items())
    return missed / max(sum(map(np.count_nonzero, foreground.values())), 1)


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
