"""One training step: what it accumulates, and what it does with the optimizer."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from tiny import tiny_config, tiny_trainer, tiny_views

from edge_se_sampler.engine import optimizers
from edge_se_sampler.engine.config import OptimizerConfig, TrainerConfig
from edge_se_sampler.engine.optimizers import create_adam
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models import nerf as model_module
from edge_se_sampler.models.config import NERF_PRESETS, SizePreset
from edge_se_sampler.models.ray_model import ParameterGroup

VIEWS = tiny_views(3, 12, 12)
RAYS = 37


def trainer_of(method: str = "edge-se-nerf", steps: int = 20, optimizer: Any = None, **model: Any) -> Trainer:
    config: TrainerConfig = method_configs()[method]
    manager = replace(config.pipeline.datamanager, train_num_rays_per_batch=RAYS)
    pipeline = replace(config.pipeline, datamanager=manager, model=tiny_config(**model))
    optimizer = OptimizerConfig(lr=1e-2) if optimizer is None else optimizer
    return tiny_trainer(replace(config, pipeline=pipeline, max_num_iterations=steps, optimizer=optimizer), VIEWS)


def preset(learning_rate: float) -> SizePreset:
    return replace(NERF_PRESETS["tiny"], learning_rate=learning_rate)


def gradients(trainer: Trainer) -> torch.Tensor:
    return torch.cat([parameter.grad.flatten() for parameter in trainer.pipeline.model.parameters()])  # pyright: ignore


@pytest.mark.parametrize("rays_a_chunk", [1, 10, 36])
def test_gradients_accumulated_in_chunks_equal_those_of_one_batch(
    rays_a_chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """37 rays, so that the last chunk is smaller. The random numbers along the rays are fixed, because every chunk
    draws its own."""
    points = 2 * 6 + 5
    found = []
    for chunk in (rays_a_chunk, 1000):
        monkeypatch.setattr(model_module, "POINTS_PER_CHUNK", {"cpu": chunk * points + 3})
        trainer = trainer_of(density_activation="softplus")
        model = trainer.pipeline.model
        sizes = []
        forward = model.forward
        monkeypatch.setattr(model, "forward", lambda rays, go=forward, s=sizes: (s.append(len(rays)), go(rays))[1])
        spread = {count: torch.linspace(0.05, 0.95, count) for count in (5, 6)}
        monkeypatch.setattr(model, "uniform", lambda rows, columns, s=spread: s[columns].expand(rows, columns))
        loss = trainer.train_iteration(0)
        assert sizes == [chunk] * (RAYS // chunk) + ([RAYS % chunk] if RAYS % chunk else [])
        found.append((loss, gradients(trainer)))
    (loss, gradient), (whole_loss, whole) = found
    assert loss == pytest.approx(whole_loss, rel=1e-5)
    assert float(whole.abs().max()) > 1e-4
    torch.testing.assert_close(gradient, whole, rtol=1e-4, atol=1e-5 * float(whole.abs().max()))


def test_the_loss_is_the_mean_over_rays_and_weights() -> None:
    trainer = trainer_of("vanilla-nerf")
    batches = []
    manager = trainer.pipeline.datamanager
    next_train = manager.next_train

    def weighted(step: int) -> Any:
        rays, batch = next_train(step)
        batches.append((rays, batch | {"weight": torch.linspace(0, 3, RAYS)}))
        return batches[-1]

    manager.next_train = weighted
    model = trainer.pipeline.model
    before = {key: value.clone() for key, value in model.state_dict().items()}
    loss = trainer.train_iteration(0)
    model.load_state_dict(before)
    model.begin_step(0, model.random.initial_seed())
    rays, batch = batches[0]
    with torch.no_grad():
        outputs = model(rays)
    target = batch["image"][:, :3] * batch["image"][:, 3:] + 1 - batch["image"][:, 3:]
    error = sum(((outputs[f"rgb_{level}"] - target) ** 2).mean(dim=1) for level in ("coarse", "fine"))
    assert loss == pytest.approx(float((error * batch["weight"]).mean()), rel=1e-5)


def test_gradients_of_an_earlier_step_are_cleared() -> None:
    once, twice = trainer_of("vanilla-nerf"), trainer_of("vanilla-nerf")
    before = {key: value.clone() for key, value in twice.pipeline.model.state_dict().items()}
    twice.train_iteration(0)
    twice.pipeline.model.load_state_dict(before)
    once.train_iteration(1)
    twice.train_iteration(1)
    torch.testing.assert_close(gradients(once), gradients(twice), rtol=0, atol=0)


def test_the_learning_rate_decays_to_its_final_fraction() -> None:
    trainer = trainer_of(steps=20, optimizer=OptimizerConfig(lr=0.01, final_fraction=0.25))
    rates = [trainer.scheduler.get_last_lr()]
    for step in range(20):
        trainer.train_iteration(step)
        rates.append(trainer.scheduler.get_last_lr())
    assert rates[0] == [0.01]
    assert rates[10] == [pytest.approx(0.005)]
    assert rates[20] == [pytest.approx(0.0025)]


def test_groups_of_weights_have_their_own_learning_rates() -> None:
    network, features = torch.nn.Parameter(torch.ones(3)), torch.nn.Parameter(torch.ones(2))
    optimizer = create_adam(
        [ParameterGroup([network]), ParameterGroup([features], 6.0)], preset(0.01), OptimizerConfig()
    )
    assert [group["lr"] for group in optimizer.param_groups] == [0.01, pytest.approx(0.06)]


@pytest.mark.parametrize("method", ["vanilla-nerf", "edge-se-nerf"])
def test_steps_are_a_function_of_seed_and_step(method: str) -> None:
    """Whatever the global generators do, and whichever steps came before; early and late."""
    first = trainer_of(method)
    losses = [first.train_iteration(step) for step in range(6)]
    torch.manual_seed(123)
    again = trainer_of(method)
    assert [again.train_iteration(step) for step in range(6)] == losses
    strategies = [trainer_of(method).pipeline.datamanager.train_pixel_sampler.strategy]
    for step in (0, 1, 2, 19):
        first.train_iteration(step)
        strategies.append(first.pipeline.datamanager.train_pixel_sampler.strategy)
    late = "se" if method == "edge-se-nerf" else "uniform"
    early = "edge" if method == "edge-se-nerf" else "uniform"
    assert strategies == [early, early, early, late, late]


def test_training_lowers_the_loss() -> None:
    trainer = trainer_of("vanilla-nerf", steps=150, density_activation="softplus")
    losses = [trainer.train_iteration(step) for step in range(150)]
    assert sum(losses[-10:]) < 0.92 * sum(losses[:10])


def test_a_loss_that_is_not_finite_raises_before_the_weights_change() -> None:
    trainer = trainer_of("vanilla-nerf")
    model = trainer.pipeline.model
    with torch.no_grad():
        model.fine.color.bias.fill_(math.nan)
    before = model.coarse.density.weight.clone()
    with pytest.raises(FloatingPointError, match=r"step 3.*--optimizer\.lr"):
        trainer.train_iteration(3)
    assert torch.equal(model.coarse.density.weight, before)


@pytest.mark.parametrize("supported", [True, False])
def test_fused_adam_where_torch_supports_it(supported: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    adam = optimizers.RowAdam
    if supported and torch.__version__ < "2.4":
        pytest.skip("before 2.4, torch has no fused Adam on a CPU")

    def old(*arguments: Any, **settings: Any) -> torch.optim.Adam:
        if settings.get("fused") and not supported:
            adam(*arguments, **settings)  # it refuses last of all
            raise RuntimeError("`fused=True` requires all the params to be floating point Tensors of supported devices")
        return adam(*arguments, **settings)

    monkeypatch.setattr(optimizers, "RowAdam", old)
    weight = torch.nn.Parameter(torch.ones(3))
    optimizer = create_adam([ParameterGroup([weight])], preset(1e-3), OptimizerConfig(eps=1e-9, fused=True))
    assert bool(optimizer.param_groups[0]["fused"]) == supported
    assert optimizer.defaults["eps"] == 1e-9
    assert not create_adam([ParameterGroup([weight])], preset(1e-3), OptimizerConfig()).defaults["fused"]
