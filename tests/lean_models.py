"""Small lean-nerf models and trainings."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tiny import ball_views

from edge_se_sampler.engine.config import MANAGER, MODEL, TrainerConfig, override
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models.config import LeanModelConfig
from edge_se_sampler.models.lean import LeanModel
from edge_se_sampler.occupancy.bricks import BrickGrid

VIEWS = ball_views()


def config_of(steps: int | None, **changes: Any) -> TrainerConfig:
    """64 rays a step, in cells of half a pixel at last; for model fields, their names."""
    config: TrainerConfig = method_configs()["lean-nerf"]
    model = {f"{MODEL}.{name}": value for name, value in {"voxel_size_px": 0.5, **changes}.items()}
    return override(config, {f"{MANAGER}.train_num_rays_per_batch": 64, "max_num_iterations": steps, **model})


def steps_of(trainer: Trainer, count: int, first: int = 0) -> list[float]:
    return [trainer.train_iteration(step) for step in range(first, first + count)]


def full_model(cells: torch.Tensor | None = None, max_level: int = 2, num_pixels: int = 10**9) -> LeanModel:
    """In float32, in a box of two units around the origin."""
    cells = torch.ones((8, 8, 8), dtype=torch.bool) if cells is None else cells
    grid = BrickGrid.from_cells(torch.full((3,), -1.0), 0.25, cells, max_level, num_pixels)
    return LeanModel(LeanModelConfig(size="tiny", max_memory=1.0), np.random.default_rng(0), grid)
