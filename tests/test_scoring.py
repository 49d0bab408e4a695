"""Candidates scored by the model of any host; and the sampler bound to a run by our own data manager."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from batches import batch_of, following
from tiny import tiny_model, tiny_rays, tiny_views
from torch import Tensor

from edge_se_sampler.data.config import VanillaDataManagerConfig
from edge_se_sampler.engine.plan import Plan
from edge_se_sampler.protocol import PixelSampler, TrainingCallbackLocation
from edge_se_sampler.sampling.pixel_sampler import EdgeSEPixelSampler, build_scorer
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig


@pytest.mark.parametrize(("candidates", "rays", "chunks"), [(128, 64, [64, 64]), (130, 64, [64, 64, 2]), (5, 64, [5])])
def test_candidates_are_scored_a_training_batch_at_a_time(candidates: int, rays: int, chunks: list[int]) -> None:
    calls: list[tuple[Any, Tensor, dict[str, Tensor], bool]] = []

    def ray_errors(model: Any, ray_bundle: Any, batch: dict[str, Tensor]) -> Tensor:
        calls.append((model, ray_bundle, batch, torch.is_grad_enabled()))
        return batch["image"].sum(dim=1)

    sampler = EdgeSEPixelSampler(EdgeSEPixelSamplerConfig(), num_rays_per_batch=1)
    score = build_scorer(sampler, SimpleNamespace(model="the model"), lambda indices: indices * 10, ray_errors)
    sampler.set_num_rays_per_batch(rays)  # hosts change it while they train
    pixels = {
        "indices": torch.arange(3 * candidates).reshape(-1, 3),
        "image": torch.rand(candidates, 3),
        "depth_image": torch.rand(candidates, 1),
    }
    torch.testing.assert_close(score(pixels), pixels["image"].sum(dim=1))
    assert [len(batch["indices"]) for _, _, batch, _ in calls] == chunks
    assert all(model == "the model" and not grad for model, _, _, grad in calls)
    for _, rays_, batch, _ in calls:
        assert torch.equal(rays_, batch["indices"] * 10)
    assert torch.equal(torch.cat([batch["image"] for _, _, batch, _ in calls]), pixels["image"])


def attributes(planned: int, seed: int) -> Any:
    trainer = SimpleNamespace(
        first_progress=Plan(planned).progress, config=SimpleNamespace(machine=SimpleNamespace(seed=seed))
    )
    return SimpleNamespace(pipeline=SimpleNamespace(model=None), trainer=trainer)


def test_the_sampler_is_bound_to_the_plan_and_the_seed() -> None:
    config = VanillaDataManagerConfig(train_num_rays_per_batch=64, pixel_sampler=EdgeSEPixelSamplerConfig())
    manager = config.setup(views=tiny_views(3, 9, 14))
    sampler = manager.train_pixel_sampler
    assert sampler.strategy == "uniform"
    (tell,) = manager.get_training_callbacks(attributes(planned=300, seed=5))
    for step, strategy in [(0, "edge"), (29, "edge"), (30, "se")]:
        tell.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)  # not one of its places
        tell.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        assert sampler.strategy == strategy
    tell.run_callback_at_location(7, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
    expected = following(7, seed=5, planned=300).sample(manager.image_batch)["indices"]
    assert torch.equal(sampler.sample(manager.image_batch)["indices"], expected)


def test_another_sampler_is_left_alone() -> None:
    class Other(PixelSampler):
        def sample(self, image_batch: dict[str, Any]) -> dict[str, Any]:
            return batch_of()

    config = EdgeSEPixelSamplerConfig()
    manager = VanillaDataManagerConfig(train_num_rays_per_batch=64, pixel_sampler=config).setup(
        views=tiny_views(3, 9, 14)
    )
    manager.train_pixel_sampler = Other(config)
    assert manager.get_training_callbacks(attributes(planned=300, seed=5)) == []


@pytest.mark.parametrize("training", [True, False])
def test_the_coarse_errors_are_those_of_the_whole_rendering(training: bool) -> None:
    model = tiny_model().train(training)
    rays, image = tiny_rays(9), torch.rand((9, 4), dtype=torch.float64)
    model.begin_step(0, 3)
    whole = model.squared_error(model(rays), image, "coarse")
    model.begin_step(0, 3)
    torch.testing.assert_close(model.coarse_squared_error(rays, image), whole, rtol=0, atol=0)


def test_coarse_scoring_never_asks_the_fine_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def manager_of(how: Any) -> Any:
        config = EdgeSEPixelSamplerConfig(error_source=how)
        return VanillaDataManagerConfig(train_num_rays_per_batch=64, pixel_sampler=config).setup(
            views=tiny_views(3, 9, 14)
        )

    model = tiny_model().float()
    batch = {"image": torch.rand((9, 4))}
    rays = tiny_rays(9, dtype=torch.float32)
    exact = manager_of("fine").ray_errors(model, rays, batch)
    assert not torch.equal(exact, manager_of("coarse").ray_errors(model, rays, batch))

    def asked(*_: Any) -> None:
        raise AssertionError("the fine network")

    monkeypatch.setattr(model.fine, "forward", asked)
    assert manager_of("coarse").ray_errors(model, rays, batch).shape == (9,)
    with pytest.raises(AssertionError, match="the fine network"):
        manager_of("fine").ray_errors(model, rays, batch)
