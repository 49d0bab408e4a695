"""nerfacto inside nerfstudio on one thread of a CPU, its pixels chosen by a strategy: by the data manager of
edge-se-nerfacto, nothing else changed. It is much smaller than by nerfstudio's settings, which are
made for a GPU."""
# pyright: reportMissingImports=false
# nerfstudio's pins rule out the environment that is linted

from __future__ import annotations

import io
import tempfile
import time
import warnings
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edge_se_sampler.bench.baselines.run import TimeIsUp
from edge_se_sampler.bench.nerfstudio.host import build_config, build_trainer, render_test_views, skip_lpips_weights
from edge_se_sampler.bench.results import Run
from edge_se_sampler.bench.strategies.measures import measure
from edge_se_sampler.bench.strategies.trials import Settings, Trial, measured_views, read_views, sampler_settings
from edge_se_sampler.engine.metrics import compute_metrics
from edge_se_sampler.engine.rendering import to_pictures

SMALL = {
    "model.implementation": "torch",
    "model.camera-optimizer.mode": "off",
    "model.eval-num-rays-per-chunk": 4096,
    "model.num-levels": 4,
    "model.features-per-level": 4,
    "model.log2-hashmap-size": 16,
    "model.max-res": 512,
    "model.num-proposal-iterations": 1,
    "model.num-proposal-samples-per-ray": 32,
    "model.proposal-weights-anneal-max-num-iters": 100,
    "model.num-nerf-samples-per-ray": 24,
    "datamanager.train-num-rays-per-batch": 512,
}
"""Flags of the pipeline."""
OF_OBJECTS = {"model.background-color": "white"}
OF_BLENDER_SCENES = {
    "model.proposal-initial-sampler": "uniform",
    "model.near-plane": 2,
    "model.far-plane": 6,
    "model.use-appearance-embedding": False,
    "model.disable-scene-contraction": True,
    "model.distortion-loss-mult": 0,
}
"""With `OF_OBJECTS`, what nerfstudio's own benchmark sets for NeRF's Blender scenes, too."""
RATES_OF_OBJECTS = {"optimizers.fields.optimizer.lr": 3e-3, "optimizers.proposal-networks.optimizer.lr": 3e-3}
"""Flags; with nerfstudio's own, 1e-2, so few rays a step often end in one color everywhere. Captures do not, and learn
faster with it."""
NEVER = 10**9


def run_nerfacto(trial: Trial, settings: Settings, data: Path) -> Run:
    """As `trials.run_trial`, on a folder that nerfstudio reads, for as long as NeRF is trained. CPU seconds begin when
    nerfstudio has set its trainer up, images included."""
    torch.set_num_threads(1)
    begin, length = time.process_time(), settings.nerf
    test = read_views(data, 1, "test")
    numbers = measured_views(test, length)
    pictures = to_pictures(test.subset(numbers))
    is_object = any(picture.image.shape[2] == 4 for picture in pictures)
    with (
        tempfile.TemporaryDirectory() as folder,
        redirect_stdout(io.StringIO()),
        redirect_stderr(io.StringIO()),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        skip_lpips_weights()
        config = nerfacto_config(trial, settings, data, Path(folder), is_object)
        trainer = build_trainer(config, "test")
        spent = _train(trainer, length.seconds if trial.plan == "seconds" else None)
        views = render_test_views(trainer, numbers)
    rendered = [np.clip(view, 0, 1) for view in views]
    images = [compute_metrics(view, p.image, 1.0, p.mask) for view, p in zip(rendered, pictures, strict=True)]
    return {
        "size": list(pictures[0].image.shape[1::-1]),
        **measure(images, pictures, 1.0),
        **spent,
        "cpu_seconds": round(time.process_time() - begin, 2),
    }


def nerfacto_config(trial: Trial, settings: Settings, data: Path, folder: Path, is_object: bool) -> Any:
    """nerfstudio's config of a trial."""
    is_blender = trial.placement == "shifted" or not (data / "transforms.json").exists()
    flags = SMALL | (OF_OBJECTS if is_object else {}) | (OF_BLENDER_SCENES if is_blender else {})
    flags = {f"pipeline.{name}": value for name, value in flags.items()} | (RATES_OF_OBJECTS if is_object else {})
    arguments = [text for name, value in flags.items() for text in (f"--{name}", str(value))]
    config = build_config("edge-se-nerfacto", trial.seed, data, folder, arguments)
    if trial.placement == "shifted":
        _keep_world(config.pipeline.datamanager.dataparser)
    config.max_num_iterations = settings.nerf.steps if trial.plan == "steps" else NEVER
    config.steps_per_save = NEVER
    config.vis, config.logging.local_writer.enable = "none", False  # writers outlive a training, and its folder
    for name, value in sampler_settings(trial.strategy, settings.nerf).items():
        setattr(config.pipeline.datamanager.pixel_sampler, name, value)
    return config


def _keep_world(parser: Any) -> None:
    """Let nerfstudio's own format, which has images off center, keep cameras and box as its parser of Blender scenes
    does: `OF_BLENDER_SCENES` names depths in that world."""
    parser.orientation_method = parser.center_method = "none"
    parser.auto_scale_poses, parser.scene_scale = False, 1.5


def _train(trainer: Any, seconds: float | None) -> dict[str, Any]:
    """Train for so many CPU seconds, or for the config's number of steps: steps and seconds."""
    from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

    start, steps, first = time.process_time(), 0, 0.0

    def begin_step(step: int) -> None:
        nonlocal first
        first = first or time.process_time() - start

    def end_step(step: int) -> None:
        nonlocal steps
        steps += 1
        if seconds is not None and time.process_time() - start >= seconds:
            raise TimeIsUp

    trainer.callbacks += [
        TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], begin_step),
        TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], end_step),
    ]
    with suppress(TimeIsUp):
        trainer.train()
    return {
        "steps": steps,
        "seconds": round(time.process_time() - start, 3),
        "ready_seconds": round(first, 3),
    }
