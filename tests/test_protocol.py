"""The minimal protocol: configs that build what they configure, and callbacks that know their place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import pytest

from edge_se_sampler.protocol import (
    InstantiateConfig,
    PixelSampler,
    PixelSamplerConfig,
    TrainingCallback,
    TrainingCallbackLocation,
)
from edge_se_sampler.sampling.pixel_sampler import EdgeSEPixelSampler
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig


class Foreign(PixelSampler):
    def sample(self, image_batch: dict[str, Any]) -> dict[str, Any]:
        return {}


@dataclass
class ForeignConfig(PixelSamplerConfig):
    _target: ClassVar[type | str] = Foreign


def test_setup_builds_the_target_from_the_config_and_the_arguments() -> None:
    config = ForeignConfig(num_rays_per_batch=9)
    sampler = config.setup(fisheye_crop_radius=None, is_equirectangular=False)
    assert type(sampler) is Foreign
    assert sampler.config is config
    assert sampler.kwargs == {"fisheye_crop_radius": None, "is_equirectangular": False}
    assert sampler.num_rays_per_batch == 9


def test_setup_imports_a_target_given_as_a_string() -> None:
    assert EdgeSEPixelSamplerConfig._target == "edge_se_sampler.sampling.pixel_sampler:EdgeSEPixelSampler"
    assert type(EdgeSEPixelSamplerConfig().setup()) is EdgeSEPixelSampler


def test_a_named_target_that_does_not_exist() -> None:
    class Lost(InstantiateConfig):
        _target: ClassVar[type | str] = "edge_se_sampler.protocol:Nothing"

    with pytest.raises(AttributeError, match="Nothing"):
        Lost().setup()


@pytest.mark.parametrize("config", [ForeignConfig(), EdgeSEPixelSamplerConfig()])
def test_the_hosts_arguments_override_the_config(config: PixelSamplerConfig) -> None:
    sampler = config.setup(num_rays_per_batch=33, keep_full_image=True)
    assert sampler.num_rays_per_batch == sampler.config.num_rays_per_batch == 33
    assert sampler.config.keep_full_image
    sampler.set_num_rays_per_batch(4)
    assert sampler.num_rays_per_batch == 4


def test_sample_is_abstract() -> None:
    with pytest.raises(TypeError, match="sample"):
        PixelSampler(PixelSamplerConfig())  # pyright: ignore[reportAbstractUsage]


@pytest.mark.parametrize("locations", [[], list(TrainingCallbackLocation)[:1], list(TrainingCallbackLocation)])
def test_a_callback_runs_at_its_locations_only(locations: list[TrainingCallbackLocation]) -> None:
    ran: list[tuple[int, TrainingCallbackLocation]] = []
    for at in TrainingCallbackLocation:
        callback = TrainingCallback(locations, lambda step, at=at: ran.append((step, at)))
        callback.run_callback_at_location(7, at)
    assert ran == [(7, at) for at in locations]
