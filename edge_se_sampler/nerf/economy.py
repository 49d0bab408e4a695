"""What a scene needs, derived from its cameras and its alpha: where to look, and how closely."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from edge_se_sampler.data.blender import Views
from edge_se_sampler.nerf.config import LeanModelConfig, ModelConfig
from edge_se_sampler.nerf.hull import Box, Hull, box_of, carve, footprint, projected, silhouettes

MOST_CELLS = 2**18
"""More would cost more than they tell."""
ROUGH = 64
"""Cells along the box of a first hull, which tells how many finer ones there will be."""


@dataclass(frozen=True)
class Needs:
    """Of a scene."""

    box: Box
    footprint: float
    """Of a pixel at the box's middle, world units."""
    silhouettes: int
    """Views whose alpha tells the object from the background."""
    hull: Hull
    """The cells that may hold something."""


def needs(views: Views, config: ModelConfig) -> Needs:
    """Derive what training views need under a resolved config."""
    by_alpha = config.economy == "auto" and not (isinstance(config, LeanModelConfig) and not config.cull_by_alpha)
    box = box_of(views, config.near, config.far)
    pixel = footprint(views, box)
    shown = silhouettes(views) if by_alpha else {}
    rough = carve(views, shown, box, 2 * box.half / ROUGH)
    volume = rough.cells.sum() * rough.side**3
    side = max(config.cell_pixels * pixel, float(np.cbrt(volume / MOST_CELLS)))
    return Needs(box, pixel, len(shown), carve(views, shown, box, side))


def live_pixels(views: Views, hull: Hull) -> list[np.ndarray]:
    """(H, W) bool of each view: all pixels whose ray meets a cell of the hull, and few others."""
    centers = hull.corner + (np.argwhere(hull.cells) + 0.5) * hull.side
    return [_covered(views, number, centers, hull.side) for number in range(len(views.images))]


def _covered(views: Views, number: int, centers: np.ndarray, side: float) -> np.ndarray:
    """Pixels covered by cells: their middles, made as large as the largest of their rectangles."""
    height, width = views.images[number].shape[:2]
    low, high, ahead = projected(views, number, centers, side)
    if not ahead.all():
        return np.ones((height, width), dtype=bool)
    reach = int(np.ceil((high - low).max() / 2)) + 1
    column, row = np.floor((low + high) / 2).astype(np.int64).T + reach
    wide = np.zeros((height + 2 * reach, width + 2 * reach), dtype=np.uint8)
    inside = (row >= 0) & (row < wide.shape[0]) & (column >= 0) & (column < wide.shape[1])
    wide[row[inside], column[inside]] = 1
    covered = cv2.dilate(wide, np.ones((2 * reach + 1,) * 2, dtype=np.uint8))
    return covered[reach : reach + height, reach : reach + width] > 0
