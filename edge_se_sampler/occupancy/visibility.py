"""Where an image's rays are empty: up to which depth none of them is in a cell that is sampled."""

from __future__ import annotations

import torch
from torch import Tensor

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.occupancy.bricks import BRICK, BrickGrid

TILE = 4
"""Pixels along the tiles of an image for which a depth is found."""
MARGIN = 1.0
"""Pixels by which a brick's rectangle is widened: rays through a pixel's quarters, and rounding."""
EXACTNESS = 1e-5
"""Part of a depth that rounding may take away."""


def find_empty_depths(grid: BrickGrid, camera: Cameras) -> Tensor:
    """Depths along one camera's optical axis, (H W,) row by row, world units, before which no ray through a pixel is in
    a cell that is sampled; inf: it never is.

    Each brick covers a rectangle of pixels, and so a few tiles of a size that suits it: of all tiles the least depth
    counts. A depth at which rays begin (`BrickGrid.empty_depth`) bounds the rectangles of bricks around the camera.
    """
    width, height = int(camera.width), int(camera.height)
    low, high, depth = _project(grid, camera)
    end = low.new_tensor([[(width - 1) // TILE], [(height - 1) // TILE]])
    first, last = ((edge / TILE).floor() for edge in (low, high))
    depth = torch.where(((last >= 0) & (first <= end)).all(dim=0), depth, torch.inf)
    first, last = (torch.minimum(edge.clamp(min=0), end).long() for edge in (first, last))
    # tiles twice as large at each level, until a rectangle touches no more than three along each axis
    level = torch.frexp(((last - first).amax(dim=0) - 1 >> 1).clamp(min=0).float()).exponent
    tiles = depth.new_full((1, 1), torch.inf)
    for k in range(int(end.max()).bit_length(), -1, -1):
        columns, rows = ((int(x) >> k) + 1 for x in end)
        tiles = tiles.repeat_interleave(2, dim=0).repeat_interleave(2, dim=1)[:rows, :columns].contiguous()
        here = torch.nonzero(level == k)[:, 0]
        (x0, y0), (x1, y1) = (edge.index_select(1, here) >> k for edge in (first, last))
        near = depth.index_select(0, here)
        for y in (y0, (y0 + y1) >> 1, y1):
            for x in (x0, (x0 + x1) >> 1, x1):
                tiles.view(-1).scatter_reduce_(0, y * columns + x, near, "amin")
    pixels = tiles.repeat_interleave(TILE, dim=0)[:height].repeat_interleave(TILE, dim=1)[:, :width]
    return pixels.reshape(-1)


def _project(grid: BrickGrid, camera: Cameras) -> tuple[Tensor, Tensor, Tensor]:
    """Rectangles of the bricks in which a cell is sampled: least and greatest x, y in pixels, (2, k), and least depth,
    (k,); inf where a brick ends before the camera's rays begin."""
    pose, size = camera.camera_to_worlds[0], BRICK * float(grid.cell_size)
    begin = float(grid.empty_depth(pose[None, :, 3]))
    centers = (grid.sampled_bricks + 0.5) * size + (grid.aabb_min.to(pose) - pose[:, 3])
    right, up, back = pose[:, :3].T @ centers.T
    half_x, half_y, half_z = size / 2 * pose[:, :3].abs().sum(dim=0)
    near = (-half_z - back).clamp(min=max(begin, size * EXACTNESS))
    far = half_z - back
    is_sampled, far = far > begin, far.maximum(near)
    edges = []
    for center, half, focal, principal in ((right, half_x, camera.fx, camera.cx), (-up, half_y, camera.fy, camera.cy)):
        low, high = center - half, center + half
        # seen at the greatest angle where it is nearest, but for what is beyond the optical axis
        slopes = torch.minimum(low / near, low / far), torch.maximum(high / near, high / far)
        edges.append([principal[0] + focal[0] * slope + m for slope, m in zip(slopes, (-MARGIN, MARGIN), strict=True)])
    low, high = (torch.stack(edge) for edge in zip(*edges, strict=True))
    return low, high, torch.where(is_sampled, near * (1 - EXACTNESS), torch.inf)
