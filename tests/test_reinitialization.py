"""Dead networks: how they are detected, and how they are reinitialized."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny import resume_trainer, tiny_config, tiny_rays, tiny_trainer, tiny_views

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.engine.config import override
from edge_se_sampler.engine.reinitialization import PATIENCE, DeadNetworkReset, dead_networks
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.methods import STRATEGIES, method_configs
from edge_se_sampler.models.nerf import NeRFModel

VIEWS = tiny_views(3, 12, 12)


def trainer_of(folder: Path, method: str = "vanilla-nerf", *, reinit_dead: bool = True, seed: int = 0) -> Trainer:
    config = override(
        method_configs()[method],
        {
            "pipeline.datamanager.train_num_rays_per_batch": 16,
            "pipeline.model": tiny_config(width=16, depth=2),
            "max_num_iterations": 400,
            "machine.seed": seed,
            "reinit_dead": reinit_dead,
        },
    )
    return tiny_trainer(config, VIEWS, folder)


def reset_of(trainer: Trainer) -> DeadNetworkReset:
    assert trainer.dead_network_reset is not None
    return trainer.dead_network_reset


def kill(model: NeRFModel, *levels: str) -> None:
    with torch.no_grad():
        for level in levels:
            getattr(model, level).density.bias.fill_(-10)


def weights(model: NeRFModel, level: str) -> torch.Tensor:
    return torch.cat([weight.detach().flatten() for weight in getattr(model, level).parameters()])


@pytest.mark.parametrize("dead", [(), ("coarse",), ("fine",), ("coarse", "fine")])
def test_dead_networks_are_detected(dead: tuple[str, ...], tmp_path: Path) -> None:
    model = trainer_of(tmp_path).pipeline.model
    kill(model, *dead)
    rays = RayBundle(**{k: v for k, v in vars(tiny_rays(30, dtype=torch.float32)).items()})
    assert dead_networks(model, [rays[:10], rays[10:]]) == list(dead)


@pytest.mark.parametrize("method", STRATEGIES)
def test_networks_dead_at_the_start_are_reinitialized_under_every_strategy(
    method: str, tmp_path: Path, capsys: Any
) -> None:
    trainer = trainer_of(tmp_path, method)
    kill(trainer.pipeline.model, "coarse", "fine")
    for step in range(PATIENCE + 20):
        trainer.train_iteration(step)
    assert reset_of(trainer).used_sub_seeds >= 2
    assert dead_networks(trainer.pipeline.model, [reset_of(trainer).probe]) == []
    assert "the coarse network is dead; reinitialized from sub-seed 1" in capsys.readouterr().err
    logged = [line for line in trainer.run.metrics() if "reinitialized" in line]
    assert [(line["step"], line["reinitialized"], line["sub_seed"]) for line in logged[:2]] == [
        (PATIENCE - 1, "coarse", 1),
        (PATIENCE - 1, "fine", 2),
    ]


@pytest.mark.parametrize("dead", NeRFModel.networks)
def test_only_the_dead_network_is_reinitialized(dead: str, tmp_path: Path) -> None:
    trainer = trainer_of(tmp_path)
    model, (other,) = trainer.pipeline.model, [level for level in NeRFModel.networks if level != dead]
    kill(model, dead)
    for step in range(PATIENCE - 1):
        trainer.train_iteration(step)
    before = {level: weights(model, level) for level in NeRFModel.networks}
    trainer.train_iteration(PATIENCE - 1)
    moved = {level: float((weights(model, level) - before[level]).abs().max()) for level in NeRFModel.networks}
    assert moved[dead] > 0.3  # new weights
    assert 0 < moved[other] < 0.05  # a step of training
    assert reset_of(trainer).used_sub_seeds == 1


def test_without_reinit_dead_a_dead_network_stays_dead(tmp_path: Path) -> None:
    """The negative control, and what the faithful methods do."""
    trainer = trainer_of(tmp_path, "edge-se-nerf", reinit_dead=False)
    kill(trainer.pipeline.model, "coarse", "fine")
    before = weights(trainer.pipeline.model, "fine")
    for step in range(3 * PATIENCE):
        trainer.train_iteration(step)
    assert trainer.dead_network_reset is None
    torch.testing.assert_close(weights(trainer.pipeline.model, "fine"), before, rtol=0, atol=0)


def test_a_network_with_density_is_left_alone(tmp_path: Path) -> None:
    """Batches without any gradient do not make it dead: the probe rays still meet density."""
    trainer, plain = trainer_of(tmp_path), trainer_of(tmp_path, reinit_dead=False)
    for step in range(2 * PATIENCE):
        assert trainer.train_iteration(step) == plain.train_iteration(step)
    reset = reset_of(trainer)
    for _ in range(3 * PATIENCE):
        trainer.optimizer.zero_grad(set_to_none=False)
        assert reset.after_backward() == {}
    assert reset.used_sub_seeds == 0


def test_a_run_with_reinitialization_is_a_function_of_its_seed(tmp_path: Path) -> None:
    def trained(seed: int) -> list[float]:
        trainer = trainer_of(tmp_path, seed=seed)
        kill(trainer.pipeline.model, "coarse", "fine")
        return [trainer.train_iteration(step) for step in range(PATIENCE + 10)]

    assert trained(0) == trained(0)
    assert trained(0) != trained(1)


def test_a_second_reinitialization_draws_other_weights(tmp_path: Path) -> None:
    trainer = trainer_of(tmp_path)
    model, found = trainer.pipeline.model, []
    for start in (0, PATIENCE):
        kill(model, "fine")
        for step in range(start, start + PATIENCE):
            trainer.train_iteration(step)
        found.append(weights(model, "fine"))
    assert reset_of(trainer).used_sub_seeds == 2
    assert float((found[0] - found[1]).abs().max()) > 0.3


@pytest.mark.parametrize("saved_after", [PATIENCE - 3, PATIENCE + 2])
def test_a_checkpoint_keeps_the_count_of_steps_and_of_sub_seeds(saved_after: int, tmp_path: Path) -> None:
    trainer = trainer_of(tmp_path)
    kill(trainer.pipeline.model, "coarse", "fine")
    for step in range(saved_after):
        trainer.train_iteration(step)
        trainer.next_step = step + 1
    trainer.save()
    went_on = [trainer.train_iteration(step) for step in range(saved_after, saved_after + 12)]

    resumed = resume_trainer(trainer, VIEWS)
    assert resumed.next_step == saved_after
    assert [resumed.train_iteration(step) for step in range(saved_after, saved_after + 12)] == went_on
    assert reset_of(resumed).used_sub_seeds == reset_of(trainer).used_sub_seeds >= 2


def test_the_probe_rays_cover_every_image(tmp_path: Path) -> None:
    trainer = trainer_of(tmp_path)
    numbers = reset_of(trainer).probe.camera_indices[:, 0]
    assert np.unique(numbers.numpy()).tolist() == [0, 1, 2]
    again = reset_of(trainer_of(tmp_path))
    torch.testing.assert_close(again.probe.origins, reset_of(trainer).probe.origins)
