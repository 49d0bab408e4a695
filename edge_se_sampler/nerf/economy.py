"""What a scene needs, derived from its cameras and its alpha: where to look, and how closely."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from edge_se_sampler.cameras import RayGenerator
from edge_se_sampler.data.blender import Views
from edge_se_sampler.data.datamanager import cameras_of
from edge_se_sampler.nerf.config import LeanModelConfig, ModelConfig
from edge_se_sampler.nerf.hull import Box, Hull, Silhouette, box_of, carve, footprint, projected, silhouettes
from edge_se_sampler.nerf.occupancy import OccupancyGrid

MOST_CELLS = 2**18
"""More would cost more than they tell."""
TOLERATED = 0.01
"""Share of the foreground's pixels that may meet no cell, by stray ones."""
LOOKED_AT = 4096
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
    hull = _hull(views, shown, box, config.cell_pixels * pixel)
    if shown and (hull is None or _missed(views, shown, hull) > TOLERATED):
        print("the views' alpha masks do not agree on where the object is: they carve nothing away", file=sys.stderr)
        shown, hull = {}, _hull(views, {}, box, config.cell_pixels * pixel)
    assert hull is not None, "cameras see what they look at"
    return Needs(box, pixel, len(shown), hull)


def _hull(views: Views, shown: dict[int, Silhouette], box: Box, side: float) -> Hull | None:
    """Of cells of that side, or larger ones where there would be too many; None if nothing is left."""
    rough = carve(views, shown, box, 2 * box.half / ROUGH)
    if rough is None:
        return None
    volume = rough.cells.sum() * rough.side**3
    return carve(views, shown, box, max(side, float(np.cbrt(volume / MOST_CELLS))))


def _missed(views: Views, shown: dict[int, Silhouette], hull: Hull) -> float:
    """Share of the foreground's pixels, or of some of them, whose ray meets no cell."""
    inside = [np.insert(np.argwhere(views.images[i][..., 3] > 0), 0, i, axis=1) for i in shown]
    pixels = np.concatenate(inside)
    some = torch.from_numpy(pixels[np.linspace(0, len(pixels) - 1, min(LOOKED_AT, len(pixels))).astype(int)])
    rays = RayGenerator(cameras_of(views))(some)
    met = OccupancyGrid.of(hull).march(rays, hull.side / 4, None).ray
    return 1 - len(met.unique()) / len(some)


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
