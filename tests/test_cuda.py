"""A real GPU, where there is one: what is rendered and differentiated there is what the CPU finds; commands run."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import lean_models
import numpy as np
import pytest
import torch
from test_devices import nerf_trainer
from tiny import SMALL, tiny_trainer
from torch import Tensor

from edge_se_sampler.engine.config import SAMPLER, override
from edge_se_sampler.engine.rendering import render_rays
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.models import voxel_ops
from edge_se_sampler.models.lean import WIDTH_CARVED, ColorNetwork
from edge_se_sampler.models.voxel_ops import Marching, RaySpans
from edge_se_sampler.occupancy.bricks import BrickGrid
from edge_se_sampler.sampling.registry import PIXEL_STRATEGIES

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="this machine has no CUDA device")


def train(trainer: Trainer) -> list[float]:
    return [trainer.train_iteration(step) for step in range(trainer.plan.num_steps or 0)]


def assert_renders_as_on_the_cpu(trainer: Trainer) -> None:
    model = trainer.pipeline.model
    assert next(model.parameters()).device.type == "cuda"
    rays = trainer.pipeline.datamanager.probe_rays(500, np.random.default_rng(0))
    found = render_rays(model, rays).cpu()
    on_cpu = {name: value.cpu() for name, value in vars(rays).items() if isinstance(value, Tensor)}
    metadata = {name: value.cpu() for name, value in rays.metadata.items()}
    expected = render_rays(copy.deepcopy(model).cpu(), replace(rays, **on_cpu, metadata=metadata))
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)
    assert float(expected.std()) > 1e-3


@pytest.mark.parametrize("method", ["vanilla-nerf", "edge-se-nerf", "info-nerf", "edge-se-info-nerf"])
def test_a_nerf_trained_on_a_gpu_renders_the_same_on_the_cpu(method: str) -> None:
    trainer = nerf_trainer(method, "cuda", num_coarse_samples=32, num_importance_samples=32)
    assert np.isfinite(train(trainer)).all()
    assert_renders_as_on_the_cpu(trainer)


def test_lean_nerf_learns_on_a_gpu_and_renders_the_same_on_the_cpu() -> None:
    trainer = tiny_trainer(lean_models.config_of(60), lean_models.VIEWS, device="cuda")
    losses = train(trainer)
    assert np.mean(losses[-5:]) < np.mean(losses[:5]) / 3
    assert trainer.pipeline.model.grid.level > 0
    assert_renders_as_on_the_cpu(trainer)


def test_samples_colors_and_gradients_of_the_cells_are_the_cpu_s() -> None:
    rng = np.random.default_rng(0)
    cells = torch.from_numpy(rng.random((20, 20, 20)) < 0.4)
    origins = torch.from_numpy(rng.normal(size=(200, 3))).float()
    origins = 10 + 30 * origins / origins.norm(dim=1, keepdim=True)
    directions = torch.nn.functional.normalize(torch.from_numpy(rng.uniform(4, 16, (200, 3))).float() - origins)
    begin, end = torch.full((200,), 10.0), torch.full((200,), 50.0)
    jitter, target = torch.from_numpy(rng.random(200)).float(), torch.from_numpy(rng.random((200, 3))).float()

    def gradients(device: str) -> list[Tensor]:
        grid = BrickGrid.from_cells(torch.zeros(3), 1.0, cells).to(device)
        values = np.random.default_rng(1)
        density = torch.from_numpy(values.normal(size=(grid.num_rows, 1)) * 2 - 1).float()
        features = torch.from_numpy(values.normal(size=(grid.num_rows, 16))).float()
        density, features = (value.to(device).requires_grad_() for value in (density, features))
        weights = ColorNetwork(np.random.default_rng(0), WIDTH_CARVED).to(device).weights()
        spans = RaySpans(*(value.to(device) for value in (origins, directions, begin, end)))
        marching = Marching(0.7, 1.0, 0.012, 0.006, 0.01, 0.4)
        rendered = voxel_ops.render(grid, density, features, weights, spans, jitter.to(device), marching)
        (rendered.rgb - target.to(device)).square().mean().backward()
        grads = [value.grad for value in (density, features)]
        return [rendered.rgb.detach().cpu(), *(grad.to_dense().cpu() for grad in grads if grad is not None)]

    found, expected = gradients("cuda"), gradients("cpu")
    assert len(found) == len(expected) == 3
    for one, other in zip(found, expected, strict=True):
        assert float(other.abs().max()) > 0
        assert float((one - other).abs().max()) <= 1e-3 * float(other.abs().max())


@pytest.mark.parametrize("strategy", [name for name, known in PIXEL_STRATEGIES.items() if "late" in known.phases])
def test_every_strategy_learns_from_errors_that_a_gpu_finds(strategy: str) -> None:
    config = override(lean_models.config_of(12), {f"{SAMPLER}.late": strategy})
    trainer = tiny_trainer(config, lean_models.VIEWS, device="cuda")
    assert np.isfinite(train(trainer)).all()


@pytest.mark.parametrize("method", ["edge-se-nerf", "lean-nerf"])
def test_commands_run_whole_on_a_gpu(method: str, scene: Path, tmp_path: Path, edge_se: Any) -> None:
    flags = [*SMALL[:4], "--machine.device-type", "cuda", "--steps-per-save", 3, "--data", scene]
    flags += SMALL[4:8] if method == "edge-se-nerf" else []
    answer = edge_se("train", method, *flags, "--output-dir", tmp_path)
    assert answer.code == 0, answer
    (run,) = tmp_path.glob(f"*/{method}/*")
    for command in (
        ("resume", run, "--max-num-iterations", 9),
        ("eval", run, "--output-path", tmp_path / "eval.json"),
        ("render", run, "--output-path", tmp_path / "turn.gif", "--num-frames", 3),
    ):
        answer = edge_se(*command)
        assert answer.code == 0, (command, answer)
    assert json.loads((tmp_path / "eval.json").read_text())["results"]["psnr"] > 3
