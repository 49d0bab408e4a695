"""What a config leaves open, decided by the data: model size, rays, iterations, learning rate."""

from __future__ import annotations

from dataclasses import replace

from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.errors import InputError
from edge_se_sampler.models.config import (
    InfoNeRFModelConfig,
    LeanModelConfig,
    NeRFModelConfig,
    apply_preset,
    check_fineness,
    preset_of,
    size_for,
)


def resolve_config(config: TrainerConfig, views: Views) -> TrainerConfig:
    """The config with nothing left open.

    Raises:
        InputError: a value out of its range.
    """
    side = max(max(image.shape[:2]) for image in views.images)
    model = config.pipeline.model
    size = size_for(side) if model.size == "auto" else model.size
    preset = preset_of(model, size)
    manager = config.pipeline.datamanager
    rays = preset.rays if manager.train_num_rays_per_batch is None else manager.train_num_rays_per_batch
    iterations = preset.iterations if config.max_num_iterations is None else config.max_num_iterations
    preview = config.steps_per_eval_image
    plan = replace(
        config,
        data=config.data.resolve() if config.data else None,
        experiment_name=config.experiment_name or (config.data.resolve().name if config.data else "unnamed"),
        max_num_iterations=iterations,
        steps_per_eval_image=max(1, iterations // 10) if preview is None else preview,
        pipeline=replace(
            config.pipeline,
            datamanager=replace(manager, train_num_rays_per_batch=rays),
            model=apply_preset(model, size, rays),
        ),
        optimizer=replace(
            config.optimizer, lr=preset.learning_rate if config.optimizer.lr is None else config.optimizer.lr
        ),
    )
    _check(plan)
    return plan


def _check(plan: TrainerConfig) -> None:
    model = plan.pipeline.model
    at_least_one = {
        "max-num-iterations": plan.max_num_iterations,
        "steps-per-save": plan.steps_per_save,
        "steps-per-eval-image": plan.steps_per_eval_image,
        "steps-per-log": plan.steps_per_log,
        "pipeline.datamanager.train-num-rays-per-batch": plan.pipeline.datamanager.train_num_rays_per_batch,
        "pipeline.model.depth": model.depth,
    }
    if isinstance(model, NeRFModelConfig):
        at_least_one["pipeline.model.num-importance-samples"] = model.num_importance_samples
    for flag, value in at_least_one.items():
        if value is None or value < 1:
            raise InputError(f"--{flag} is {value}: must be at least 1")
    if (
        plan.pipeline.datamanager.skip_empty_rays
        and isinstance(model, NeRFModelConfig)
        and not model.empty_space_skipping
    ):
        raise InputError(
            "--pipeline.datamanager.skip-empty-rays has no effect here; add --pipeline.model.empty-space-skipping True"
        )
    if model.width is None or model.width < 2:
        raise InputError(
            f"--pipeline.model.width is {model.width}: must be at least 2 (the direction's layer has half)"
        )
    if isinstance(model, NeRFModelConfig):
        _check_nerf(model)
    if isinstance(model, LeanModelConfig):
        _check_lean(plan, model)
    for flag, frequencies in (("position", model.position_frequencies), ("direction", model.direction_frequencies)):
        if frequencies is None or not 0 <= frequencies <= 24:
            raise InputError(f"--pipeline.model.{flag}-frequencies is {frequencies}: must be between 0 and 24")
    check_fineness(model, "pipeline.model.")
    if isinstance(model, InfoNeRFModelConfig):
        _check_info(model)
    check_seconds(plan.max_seconds)
    if not 0 < (plan.optimizer.lr or 0) < float("inf"):
        raise InputError(f"--optimizer.lr is {plan.optimizer.lr}: must be above 0")
    if not 0 < plan.optimizer.final_fraction <= 1:
        raise InputError(f"--optimizer.final-fraction is {plan.optimizer.final_fraction}: must be in (0, 1]")
    if not 0 <= plan.optimizer.eps < float("inf"):
        raise InputError(f"--optimizer.eps is {plan.optimizer.eps}: must be at least 0")
    for name in (plan.method_name, plan.experiment_name):
        if name in (None, "", ".", "..") or "/" in str(name) or "\0" in str(name):
            raise InputError(f"{name!r} cannot name a folder: give --experiment-name a plain name")


def check_seconds(seconds: float | None, flag: str = "--max-seconds") -> None:
    """Raises InputError for a time that is none; None: no limit."""
    if seconds is not None and not 0 < seconds < float("inf"):
        raise InputError(f"{flag} is {seconds}: must be above 0, and finite")


def _check_nerf(model: NeRFModelConfig) -> None:
    if (model.num_coarse_samples or 0) < 3:
        raise InputError(f"--pipeline.model.num-coarse-samples is {model.num_coarse_samples}: must be at least 3")
    if not 0 <= model.density_noise < float("inf"):
        raise InputError(f"--pipeline.model.density-noise is {model.density_noise}: must be at least 0")


def _check_lean(plan: TrainerConfig, model: LeanModelConfig) -> None:
    if not 0 <= model.feature_dim <= 64:
        raise InputError(f"--pipeline.model.feature-dim is {model.feature_dim}: must be between 0 and 64")
    if not 0 < model.feature_lr_scale < float("inf"):
        raise InputError(f"--pipeline.model.feature-lr-scale is {model.feature_lr_scale}: must be above 0")
    if plan.reinit_dead:
        raise InputError("--reinit-dead: this model's density is never 0, it cannot die; leave the flag out")
    if getattr(plan.pipeline.datamanager.pixel_sampler, "error_source", "fine") == "coarse":
        raise InputError(
            "--pipeline.datamanager.pixel-sampler.error-source is coarse: this model has no coarse network"
        )


def _check_info(model: InfoNeRFModelConfig) -> None:
    at_least_zero = {
        "num-unseen-rays": model.num_unseen_rays or 0,
        "entropy-weight": model.entropy_weight,
        "gain-weight": model.gain_weight,
        "gain-degrees": model.gain_degrees,
        "gain-rate": model.gain_rate,
    }
    for flag, value in at_least_zero.items():
        if not 0 <= value < float("inf"):
            raise InputError(f"--pipeline.model.{flag} is {value}: must be at least 0")
    if not 0 <= model.entropy_threshold < 1:
        raise InputError(f"--pipeline.model.entropy-threshold is {model.entropy_threshold}: must be in [0, 1)")
    if model.gain_steps < 1:
        raise InputError(f"--pipeline.model.gain-steps is {model.gain_steps}: must be at least 1")
