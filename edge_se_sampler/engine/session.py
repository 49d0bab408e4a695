"""From folders and settings to a trainer that is ready, or to a trained model."""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edge_se_sampler import ranks
from edge_se_sampler.data.capture import Split
from edge_se_sampler.data.dataset import DataSettings, read_split
from edge_se_sampler.data.frames import Select, select_all
from edge_se_sampler.data.memory import ModelMemory
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.checkpoint import load_latest
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.files import make_folder
from edge_se_sampler.engine.pipeline import Pipeline, build_model, load_weights, resolve_depths, saved_grid
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.rendering import Picture, to_pictures
from edge_se_sampler.engine.run_folder import RunFolder, config_digest
from edge_se_sampler.engine.saved_state import check_parts
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.errors import InputError, check_value
from edge_se_sampler.models.compilation import compile_ops
from edge_se_sampler.models.config import LeanModelConfig, NeRFModelConfig, apply_preset, decide_size
from edge_se_sampler.models.ensemble import Ensemble
from edge_se_sampler.models.ray_model import RayModel
from edge_se_sampler.occupancy.bricks import BrickGrid
from edge_se_sampler.sampling.settings import SamplingSettings


def prepare(
    config: TrainerConfig, run: RunFolder | None = None, grid: BrickGrid | None = None, *, changed_data: bool = False
) -> Trainer:
    """Read the data, resolve the config, and set up a trainer; InputError, and nothing written, if they are bad.
    A run that is continued comes with its folder, and with its checkpoint's occupancy grid if it has one, which may be
    of other data if that is accepted."""
    if run is None and config.time_budget is not None and config.segments is not None:
        raise InputError("--time-budget and --segments: give one of them; segments repeat what a budget came out as")
    device = choose_device(config.machine.device_type, of_run=run is not None)
    ranks.join(device)
    views = read_train_views(config)
    preview = _read_preview(config)
    check_value(
        "patience", config.patience, config.patience is None or preview is not None, "left out: no view is held out"
    )
    began = time.monotonic()
    config = resolve_config(config, views)
    setup_seconds = time.monotonic() - began
    if isinstance(config.pipeline.model, LeanModelConfig):
        compile_ops(device)
    else:
        disable_malloc_trimming()
    began = time.monotonic()
    pipeline = Pipeline.build(config, views, device, grid, changed_data=changed_data)
    setup_seconds += time.monotonic() - began
    if preview is not None and ranks.is_main():
        _compare_alpha(config, views, preview)
    setup = {"pipeline": pipeline, "preview": preview, "setup_seconds": setup_seconds}
    if run is not None:
        return config.setup(run=run, **setup)
    run = ranks.share(lambda: RunFolder.create(config))
    try:
        return config.setup(run=run, **setup)
    except BaseException:  # Ctrl-C, for one
        if ranks.is_main():
            shutil.rmtree(run.path, ignore_errors=True)
        raise


def resolve_config(config: TrainerConfig, views: Views) -> TrainerConfig:
    """The config with nothing left open, its size decided by the training views; a resolved one stays as it is,
    whatever the views. InputError if a value is out of its range."""
    config.check_plan()
    data, model = config.data and config.data.resolve(), decide_size(config.pipeline.model, views.longest_side)
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


def load_state(run: RunFolder, config: TrainerConfig) -> tuple[Path, dict[str, Any]]:
    """A run's last checkpoint, and what it holds; InputError if it is bad."""
    checkpoint, state = load_latest(run.checkpoints, config_digest(config))
    check_parts(state, config.pipeline.model)
    return checkpoint, state


def prepare_resume(
    run: RunFolder,
    config: TrainerConfig,
    max_seconds: float | None = None,
    max_num_iterations: int | None = None,
    changed_data: bool = False,
) -> Trainer:
    """Continue a run under its own settings, but for max_seconds, and max_num_iterations if that is given: what a
    finished one then goes on with is its optimizer's state. InputError for a bad run or data, and for training images
    that have changed, unless that is accepted; what the sampler remembers of them is then forgotten."""
    _, state = load_state(run, config)
    if max_num_iterations is not None:
        config = _extend(config, state, max_num_iterations)
    replace(config, max_seconds=max_seconds).check()
    check_run_data(config)
    if ranks.is_main():
        make_folder(run.path / "previews", "the run's")  # which git, for one, leaves out when it is empty
    trainer = prepare(config, run, saved_grid(state["model"]), changed_data=changed_data)
    trainer.max_seconds = max_seconds
    trainer.resume(state, changed_data)
    if ranks.is_main():
        run.write_config(config)
    return trainer


def _extend(config: TrainerConfig, state: dict[str, Any], num_iterations: int) -> TrainerConfig:
    """The config of a run that is to have so many iterations in all; InputError if it cannot have them."""
    flag, done = "max-num-iterations", state["step"] + 1
    check_value(flag, num_iterations, num_iterations > done, f"above {done}, the iterations that are done")
    check_value(
        flag,
        num_iterations,
        config.max_num_iterations is not None,
        "left out: this run has --time-budget or --segments",
    )
    check_value(flag, num_iterations, state["optimizer"] is not None, "left out: this run ended without its optimizer")
    return replace(config, new_num_iterations=num_iterations)


def load_model(run: RunFolder, config: TrainerConfig) -> tuple[RayModel, Path]:
    """A run's model with the weights of its last checkpoint, and that checkpoint; InputError if it is bad."""
    checkpoint, state = load_state(run, config)
    model = build_model(config, choose_device(config.machine.device_type, of_run=True), saved_grid(state["model"]))
    load_weights(model, state["model"])
    return model, checkpoint


def load_ensemble(runs: Sequence[tuple[RunFolder, TrainerConfig]]) -> tuple[RayModel, list[Path]]:
    """The model of one run, or an ensemble of the models of several, and the last checkpoint of each run; InputError if
    a run is bad or named twice, or the runs' data, masks, held-out views or background colors differ."""
    run, config = runs[0]
    if len({path.path.resolve() for path, _ in runs}) < len(runs):
        raise InputError(f"--average-with: one of the runs is named twice; name others than {run.path}")
    for other, found in runs[1:]:
        for name, value, expected in (
            ("data", found.data, config.data),
            ("data_format", found.data_format, config.data_format),
            ("masks", found.masks, config.masks),
            ("eval_every", found.eval_every, config.eval_every),
            ("background_color", found.pipeline.model.background_color, config.pipeline.model.background_color),
        ):
            if value != expected:
                raise InputError(
                    f"{other.path}: {name} is {value}, but {expected} in {run.path}; average runs that agree in it"
                )
    models, checkpoints = zip(*(load_model(*each) for each in runs), strict=True)
    # each run says on which device
    members = [model.to(models[0].device) for model in models]
    return members[0] if len(members) == 1 else Ensemble(members), list(checkpoints)


def read_test_views(config: TrainerConfig) -> Views:
    """The held-out views of a run: its test split, or val where there is no test; InputError if there is neither."""
    check_run_data(config)
    views = _read_first_split(config, ("test", "val"))
    if views is None:
        remedy = "transforms_test.json, transforms_val.json or another list of test images is needed"
        raise InputError(f"{config.data}: no held-out views; {remedy}")
    return views


def check_run_data(config: TrainerConfig) -> None:
    """InputError if the folder of a run's data is not where it was."""
    if config.data is None or not config.data.is_dir():
        remedy = 'put it back, or write where it is as "data" into its config.json, without its "checksum"'
        raise InputError(f"{config.data}: no such folder, where this run's data was; {remedy}")


def _read_first_split(config: TrainerConfig, splits: Sequence[Split]) -> Views | None:
    found = (_read_split(config, split) for split in splits)
    return next((views for views in found if views is not None), None)


def _read_preview(config: TrainerConfig) -> Picture | None:
    """The first held-out view of which some pixels are known, and no others are read but to find it; None: no view is
    held out."""
    for split, select in itertools.product(("val", "test"), (_select_first, select_all)):
        views = _read_split(config, split, select=select)
        if views is not None:
            return to_pictures(views)[0]
    return None


def _select_first(_: int) -> list[int]:
    return [0]


def _compare_alpha(config: TrainerConfig, views: Views, preview: Picture) -> None:
    """Says so if the training views are transparent in part, and what is held out has no alpha, or the other way
    round."""
    trained, held_out = ("training", views.images), ("held-out", (preview.stored,))
    for (some, images), (others, opaque) in ((trained, held_out), (held_out, trained)):
        if any(map(_is_transparent, images)) and all(image.shape[2] == 3 for image in opaque):
            problem = f"{config.data}: the {some} views have alpha, and the {others} ones have none"
            print(f"{problem}: what is behind the object differs, and counts as an error", file=sys.stderr)


def _is_transparent(image: np.ndarray) -> bool:
    """Whether some of an image is."""
    return image.shape[2] == 4 and bool((image[..., 3] < 255).any())


def read_train_views(config: TrainerConfig, trains: bool = True) -> Views:
    """The training views of a config's data: all, or those of --num-views or --views. InputError for bad data, and
    where memory is too little for them and, if something trains on them, for what that takes."""
    if not trains:
        check_run_data(config)
    if config.data is None:
        raise InputError("--data is missing: the folder to train on (edge-se scenes makes some)")
    memory = partial(_training_memory, config) if trains else None
    views = _read_split(config, "train", memory, partial(select_views, config))
    assert views is not None
    return views


def _training_memory(config: TrainerConfig, has_alpha: bool, longest: int) -> int:
    """Bytes that training takes beside images whose longest side has so many pixels; 0: it takes a GPU's own."""
    if choose_device(config.machine.device_type, of_run=True) == "cuda":
        return 0
    model = decide_size(config.pipeline.model, longest)
    rays = replace(config, pipeline=replace(config.pipeline, model=model)).preset.rays
    return model.training_memory(has_alpha, rays)


def _read_split(
    config: TrainerConfig, split: Split, model_memory: ModelMemory | None = None, select: Select = select_all
) -> Views | None:
    assert config.data is not None
    settings = DataSettings(config.data_format, config.masks, config.eval_every, config.downscale, model_memory, select)
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
    if isinstance(model, NeRFModelConfig):
        width = model.preset.width
        samples = f"{model.num_coarse_samples} + {model.num_importance_samples} samples a ray"
    else:
        width, samples = trainer.pipeline.model.fine.hidden.shape[1], "samples in occupied cells"
    plan = f"{trainer.plan.num_steps} iterations" if config.time_budget is None else f"{config.budget_seconds:.0f} s"
    lines = [
        f"run      {trainer.run.path}",
        f"data     {trainer.pipeline.data_summary}",
        *[f"memory   {trainer.pipeline.memory_summary}"] * bool(trainer.pipeline.memory_summary),
        f"depths   {model.near:g} to {model.far:g}",
        f"model    {model.size}: {model.preset.depth} x {width}, {samples}",
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


def choose_device(device_type: str, of_run: bool = False) -> str:
    """The torch device of --machine.device-type; for a GPU that torch does not find a run, which another machine may
    have begun, is left to the CPU, and otherwise it is an InputError."""
    if device_type == "auto":  # mps only for who asks for it: nothing has been seen to train there
        return "cuda" if torch.cuda.is_available() else "cpu"
    backends = {"cuda": torch.cuda, "mps": torch.backends.mps}
    if device_type in backends and not backends[device_type].is_available():
        if of_run:
            return "cpu"
        raise InputError(f"--machine.device-type is {device_type}, but torch finds no GPU for it; use auto or cpu")
    return device_type


def disable_malloc_trimming() -> None:
    """Make glibc's malloc, if there is one, keep large freed blocks: page faults slow down training on a CPU."""
    m_trim_threshold, m_top_pad, m_mmap_max = -1, -2, -4
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL("libc.so.6")
        for option, value in ((m_mmap_max, 0), (m_trim_threshold, 2**31 - 1), (m_top_pad, 64 * 2**20)):
            libc.mallopt(option, value)
