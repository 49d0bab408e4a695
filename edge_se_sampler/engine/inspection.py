"""What a scene needs, in numbers that a person can check, and as a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.figures import require_pyplot, save_figure
from edge_se_sampler.models.config import LeanModelConfig, apply_preset, preset_of, size_for
from edge_se_sampler.occupancy.grid import OccupancyGrid
from edge_se_sampler.occupancy.scene_analysis import SceneAnalysis, analyze_scene, live_pixels, spread_pixels
from edge_se_sampler.sampling.edges import unit_float

RAYS = 4096
"""Looked at, of all live ones."""
SHOWN = 3
"""Views."""


def inspect(views: Views, config: LeanModelConfig, path: Path) -> str:
    """What is derived from training views; draws it too.

    Args:
        config: whose economy is asked; sizes may be left open.

    Raises:
        InputError: matplotlib is missing, or the picture cannot be written.
    """
    pyplot = require_pyplot()
    told = analyze_scene(views, config)
    live = live_pixels(views, told.hull)
    figure, axes = pyplot.subplots(2, SHOWN, figsize=(9.6, 6.6))
    _draw_hull(axes[0], told)
    _draw_views(axes[1], views, live)
    figure.tight_layout()
    save_figure(figure, path)
    return "\n".join(_lines(views, told, live, config))


def _lines(views: Views, told: SceneAnalysis, live: list[np.ndarray], config: LeanModelConfig) -> list[str]:
    """One a finding: the quantity, its value, and where it comes from."""
    hull, box = told.hull, told.box
    sizes = sorted({image.shape[1::-1] for image in views.images})
    whole = max(hull.cells.size, (2 * box.half / hull.side) ** 3)  # large cells may reach beyond the box
    first = hull.side * 2**told.coarser
    finest = first / 2**told.splits
    samples, along = _samples(views, told, live, config)
    distance = np.linalg.norm(views.cameras.camera_to_worlds[:, :, 3].numpy() - box.middle, axis=1)
    at = ", ".join(f"{value + 0.0:.2f}" for value in box.middle.round(2))
    across = np.mean(np.concatenate([pixels.ravel() for pixels in live]))
    size = size_for(max(max(size) for size in sizes))
    preset = preset_of(config, size)
    model = apply_preset(config, size, preset.rays)
    wave = 2 * np.pi * float(told.grid().reach) / 2 ** ((model.position_frequencies or 1) - 1) / told.footprint
    said = {
        "views": f"{len(views.images)} of {' and '.join(f'{w} x {h}' for w, h in sizes)}, {np.median(distance):.2f} "
        f"from what they look at, ({at})",
        "pixel": f"{told.footprint:.4f} wide there: distance / focal length",
        "box": f"{2 * box.half:.2f} a side: as deep as rays are sampled",
        "silhouettes": f"{told.silhouettes} of {len(views.images)} views tell the object from its background by alpha",
        "cells": f"{hull.side:.4f} a side, {hull.side / told.footprint:.1f} pixels; {hull.cells.sum():,} of "
        f"{whole:,.0f} may hold something ({100 * hull.cells.sum() / whole:.1f} %)"
        + (f"; training begins with {first:.4f}, split to {finest:.4f} where it sees any" if told.splits else ""),
        "encoding": f"{model.position_frequencies} frequencies of a position, the finest wave {wave:.1f} pixels long; "
        f"what is finer is left to {model.feature_dim} features at every corner of a cell",
        "network": f"{model.depth} x {model.width}, {preset.rays} rays a step, {preset.iterations:,} steps: size "
        f"{size}, by the images' longer side",
        "rays": f"{100 * across:.1f} % of the pixels may cross them; such a ray has {samples:.1f} samples, {along:.0f} "
        "along all of its depth",
        "sampling": "uniform among them"
        if told.silhouettes
        else "by edges as long as they pay, for nothing tells where the object is",
    }
    return [f"{name:<13}{what}" for name, what in said.items()]


def _samples(views: Views, told: SceneAnalysis, live: list[np.ndarray], config: LeanModelConfig) -> tuple[float, float]:
    """Samples of a live ray: in the hull, and along the box's whole side; the first a mean over some."""
    step = config.step_size_voxels * told.hull.side
    chosen = spread_pixels(dict(enumerate(live)), RAYS)
    rays = views.cameras.to(dtype=torch.float32).pixel_rays(chosen)
    samples = OccupancyGrid.of(told.hull).march(rays, step, None, (config.near, config.far))
    return len(samples.t) / len(chosen), 2 * told.box.half / step


def _draw_hull(axes: np.ndarray, told: SceneAnalysis) -> None:
    """The hull from three sides: how many cells lie behind each other."""
    hull = told.hull
    ends = hull.corner + np.array(hull.cells.shape) * hull.side
    for axis, along, (right, up) in zip(axes, (1, 0, 2), ((0, 2), (1, 2), (0, 1)), strict=True):
        extent = (hull.corner[right], ends[right], hull.corner[up], ends[up])
        axis.imshow(hull.cells.sum(axis=along).T, origin="lower", extent=extent, cmap="magma", interpolation="nearest")
        axis.set(xlabel="xyz"[right], ylabel="xyz"[up], title=f"cells along {'xyz'[along]}")


def _draw_views(axes: np.ndarray, views: Views, live: list[np.ndarray]) -> None:
    """Views, those pixels dark that train nothing."""
    chosen = np.linspace(0, len(views.images) - 1, SHOWN).round().astype(int).tolist()
    for axis, k in zip(axes, chosen, strict=True):
        image = unit_float(views.images[k])
        color = image[..., :3] * image[..., 3:] + 1 - image[..., 3:] if image.shape[2] == 4 else image
        axis.imshow(np.where(live[k][..., None], color, 0.25 * color), interpolation="nearest")
        axis.set(xticks=[], yticks=[], title=f"{views.names[k]}: live pixels")
