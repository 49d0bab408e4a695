"""Data manager and model together: what a training step needs."""

from __future__ import annotations

from dataclasses import dataclass

from edge_se_sampler.data.blender import Views
from edge_se_sampler.data.datamanager import VanillaDataManager
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.nerf.model import NeRFModel
from edge_se_sampler.streams import Stream, stream

SHADES = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "random": (1.0, 1.0, 1.0)}
"""What a sampler takes to be behind the object; a random background has no edge of its own, and counts as white."""


@dataclass(frozen=True)
class Pipeline:
    """What callbacks and scoring may reach; nerfstudio's pipelines have the same two."""

    datamanager: VanillaDataManager
    model: NeRFModel

    @classmethod
    def build(cls, config: TrainerConfig, views: Views, device: str) -> Pipeline:
        """Set up both for a planned config."""
        model_config = config.pipeline.model
        datamanager = config.pipeline.datamanager.setup(
            views=views, device=device, background_color=SHADES[model_config.background_color]
        )
        return cls(datamanager, build_model(config, device))


def build_model(config: TrainerConfig, device: str) -> NeRFModel:
    """The model with its initial weights: a function of the seed and the size alone, whatever the method."""
    return config.pipeline.model.setup(rng=stream(config.machine.seed, 0, Stream.WEIGHTS)).to(device)
