"""Density at the corners of cells, whatever the model."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.models.config import POINTS_PER_CHUNK
from edge_se_sampler.models.lean import LeanModel
from edge_se_sampler.models.nerf import NeRFModel
from edge_se_sampler.models.ray_model import RayModel
from edge_se_sampler.models.voxel_ops import find_dense_cells
from edge_se_sampler.occupancy.bricks import BrickGrid, unpack_bits
from edge_se_sampler.occupancy.subdivision import subdivide

MAX_ROWS = 2**23
"""Of the bricks of cells for which a dense network is evaluated: more would take long."""


def find_density(model: RayModel, opacity: float, find_box: Callable[[], BrickGrid]) -> tuple[BrickGrid, Tensor]:
    """Cells, and at each of their corners the logarithm of density, (64 K,), less that at which a cell has an opacity
    across; minus infinity at what is no corner of an occupied cell.

    lean-nerf has cells. Those of a dense network, its grid's or else those of `find_box`, are subdivided where they are
    as opaque as that, until they are as small as the scene's finest, or would be too many. FloatingPointError if a
    density is not a number.
    """
    threshold = math.log(-math.log1p(-opacity))
    if isinstance(model, LeanModel):
        grid = model.grid
        raw = model.density.detach()[:, 0] + math.log(float(grid.cell_size / grid.finest_size))
        return grid, torch.where(grid.find_corners(grid.occupied), raw - threshold, -torch.inf)
    assert isinstance(model, NeRFModel)
    grid = find_box().to(model.device) if model.grid is None else model.grid
    while True:
        difference = _evaluate(model, grid) + (math.log(float(grid.cell_size)) - threshold)
        if grid.level == grid.max_level:
            return grid, difference
        dense = unpack_bits(find_dense_cells(grid, difference[:, None], 0.0)).reshape(-1)
        finer = subdivide(grid, grid.to_cells(dense), float(grid.cell_size) / 2)
        if finer.num_rows > MAX_ROWS:
            return grid, difference
        grid = finer


@torch.no_grad()
def _evaluate(model: NeRFModel, grid: BrickGrid) -> Tensor:
    """(64 K,) logarithm of density; minus infinity at what is no corner of an occupied cell."""
    rows = torch.nonzero(grid.find_corners(grid.occupied))[:, 0]
    result = torch.full((grid.num_rows,), -torch.inf, dtype=model.dtype, device=model.device)
    any_direction = torch.zeros((1, 3), dtype=model.dtype, device=model.device)
    done = 0
    with Progress(len(rows), "evaluating density") as progress:
        for some in rows.split(POINTS_PER_CHUNK.get(model.device.type, 2**14)):
            positions = (grid.aabb_min + grid.coordinates(some).cpu() * grid.cell_size).to(result)
            result[some] = model.fine(positions, any_direction, None)[0].log()
            done += len(some)
            progress.update(done)
    if result.isnan().any():
        raise FloatingPointError("the model's densities are not finite: training diverged; try a lower --optimizer.lr")
    return result
