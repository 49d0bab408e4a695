"""A model's density at the corners of sparse cells."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.models.lean import LeanModel
from edge_se_sampler.models.nerf import NeRFModel
from edge_se_sampler.occupancy.bricks import BRICK, BrickGrid
from edge_se_sampler.occupancy.scene_analysis import MIN_LEVELS, analyze_scene

POINTS_AT_ONCE = 2**16


@dataclass(frozen=True)
class DensityGrid:
    """Densities at the corners of occupied cells."""

    grid: BrickGrid
    log_depth: Tensor
    """(64 K,) float32: logarithm of the optical depth across a cell, by the corner's row; -inf at corners of no
    occupied cell, for outside of those there is nothing."""


def lean_density(model: LeanModel) -> DensityGrid:
    """The model's own corners."""
    grid = model.grid
    log_depth = model.density.detach()[:, 0] + float(torch.log(grid.cell_size / grid.finest_size))
    return DensityGrid(grid, torch.where(find_corners(grid), log_depth, -torch.inf))


@torch.no_grad()
def nerf_density(model: NeRFModel, views: Views) -> DensityGrid:
    """A network's density in at most 2^24 cells, where the views' alpha and cameras say that something can be."""
    near, far = model.config.depths
    grid = analyze_scene(views, near, far, voxel_size_px=model.config.voxel_size_px, by_alpha=True).grid()
    for _ in range(MIN_LEVELS):
        grid = grid.subdivide(grid.to_cells(grid.occupied.reshape(-1)), float(grid.cell_size) / 2)
    rows = torch.nonzero(find_corners(grid))[:, 0]
    cells = torch.cartesian_prod(*[torch.arange(BRICK)] * 3)
    log_depth = torch.full((grid.num_rows,), -torch.inf)
    direction = torch.zeros((1, 3), device=model.device, dtype=model.dtype)
    numbers = torch.zeros(POINTS_AT_ONCE, dtype=torch.int64, device=model.device)
    with Progress(len(rows), "asking the network for density") as progress:
        for i, some in enumerate(rows.split(POINTS_AT_ONCE)):
            corners = BRICK * grid.bricks[some // BRICK**3] + cells[some % BRICK**3]
            positions = (grid.aabb_min + corners * grid.cell_size).to(direction)
            density, _ = model.fine(positions, direction, numbers[: len(some)])
            log_depth[some] = torch.log(density.cpu() * float(grid.cell_size)).float()
            progress.update(i * POINTS_AT_ONCE + len(some))
    return DensityGrid(grid, log_depth)


def find_corners(grid: BrickGrid) -> Tensor:
    """(64 K,) bool: the rows of corners of occupied cells."""
    found = torch.zeros(grid.num_rows, dtype=torch.bool, device=grid.occupied.device)
    for some in torch.arange(len(grid.bricks), device=found.device).split(2**13):
        brick, cell = torch.nonzero(grid.occupied[some], as_tuple=True)
        found[grid.corner_rows(some[brick], cell)] = True
    return found
