"""Data manager and model together: what a training step needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from edge_se_sampler.data.datamanager import VanillaDataManager
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.models.ray_model import RayModel
from edge_se_sampler.occupancy.scene_analysis import analyze_scene, live_pixels
from edge_se_sampler.sampling.random_streams import Stream, stream
from edge_se_sampler.sampling.settings import SamplingSettings


@dataclass(frozen=True)
class Pipeline:
    """What callbacks and scoring may reach; nerfstudio's pipelines have the same two."""

    datamanager: VanillaDataManager
    model: Any
    """A RayModel."""

    @classmethod
    def build(cls, config: TrainerConfig, views: Views, device: str) -> Pipeline:
        """Set up both for a planned config."""
        model_config = config.pipeline.model
        manager_config, has_masks = config.pipeline.datamanager, False
        model = build_model(config, device)
        if model.needs_cells:
            told = analyze_scene(views, model_config)
            model.settle(told.grid())
            has_masks = told.silhouettes > 0
            if manager_config.skip_empty_rays and has_masks:
                views = views.with_masks(live_pixels(views, told.hull))
        if isinstance(manager_config.pixel_sampler, SamplingSettings):
            manager_config = replace(manager_config, pixel_sampler=manager_config.pixel_sampler.resolve_auto(has_masks))
        background = (model_config.background_level,) * 3  # a random one has no edges of its own: white will do
        return cls(manager_config.setup(views=views, device=device, background_color=background), model)


def build_model(config: TrainerConfig, device: str) -> RayModel:
    """The model with its initial weights: a function of the seed and the size alone, whatever the method."""
    return config.pipeline.model.setup(rng=stream(config.machine.seed, 0, Stream.WEIGHTS)).to(device)
