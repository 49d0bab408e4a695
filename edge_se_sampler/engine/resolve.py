"""What a config leaves open, decided by the data: model size, rays, iterations, learning rate."""

from __future__ import annotations

from dataclasses import replace

from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.models.config import apply_preset, decide_size


def resolve_config(config: TrainerConfig, views: Views) -> TrainerConfig:
    """The config with nothing left open, its size decided by the training views; a resolved one stays as it is,
    whatever the views. InputError if a value is out of its range."""
    data, model = config.data and config.data.resolve(), decide_size(config.pipeline.model, views.images)
    config = replace(config, pipeline=replace(config.pipeline, model=model))
    preset = config.preset
    resolved = replace(
        config,
        data=data,
        experiment_name=config.experiment_name or (data.name if data else "unnamed"),
        max_num_iterations=preset.iterations,
        steps_per_eval_image=config.preview_interval,
        pipeline=replace(
            config.pipeline,
            datamanager=replace(config.pipeline.datamanager, train_num_rays_per_batch=preset.rays),
            model=apply_preset(model, preset.rays),
        ),
        optimizer=replace(config.optimizer, lr=preset.learning_rate),
    )
    resolved.check()
    return resolved
