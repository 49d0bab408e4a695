"""What a scene needs, in numbers that a person can check, and as a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.figures import printable, require_pyplot, save_figure
from edge_se_sampler.engine.metrics import composite_on
from edge_se_sampler.engine.pipeline import analyze_views, resolve_depths
from edge_se_sampler.models.config import LeanModelConfig, decide_size
from edge_se_sampler.models.lean import BYTES_PER_ROW, ROWS_PER_PIXEL
from edge_se_sampler.occupancy.scene_analysis import SceneAnalysis
from edge_se_sampler.sampling.edges import unit_float

NUM_VIEWS, NUM_AXES = 3, 12
"""Of the images, and of the cameras' optical axes, in the picture."""


def inspect(views: Views, config: LeanModelConfig, path: Path) -> str:
    """What is derived from training views, one finding a line; draws it too. InputError for bad settings or outputs."""
    pyplot = require_pyplot()
    config, depth_source = resolve_depths(views, decide_size(config, views.longest_side))
    config.check()
    analysis = analyze_views(views, config)
    hull, hit_pixels = analysis.hull, analysis.hit_pixels
    figure, axes = pyplot.subplots(2, NUM_VIEWS, figsize=(9.6, 6.6))
    ends = hull.aabb_min + np.array(hull.cells.shape) * hull.cell_size
    poses = views.cameras.camera_to_worlds.numpy()
    some = poses[:: -(-len(poses) // NUM_AXES)]
    (near, far), (*focus, nearest_share, _) = config.depths, analysis.focus
    begin = np.maximum(near, nearest_share * np.linalg.norm(some[:, :, 3] - focus, axis=1))
    depths = np.stack((begin, np.full_like(begin, far)))
    sampled = some[:, :, 3] - depths[..., None] * some[:, :, 2]  # optical axes, as far as rays are sampled
    for axis, along in zip(axes[0], (1, 0, 2), strict=True):  # how many cells lie one after another
        right, up = (other for other in range(3) if other != along)
        extent = (hull.aabb_min[right], ends[right], hull.aabb_min[up], ends[up])
        axis.plot(sampled[..., right], sampled[..., up], color="tab:cyan", linewidth=0.6)
        axis.plot(poses[:, right, 3], poses[:, up, 3], ".", color="tab:green", markersize=3)
        axis.imshow(hull.cells.sum(axis=along).T, origin="lower", extent=extent, cmap="magma", interpolation="nearest")
        axis.set(xlabel="xyz"[right], ylabel="xyz"[up], title=f"cells along {'xyz'[along]}")
        axis.autoscale()
    lines = axes[0, 0].lines
    figure.legend(
        [lines[-1], lines[0]],
        ["cameras", "depths at which some cameras' rays are sampled"],
        ncols=2,
        loc="upper center",
    )
    chosen = np.linspace(0, len(views.images) - 1, NUM_VIEWS).round().astype(int).tolist()
    axes[1, 1].set_xlabel("dark: pixels whose rays miss these cells")
    for axis, k in zip(axes[1], chosen, strict=True):
        color = composite_on(unit_float(views.images[k]))
        axis.imshow(np.where(hit_pixels[k][..., None], color, 0.25 * color), interpolation="nearest")
        axis.set(xticks=[], yticks=[])
        axis.set_title(printable(views.names[k]), fontsize=9, parse_math=False)
    figure.tight_layout(rect=(0, 0, 1, 0.96))
    save_figure(figure, path)
    return "\n".join(
        f"{name:<13}{finding}" for name, finding in _findings(views, analysis, config, depth_source).items()
    )


def _findings(views: Views, analysis: SceneAnalysis, config: LeanModelConfig, depth_source: str) -> dict[str, str]:
    hull, box, preset, footprint = analysis.hull, analysis.box, config.preset, analysis.box.pixel_footprint
    num_views, num_occupied = len(views.images), hull.cells.sum()
    sizes = " and ".join(f"{width} x {height}" for width, height in sorted({i.shape[1::-1] for i in views.images}))
    assert config.max_memory is not None  # the config is resolved
    # large cells may reach beyond the box
    num_cells = max(hull.cells.size, (2 * box.half_extent / hull.cell_size) ** 3)
    distance = views.cameras.find_distances(box.center)
    center = ", ".join(f"{value + 0.0:.2f}" for value in box.center.round(2))
    part = config.near_share
    nearer = f"; nothing nearer than {100 * part:g} % of the way to what a view looks at" if part else ""
    share = np.mean(np.concatenate([hit.ravel() for hit in analysis.hit_pixels]))
    return {
        "views": f"{num_views} of {sizes}, {np.median(distance):.2f} from what they look at, ({center})",
        "data": views.describe(),
        "memory": views.memory or "not known of views that were made in memory",
        "depths": f"{config.near:g} to {config.far:g}, by {depth_source}{nearer}",
        "pixel": f"{footprint:.4f} wide there: distance / focal length",
        "box": f"{2 * box.half_extent:.2f} a side: as deep as rays are sampled",
        "silhouettes": f"{analysis.num_silhouettes} of {num_views} views tell the object from its background by alpha",
        "cells": f"{hull.cell_size:.4f} a side, {hull.cell_size / footprint:.1f} pixels; {num_occupied:,} of "
        f"{num_cells:,.0f} may hold something ({100 * num_occupied / num_cells:.1f} %)",
        "levels": f"what training sees is subdivided {analysis.max_level} times, to about {config.voxel_size_px:g} "
        f"pixel{'' if config.voxel_size_px == 1 else 's'}, as what was seen and {config.max_memory:.1f} GiB allow",
        "corners": f"{config.max_memory * 2**30 / BYTES_PER_ROW / 1e6:.1f} million of cells fit into that; the images "
        f"show enough to learn {ROWS_PER_PIXEL * analysis.num_pixels / 1e6:.1f} million",
        "training": f"{preset.rays} rays a step, {preset.iterations:,} steps: size {config.size}, by the images' "
        "longer side",
        "rays": f"{100 * share:.1f} % of the pixels may cross these cells"
        + ", and training draws among them alone" * (analysis.num_silhouettes > 0),
    }
