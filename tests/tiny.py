"""Small fixtures: a NeRF that is evaluated in no time, rays and views to train it on, flags of a short training."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from edge_se_sampler.data.cameras import Cameras, RayBundle
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.checkpoint import latest_checkpoint, load_checkpoint
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.pipeline import Pipeline, saved_grid
from edge_se_sampler.engine.run_folder import RunFolder, config_digest
from edge_se_sampler.engine.session import resolve_config
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models.config import NeRFModelConfig
from edge_se_sampler.models.nerf import NeRFModel
from edge_se_sampler.occupancy.bricks import BrickGrid
from edge_se_sampler.occupancy.hull import Hull

SMALL = (
    "--max-num-iterations", "6", "--pipeline.datamanager.train-num-rays-per-batch", "16",
    "--pipeline.model.num-coarse-samples", "8", "--pipeline.model.num-importance-samples", "8",
    "--machine.device-type", "cpu",
)  # fmt: skip
"""Flags of a training of six steps."""


def tiny_config(**changes: Any) -> NeRFModelConfig:
    """A resolved config of a small network with few samples a ray."""
    small = NeRFModelConfig(
        size="tiny",
        width=8,
        depth=3,
        position_frequencies=2,
        direction_frequencies=1,
        num_coarse_samples=6,
        num_importance_samples=5,
    )
    return replace(small, **changes)


def tiny_model(seed: int = 0, grid: BrickGrid | None = None, **changes: Any) -> NeRFModel:
    """A NeRF of `tiny_config`, in float64."""
    return NeRFModel(tiny_config(**changes), np.random.default_rng(seed), grid).double()


def grid_of(hull: Hull) -> BrickGrid:
    """A hull's cells."""
    return BrickGrid.from_cells(torch.from_numpy(hull.aabb_min), hull.cell_size, torch.from_numpy(hull.cells))


def tiny_rays(count: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> RayBundle:
    """Rays from 4 world units away, past the origin within 1; directions_norm between 1 and 1.2."""
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(count, 3))
    origins *= 4 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-0.6, 0.6, (count, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    norm = torch.from_numpy(rng.uniform(1, 1.2, (count, 1))).to(dtype)
    numbers = torch.zeros((count, 1), dtype=torch.int64)
    metadata = {"directions_norm": norm, "pixel_axes": torch.from_numpy(rng.normal(size=(count, 2, 3)) / 50).to(dtype)}
    return RayBundle(torch.from_numpy(origins).to(dtype), torch.from_numpy(directions).to(dtype), numbers, metadata)


def with_constant_density(model: NeRFModel, raw: float) -> NeRFModel:
    """The model with this raw density everywhere, in both networks."""
    with torch.no_grad():
        for field in (model.coarse, model.fine):
            field.density.weight.zero_()
            field.density.bias.fill_(raw)
    return model


def tiny_views(
    count: int = 3, height: int = 8, width: int = 6, channels: int = 4, masks: tuple[np.ndarray, ...] | None = None
) -> Views:
    """Views of random pixels, from 4 world units away along their own z axis."""
    rng = np.random.default_rng(5)
    images = tuple(rng.integers(0, 256, (height, width, channels), dtype=np.uint8) for _ in range(count))
    pose = np.eye(4)
    pose[2, 3] = 4
    cameras = Cameras.of([pose] * count, fx=7, fy=8, cx=width / 2, cy=height / 2, width=width, height=height)
    return Views(tuple(f"view {i}" for i in range(count)), images, masks, cameras)


def check_gradients(model: nn.Module, loss: Callable[[], torch.Tensor]) -> None:
    """A float64 model's gradients of a loss, along a random direction in every parameter, by finite differences."""
    loss().backward()
    rng = np.random.default_rng(0)
    h = 1e-7
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.any(), name
        step = torch.from_numpy(rng.normal(size=parameter.shape))
        analytic = float((parameter.grad * step).sum())
        with torch.no_grad():
            values = []
            for sign in (1, -2):
                parameter += sign * h * step
                values.append(float(loss()))
            parameter += h * step
        numeric = (values[0] - values[1]) / (2 * h)
        assert numeric == pytest.approx(analytic, rel=1e-4, abs=1e-7), name


def tiny_trainer(config: TrainerConfig, views: Views, output_dir: Path | None = None, device: str = "cpu") -> Trainer:
    """A trainer on views; without a folder for its run it can take steps, which write nothing, but not save."""
    config = resolve_config(replace(config, output_dir=output_dir or config.output_dir), views)
    run = RunFolder.create(config) if output_dir else RunFolder(Path("never written"))
    return config.setup(run=run, pipeline=Pipeline.build(config, views, device), preview=None)


def resume_trainer(trainer: Trainer, views: Views) -> Trainer:
    """Another trainer, which continues from the last checkpoint of this one."""
    config, run = trainer.config, trainer.run
    state = load_checkpoint(latest_checkpoint(run.checkpoints), config_digest(config))
    pipeline = Pipeline.build(config, views, "cpu", saved_grid(state["model"]))
    resumed = config.setup(run=run, pipeline=pipeline, preview=None)
    resumed.resume(state)
    return resumed


def copy_run(run: Path, data: Path, output_dir: Path) -> Path:
    """A copy of a run below another output folder, as if it had been trained there, on a copy of its data."""
    copied = RunFolder(Path(shutil.copytree(run, output_dir.joinpath(*run.parts[-3:]))))
    config = copied.config(method_configs())
    copied.write_config(replace(config, data=data, output_dir=output_dir))
    return copied.path


def ball_views(count: int = 6, size: int = 16, radius: float = 1.0) -> Views:
    """Views, from 4 world units away, of a ball around the origin with the color of its normal, in front of nothing."""
    rng = np.random.default_rng(3)
    poses = np.zeros((count, 3, 4))
    for pose in poses:
        back = rng.normal(size=3)
        back /= np.linalg.norm(back)
        right = np.cross((0.0, 1.0, 0.0), back)
        right /= np.linalg.norm(right)
        pose[:] = np.stack((right, np.cross(back, right), back, 4 * back), axis=1)
    cameras = Cameras.of(poses, fx=1.4 * size, fy=1.4 * size, cx=size / 2, cy=size / 2, width=size, height=size)
    images = []
    for i in range(count):
        rays = cameras.image_rays(i)
        middle = -(rays.origins * rays.directions).sum(dim=1)
        below = radius**2 - (rays.origins.square().sum(dim=1) - middle.square())
        normal = (rays.origins + (middle - below.clamp(min=0).sqrt())[:, None] * rays.directions) / radius
        pixels = torch.cat((normal / 2 + 0.5, (below[:, None] > 0).double()), dim=1).clamp(0, 1) * 255
        images.append(pixels.byte().numpy().reshape(size, size, 4))
    return Views(tuple(f"view {i}" for i in range(count)), tuple(images), None, cameras)
