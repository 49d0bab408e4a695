"""From folders and settings to a trainer that is ready, or to a trained model."""

from __future__ import annotations

import contextlib
import ctypes
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from edge_se_sampler.data.capture import Split
from edge_se_sampler.data.dataset import DataSettings, read_split
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.checkpoint import latest_checkpoint, load_checkpoint
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.pipeline import Pipeline, build_model, load_weights, resolve_depths, saved_grid
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.rendering import to_pictures
from edge_se_sampler.engine.run_folder import RunFolder, config_digest
from edge_se_sampler.engine.saved_state import check_parts
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.errors import InputError, check_value
from edge_se_sampler.models.config import LeanModelConfig, NeRFModelConfig, apply_preset, decide_size
from edge_se_sampler.models.lean import compile_ops
from edge_se_sampler.models.ray_model import RayModel
from edge_se_sampler.occupancy.bricks import BrickGrid
from edge_se_sampler.sampling.settings import SamplingSettings


def prepare(config: TrainerConfig, run: RunFolder | None = None, grid: BrickGrid | None = None) -> Trainer:
    """Read the data, resolve the config, and set up a trainer; InputError, and nothing written, if they are bad.
    A run that is continued comes with its folder, and with its checkpoint's occupancy grid if it has one."""
    views, device = read_train_views(config), choose_device(config.machine.device_type)
    held_out = _read_first_split(config, ("val", "test"))
    preview = None if held_out is None else to_pictures(held_out)[0]
    began = time.monotonic()
    config = resolve_config(config, views)
    setup_seconds = time.monotonic() - began
    if isinstance(config.pipeline.model, LeanModelConfig):
        compile_ops(device)
    else:
        disable_malloc_trimming()
    began = time.monotonic()
    pipeline = Pipeline.build(config, views, device, grid)
    run = run or RunFolder.create(config)
    setup_seconds += time.monotonic() - began
    return config.setup(run=run, pipeline=pipeline, preview=preview, setup_seconds=setup_seconds)


def resolve_config(config: TrainerConfig, views: Views) -> TrainerConfig:
    """The config with nothing left open, its size decided by the training views; a resolved one stays as it is,
    whatever the views. InputError if a value is out of its range."""
    config.check_plan()
    data, model = config.data and config.data.resolve(), decide_size(config.pipeline.model, views.images)
    model, _ = resolve_depths(views, model)
    config = replace(config, pipeline=replace(config.pipeline, model=model))
    preset, by_steps = config.preset, config.time_budget is None and config.segments is None
    resolved = replace(
        config,
        data=data,
        data_format=(views.data_format or "auto") if config.data_format == "auto" else config.data_format,
        eval_every=config.eval_every or views.eval_every,
        experiment_name=config.experiment_name or (data.name if data else "unnamed"),
        max_num_iterations=preset.iterations if by_steps else None,
        steps_per_eval_image=config.preview_interval if by_steps else config.steps_per_eval_image,
        pipeline=replace(
            config.pipeline,
            datamanager=replace(config.pipeline.datamanager, train_num_rays_per_batch=preset.rays),
            model=apply_preset(model, preset.rays),
        ),
        optimizer=replace(config.optimizer, lr=preset.learning_rate),
    )
    resolved.check()
    return resolved


def prepare_resume(run: RunFolder, config: TrainerConfig, max_seconds: float | None = None) -> Trainer:
    """Continue an interrupted run under its own settings, but for max_seconds; InputError for a bad run or data."""
    config = replace(config, max_seconds=max_seconds)
    config.check()
    state = load_checkpoint(latest_checkpoint(run.checkpoints), config_digest(config))
    check_parts(state, config.pipeline.model)
    trainer = prepare(config, run, saved_grid(state["model"]))
    trainer.resume(state)
    return trainer


def load_model(run: RunFolder, config: TrainerConfig) -> tuple[RayModel, Path]:
    """A run's model with the weights of its last checkpoint, and that checkpoint; InputError if it is bad."""
    checkpoint = latest_checkpoint(run.checkpoints)
    state = load_checkpoint(checkpoint, config_digest(config))
    check_parts(state, config.pipeline.model)
    model = build_model(config, choose_device(config.machine.device_type), saved_grid(state["model"]))
    load_weights(model, state["model"])
    return model, checkpoint


def read_test_views(config: TrainerConfig) -> Views:
    """The held-out views of a run: its test split, or val where there is no test; InputError if there is neither."""
    if config.data is None or not config.data.is_dir():
        raise InputError(f"{config.data}: no such folder, where this run's held-out views were")
    views = _read_first_split(config, ("test", "val"))
    if views is None:
        remedy = "transforms_test.json, transforms_val.json or another list of test images is needed"
        raise InputError(f"{config.data}: no held-out views; {remedy}")
    return views


def _read_first_split(config: TrainerConfig, splits: Sequence[Split]) -> Views | None:
    found = (_read_split(config, split) for split in splits)
    return next((views for views in found if views is not None), None)


def read_train_views(config: TrainerConfig) -> Views:
    """The training views of a config's data: all, or those of --num-views or --views. InputError for bad data."""
    if config.data is None:
        raise InputError("--data is missing: the folder to train on (edge-se scenes makes some)")
    views = _read_split(config, "train")
    assert views is not None
    selected = select_views(config, len(views.names))
    return views if selected is None else views.subset(selected)


def _read_split(config: TrainerConfig, split: Split) -> Views | None:
    assert config.data is not None
    settings = DataSettings(config.data_format, config.masks, config.eval_every, config.downscale)
    with Progress(0, "reading images") as progress:
        return read_split(config.data, split, settings, progress.update)


def select_views(config: TrainerConfig, count: int) -> list[int] | None:
    """Indices of the views to train on; None: all `count` of them. InputError if the flags do not fit. --num-views
    selects as InfoNeRF's public code does, numpy.random.RandomState(0).permutation(count)[:k]."""
    number, views = config.num_views, config.views
    if number is not None:
        if views is not None:
            raise InputError("--num-views and --views: give one of them")
        check_value("num-views", number, 1 <= number <= count, f"between 1 and {count}, the training views")
        return np.random.RandomState(0).permutation(count)[:number].tolist()
    if views is not None:
        valid = len(views) > 0 and len(set(views)) == len(views) and set(views) <= set(range(count))
        check_value("views", views, valid, f"at least one of the training views 0 to {count - 1}, each once")
    return None if views is None else list(views)


def describe_run(trainer: Trainer) -> str:
    """Where a run is written, its model, its length and its sampling."""
    config, manager = trainer.config, trainer.pipeline.datamanager.config
    model, sampler = config.pipeline.model, manager.pixel_sampler
    samples = "samples in occupied cells"
    if isinstance(model, NeRFModelConfig):
        samples = f"{model.num_coarse_samples} + {model.num_importance_samples} samples a ray"
    plan = f"{trainer.plan.num_steps} iterations" if config.time_budget is None else f"{config.budget_seconds:.0f} s"
    lines = [
        f"run      {trainer.run.path}",
        f"data     {trainer.pipeline.data_summary}",
        f"depths   {model.near:g} to {model.far:g}",
        f"model    {model.size}: {model.preset.depth} x {model.preset.width}, {samples}",
        f"plan     {plan} of {manager.train_num_rays_per_batch} rays a step",
    ]
    if isinstance(model, LeanModelConfig):
        grid = trainer.pipeline.model.grid
        lines.append(
            f"cells    {int(grid.occupied.sum()):,} of {float(grid.cell_size):.4f} a side, to be subdivided "
            f"{int(grid.max_level - grid.level)} times in at most {model.max_memory:.1f} GiB"
        )
    if isinstance(sampler, SamplingSettings):
        until = {
            "adaptive": "until the object is learned",
            "steps": f"for {sampler.early_steps} iterations",
            "fraction": f"for {100 * sampler.early_fraction:g} % of the training",
        }[sampler.schedule]
        early = "" if sampler.early == sampler.late else f"{sampler.early} {until}, then "
        lines.append(f"pixels   {early}{sampler.late}")
    return "\n".join(lines)


def choose_device(device_type: str) -> str:
    """The torch device of --machine.device-type; InputError for cuda where torch finds no GPU."""
    has_gpu = torch.cuda.is_available()
    if device_type == "cuda" and not has_gpu:
        raise InputError("--machine.device-type is cuda, but torch finds no GPU; use auto or cpu")
    return "cuda" if device_type != "cpu" and has_gpu else "cpu"


def disable_malloc_trimming() -> None:
    """Make glibc's malloc, if there is one, keep large freed blocks: page faults slow down training on a CPU."""
    m_trim_threshold, m_top_pad, m_mmap_max = -1, -2, -4
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL("libc.so.6")
        for option, value in ((m_mmap_max, 0), (m_trim_threshold, 2**31 - 1), (m_top_pad, 64 * 2**20)):
            libc.mallopt(option, value)
