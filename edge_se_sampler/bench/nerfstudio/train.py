"""Trainings and timed steps inside nerfstudio: its own pixel sampler against Edge + SE.

Its vanilla NeRF has a softplus density, torch's initial weights and RAdam; the methods differ in their data managers.
"""

from __future__ import annotations

import contextlib
import statistics
import time
import warnings
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.machine import median_milliseconds, resident_memory
from edge_se_sampler.bench.nerfstudio.host import build_config, build_trainer, render_test_views
from edge_se_sampler.bench.outcomes import measure_outcome
from edge_se_sampler.bench.runner import run_in_subprocess
from edge_se_sampler.bench.train import cached_scene
from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.engine.metrics import compute_metrics
from edge_se_sampler.engine.rendering import to_pictures

METHODS = {"vanilla-nerf": "nerfstudio's uniform pixels", "edge-se-nerf": "Edge + SE"}
SCENE_OPTIONS = {
    "size": 64, "num_train": 30, "num_val": 1, "num_test": 3, "placement": "shifted", "offset": (0.2, 0.15),
}  # fmt: skip
RAYS = "--pipeline.datamanager.train-num-rays-per-batch"
COST_RAYS, COST_STEPS, COST_ROUNDS = 256, 8, 3


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

    @property
    def name(self) -> str:
        return f"{self.method}, seed {self.seed}"


def render_scene(workplace: Path) -> Path:
    return cached_scene(workplace, TrainingSettings.scene, **SCENE_OPTIONS)


def run_trial(trial: Trial, settings: TrainingSettings, data: Path, workplace: Path) -> dict[str, Any]:
    """Train once and measure the test views: seconds, cpu_seconds, psnr, and those of `measure_outcome`."""
    config = build_config(trial.method, trial.seed, data, workplace / "runs", [RAYS, str(settings.rays)])
    config.max_num_iterations = settings.iterations
    config.pipeline.model.num_coarse_samples = config.pipeline.model.num_importance_samples = settings.samples
    with _silent(workplace):
        trainer = build_trainer(config, "test")
        start, cpu_start = time.monotonic(), time.process_time()
        trainer.train()
        seconds, cpu_seconds = time.monotonic() - start, time.process_time() - cpu_start
        views = render_test_views(trainer)
    pictures = to_pictures(read_blender(data, "test"))
    images = [compute_metrics(view, picture.image, 1.0) for view, picture in zip(views, pictures, strict=True)]
    psnr = statistics.mean(image["psnr"] or 0.0 for image in images)
    outcome = measure_outcome({"psnr": psnr, "images": images}, pictures, 1.0)
    return {"seconds": seconds, "cpu_seconds": cpu_seconds, "psnr": psnr, **outcome}


def measure_costs(data: Path, workplace: Path) -> dict[str, Any]:
    """What a late step costs whose pixels are uniform, or chosen by squared error.

    Returns:
        `rays` per step and `medians`: "METHOD uniform|se" -> seconds per step, and peak resident bytes above the level
        after set-up, in fresh processes that take turns.
    """
    costs: dict[str, list[dict[str, float]]] = defaultdict(list)
    for _, method, late in product(range(COST_ROUNDS), ("edge-se-nerf", "edge-se-nerfacto"), ("uniform", "se")):
        costs[f"{method} {late}"].append(run_in_subprocess(_measure_step, method, late, data, workplace))
    keys = ("seconds", "bytes")
    medians = {case: {key: statistics.median(map(itemgetter(key), costs[case])) for key in keys} for case in costs}
    return {"rays": COST_RAYS, "medians": medians}


def _measure_step(method: str, late: str, data: Path, workplace: Path) -> dict[str, float]:
    config = build_config(method, 0, data, workplace / "runs", [RAYS, str(COST_RAYS)])
    sampler = config.pipeline.datamanager.pixel_sampler
    sampler.early, sampler.late, sampler.early_fraction = "uniform", late, 0.0
    with _silent(workplace):
        trainer = build_trainer(config, "test")

        def train_step(step: int) -> None:
            for callback in trainer.callbacks:
                callback.func(step=step)
            trainer.train_iteration(step)

        before = resident_memory()
        (milliseconds,) = median_milliseconds({"step": train_step}, COST_STEPS, warmup=0).values()
    return {"seconds": milliseconds / 1000, "bytes": resident_memory("VmHWM") - before}


@contextlib.contextmanager
def _silent(workplace: Path) -> Iterator[None]:
    """What nerfstudio prints goes to a log in the workplace; its warnings go nowhere."""
    with open(workplace / "nerfstudio.log", "a") as log, contextlib.redirect_stdout(log), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
