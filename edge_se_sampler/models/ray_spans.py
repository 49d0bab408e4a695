"""The part of each ray that samples of a grid's cells may lie on."""

from __future__ import annotations

import torch

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.models.voxel_ops import RaySpans
from edge_se_sampler.occupancy.bricks import BrickGrid
from edge_se_sampler.occupancy.saved_grid import MAX_SIZE


def find_spans(rays: RayBundle, size: int, grid: BrickGrid, depths: tuple[float, float], step: float) -> RaySpans:
    """Rays in units of cells, `size` (1 or 4) through each pixel, from where they enter the grid's box, or the near
    depth or what is empty ends, to where they leave it.

    Args:
        depths: near and far along the optical axis, world units, of rays that have no "nears" and "fars".
        step: distance between samples, in sides of a cell.
    """
    cell_size = float(grid.cell_size)
    whole = rays.directions, rays.metadata["directions_norm"]
    directions, norm = (x.reshape(-1, x.shape[-1]) for x in (rays.split_pixels() if size > 1 else whole))
    of_pixels = grid.to_cell_units(rays.origins).to(directions.dtype)
    scale = norm.reshape(-1, size) / cell_size
    if "nears" in rays.metadata:
        near, far = (rays.metadata[name] / cell_size for name in ("nears", "fars"))
    else:
        near, far = grid.empty_depth(rays.origins).clamp(min=depths[0])[:, None] * scale, depths[1] * scale
    # from farther away float32 does not know the cell, and compiled kernels would look for it outside of the grid
    far = torch.where((of_pixels.abs() < MAX_SIZE).all(dim=1, keepdim=True), far, 0)
    origins = of_pixels[:, None].expand(-1, size, 3).reshape(-1, 3)  # copies nothing where a pixel has one ray
    inverse = 1 / torch.where(directions.abs() < 1e-12, 1e-12, directions)
    one, other = -origins * inverse, (grid.size - origins) * inverse
    begin = torch.minimum(one, other).amax(dim=1).clamp(min=0).reshape(-1, size).maximum(near)
    end = torch.maximum(one, other).amin(dim=1).reshape(-1, size).minimum(far)
    if "empty_depths" in rays.metadata:  # whole steps, so that samples are where they would be
        steps = ((rays.metadata["empty_depths"] * scale - begin) / step).floor().clamp(min=0)
        begin = begin + steps * step
    return RaySpans(origins, directions, begin.reshape(-1), end.reshape(-1))
