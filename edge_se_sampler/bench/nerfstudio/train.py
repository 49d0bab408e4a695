"""Trainings inside nerfstudio: its own pixel sampler against Edge + SE.

Its vanilla NeRF has a softplus density, torch's initial weights and RAdam; the methods differ in their data managers.
"""

from __future__ import annotations

import contextlib
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.nerfstudio.host import build_config, build_trainer, render_test_views
from edge_se_sampler.bench.outcomes import measure_outcome
from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.engine.metrics import compute_metrics
from edge_se_sampler.engine.rendering import to_pictures

METHODS = {"vanilla-nerf": "nerfstudio's uniform pixels", "edge-se-nerf": "Edge + SE"}
SCENE_OPTIONS = {
    "size": 64, "num_train": 30, "num_val": 1, "num_test": 3, "placement": "shifted", "offset": (0.2, 0.15),
}  # fmt: skip


@dataclass(frozen=True)
class TrainingSettings:
    """What is trained, by which nerfstudio."""

    nerfstudio: str
    """Its version."""
    scene: str = "chair"
    iterations: int = 1500
    rays: int = 32
    """Pixels per step."""
    samples: int = 16
    """Coarse samples per ray, and as many importance samples."""


@dataclass(frozen=True)
class Trial:
    """One training."""

    method: str
    seed: int


def run_trial(trial: Trial, settings: TrainingSettings, data: Path, workplace: Path) -> dict[str, Any]:
    """Train once and measure the test views: seconds, cpu_seconds, and those of `measure_outcome`."""
    config = build_config(trial.method, trial.seed, data, workplace / "runs")
    config.max_num_iterations = settings.iterations
    config.pipeline.datamanager.train_num_rays_per_batch = settings.rays
    config.pipeline.model.num_coarse_samples = config.pipeline.model.num_importance_samples = settings.samples
    with open(workplace / "nerfstudio.log", "a") as log, contextlib.redirect_stdout(log), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trainer = build_trainer(config, "test")
        start, cpu_start = time.monotonic(), time.process_time()
        trainer.train()
        seconds, cpu_seconds = time.monotonic() - start, time.process_time() - cpu_start
        views = render_test_views(trainer)
    pictures = to_pictures(read_blender(data, "test"))
    images = [compute_metrics(view, picture.image, 1.0) for view, picture in zip(views, pictures, strict=True)]
    return {"seconds": seconds, "cpu_seconds": cpu_seconds, **measure_outcome(images, pictures, 1.0)}
