"""Compiling lean-nerf's kernels before the clock of a training runs."""

from __future__ import annotations

import sys
from threading import Timer
from types import ModuleType

import numpy as np
import torch

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.models.config import LeanModelConfig
from edge_se_sampler.models.lean import LeanModel
from edge_se_sampler.models.voxel_backend import compiled_ops
from edge_se_sampler.occupancy.bricks import BrickGrid
from edge_se_sampler.occupancy.subdivision import subdivide

SILENT_SECONDS = 5.0
NOTICE = "edge-se: compiling the kernels, which takes half a minute or two; they are kept for the next time"


def compile_ops(device: str) -> None:
    """Compile the kernels for models on a device, if there are any, and say so if it takes long: numba keeps them for
    the next time."""
    if device == "cpu" and (ops := compiled_ops()):
        notice = Timer(SILENT_SECONDS, lambda: print(NOTICE, file=sys.stderr, flush=True))
        notice.start()
        try:
            _call_all(ops)
        finally:
            notice.cancel()


def _call_all(ops: ModuleType) -> None:
    cells = torch.ones((1, 1, 1), dtype=torch.bool)
    grid = BrickGrid.from_cells(torch.zeros(3), 1.0, cells, max_level=1)
    model = LeanModel(LeanModelConfig(size="tiny", near=0.0), np.random.default_rng(0), grid)
    norm = {"directions_norm": torch.ones(1, 1)}
    ray = RayBundle(torch.full((1, 3), 0.1), torch.full((1, 3), 3**-0.5), torch.zeros((1, 1), dtype=torch.int64), norm)
    loss, _ = model.training_loss(ray, {"image": torch.ones(1, 4)})
    loss.sum().backward()
    for weight, total_variation in ((model.density, 0.0), (model.features, 1.0)):
        rows = {"lr": 0.1, "betas": (0.9, 0.99), "eps": 1e-15, "maximum": 5.0, "total_variation": total_variation}
        ops.adam_rows(weight, torch.zeros_like(weight), torch.zeros_like(weight[:, :1]), weight.grad, **rows)
        ops.find_dense_cells(grid, weight.data, 0.0)
        ops.resample(subdivide(grid, cells, 0.5).bricks, 0.5, grid.numbers, weight.data)
