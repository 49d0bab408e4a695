"""SamplerHooks over any host's data manager: the sampler learns the step, the plan, the seed and the model's errors."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from batches import batch_of, following
from torch import Tensor

from edge_se_sampler.datamanager import SamplerHooks
from edge_se_sampler.pixel_sampler import EdgeSEPixelSampler
from edge_se_sampler.protocol import TrainingCallback, TrainingCallbackLocation
from edge_se_sampler.sampling_settings import EdgeSEPixelSamplerConfig


class Host:
    """A data manager with a callback of its own."""

    def get_training_callbacks(self, training_callback_attributes: Any) -> list[Any]:
        return ["the host's own"]


class Manager(SamplerHooks, Host):
    def __init__(self, sampler: Any) -> None:
        self.train_pixel_sampler = sampler
        self.train_ray_generator = lambda indices: indices * 10
        self.calls: list[tuple[Any, Tensor, dict[str, Tensor], bool]] = []

    def ray_errors(self, model: Any, ray_bundle: Any, batch: dict[str, Tensor]) -> Tensor:
        self.calls.append((model, ray_bundle, batch, torch.is_grad_enabled()))
        return batch["image"].float().sum(dim=1)

    def before_iteration(self, func: Any) -> TrainingCallback:
        return TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], func)


def attributes(planned: int = 1000, seed: int = 5) -> Any:
    config = SimpleNamespace(max_num_iterations=planned, machine=SimpleNamespace(seed=seed))
    return SimpleNamespace(pipeline=SimpleNamespace(model="the model"), trainer=SimpleNamespace(config=config))


def test_the_sampler_is_bound_to_plan_seed_and_model() -> None:
    sampler = EdgeSEPixelSampler(EdgeSEPixelSamplerConfig(), num_rays_per_batch=64)
    manager = Manager(sampler)
    assert sampler.strategy == "uniform"
    own, tell = manager.get_training_callbacks(attributes(planned=300))
    assert own == "the host's own"
    for step, strategy in [(0, "edge"), (29, "edge"), (30, "se")]:
        tell.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)  # not one of its places
        tell.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        assert sampler.strategy == strategy
    drawn = sampler.sample(batch_of())["indices"]
    assert {call[0] for call in manager.calls} == {"the model"}

    def errors(candidates: dict[str, Any]) -> Tensor:
        return candidates["image"].float().sum(dim=1)

    assert torch.equal(drawn, following(30, seed=5, planned=300, squared_error=errors).sample(batch_of())["indices"])


@pytest.mark.parametrize(("candidates", "rays", "chunks"), [(128, 64, [64, 64]), (130, 64, [64, 64, 2]), (5, 64, [5])])
def test_candidates_are_scored_a_training_batch_at_a_time(candidates: int, rays: int, chunks: list[int]) -> None:
    manager = Manager(EdgeSEPixelSampler(EdgeSEPixelSamplerConfig(), num_rays_per_batch=rays))
    pixels = {
        "indices": torch.arange(3 * candidates).reshape(-1, 3),
        "image": torch.rand(candidates, 3),
        "depth_image": torch.rand(candidates, 1),
    }
    errors = manager.squared_error(SimpleNamespace(model="the model"), pixels)
    torch.testing.assert_close(errors, pixels["image"].sum(dim=1))
    assert [len(batch["indices"]) for _, _, batch, _ in manager.calls] == chunks
    assert not any(grad for *_, grad in manager.calls)
    for _, rays_, batch, _ in manager.calls:
        assert torch.equal(rays_, batch["indices"] * 10)
    assert torch.equal(torch.cat([batch["image"] for _, _, batch, _ in manager.calls]), pixels["image"])


def test_another_sampler_is_left_alone() -> None:
    assert Manager(object()).get_training_callbacks(attributes()) == ["the host's own"]


def test_a_host_must_say_how_rays_are_compared() -> None:
    with pytest.raises(NotImplementedError):
        SamplerHooks().ray_errors(None, None, {})
    with pytest.raises(NotImplementedError):
        SamplerHooks().before_iteration(None)
