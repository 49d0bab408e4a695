"""Compiling lean-nerf's kernels before the clock of a training runs."""

from __future__ import annotations

import sys
import time

import numpy as np
import torch

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.models.config import LeanModelConfig
from edge_se_sampler.models.lean import LeanModel
from edge_se_sampler.models.voxel_backend import compiled_ops
from edge_se_sampler.occupancy.bricks import BrickGrid
from edge_se_sampler.occupancy.subdivision import subdivide


def compile_ops(device: str) -> None:
    """Compile the kernels for models on a device, if there are any, and say how long it took if it took long: numba
    keeps them for the next time."""
    ops, began = device == "cpu" and compiled_ops(), time.monotonic()
    if not ops:
        return
    cells = torch.ones((1, 1, 1), dtype=torch.bool)
    grid = BrickGrid.from_cells(torch.zeros(3), 1.0, cells, max_level=1)
    model = LeanModel(LeanModelConfig(size="tiny", near=0.0), np.random.default_rng(0), grid)
    norm = {"directions_norm": torch.ones(1, 1)}
    ray = RayBundle(torch.full((1, 3), 0.1), torch.full((1, 3), 3**-0.5), torch.zeros((1, 1), dtype=torch.int64), norm)
    loss, _ = model.training_loss(ray, {"image": torch.ones(1, 4)})
    loss.sum().backward()
    for weight in (model.density, model.features):
        rows = {"lr": 0.1, "betas": (0.9, 0.99), "eps": 1e-15, "maximum": 5.0, "total_variation": 1.0}
        ops.adam_rows(weight, torch.zeros_like(weight), torch.zeros_like(weight[:, :1]), weight.grad, **rows)
        ops.find_dense_cells(grid, weight.data, 0.0)
        ops.resample(subdivide(grid, cells, 0.5).bricks, 0.5, grid.numbers, weight.data)
    if time.monotonic() - began > 5:
        print(f"edge-se: compiled the kernels in {time.monotonic() - began:.0f} s; they are kept", file=sys.stderr)
