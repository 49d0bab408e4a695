"""What a config leaves open, decided by the data: model size, rays, iterations, learning rate."""

from __future__ import annotations

from dataclasses import replace

from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.models.config import apply_preset, size_for


def resolve_config(config: TrainerConfig, views: Views) -> TrainerConfig:
    """The config with nothing left open; a resolved one stays as it is, whatever the views.

    Args:
        views: to train on; the longest side of their images decides the model's size.

    Raises:
        InputError: a value is out of its range.
    """
    model, data = config.pipeline.model, config.data and config.data.resolve()
    if model.size == "auto":
        size = size_for(max(max(image.shape[:2]) for image in views.images))
        config = replace(config, pipeline=replace(config.pipeline, model=replace(model, size=size)))
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
            model=apply_preset(config.pipeline.model, preset.rays),
        ),
        optimizer=replace(config.optimizer, lr=preset.learning_rate),
    )
    resolved.check()
    return resolved
