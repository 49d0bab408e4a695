"""Trainings of lean-nerf on real scenes, each with a time budget on all of the machine's cores."""

from __future__ import annotations

import contextlib
import io
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from edge_se_sampler.bench.chart.variants import UNIFORM_PIXELS
from edge_se_sampler.bench.machine import resident_memory
from edge_se_sampler.bench.real.summary import STEPS, is_time
from edge_se_sampler.bench.results import Run
from edge_se_sampler.bench.runner import run_in_subprocess
from edge_se_sampler.data.capture import Split
from edge_se_sampler.data.dataset import DataSettings, read_split
from edge_se_sampler.data.scene_file import quote
from edge_se_sampler.engine.config import MODEL, SAMPLER, TrainerConfig, override
from edge_se_sampler.engine.evaluation import evaluate
from edge_se_sampler.engine.rendering import to_pictures
from edge_se_sampler.engine.session import prepare, read_test_views
from edge_se_sampler.errors import check_value
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models.ensemble import Ensemble
from edge_se_sampler.models.lean import LeanModel

VARIANTS: dict[str, dict[str, Any]] = {
    "lean-nerf": {},
    "uniform pixels": UNIFORM_PIXELS,
    "pixels by cached errors": {**UNIFORM_PIXELS, f"{SAMPLER}.late": "se", f"{SAMPLER}.error_source": "cached"},
    "one ray a pixel": {f"{MODEL}.supersample": False},
    "no hull": {f"{MODEL}.cull_by_alpha": False},
    "rays from near on": {f"{MODEL}.near_share": 0.0},
    "no total variation": {f"{MODEL}.total_variation": 0.0},
    "no alpha loss": {f"{MODEL}.alpha_loss": 0.0},
    "random background": {f"{MODEL}.background_color": "random"},
    "half the thresholds": {
        f"{MODEL}.alpha_threshold": 0.01,
        f"{MODEL}.weight_threshold": 0.002,
        f"{MODEL}.transmittance_threshold": 0.003,
    },
    "half the memory": {f"{MODEL}.max_memory": 0.5},
    "mean of three trainings": {},
}
"""What is changed, by label."""
MEMBERS = {"mean of three trainings": 3}
"""Variants that are so many trainings, each with its share of the budget and a seed of its own."""
SEEDS_APART = 1000
"""How far apart the seeds of such trainings are."""


@dataclass(frozen=True)
class Settings:
    """What all trainings have in common."""

    num_train_views: int = 5
    """Training views that are measured, too, evenly spread."""


@dataclass(frozen=True)
class Trial:
    """One training."""

    scene: str
    downscale: int
    budget: str
    """As in edge-se train, or "2000 steps"."""
    variant: str
    seed: int


def training_length(budget: str, members: int = 1) -> dict[str, Any]:
    """A time budget, or a number of steps, or a share of it, as changes of a training's config; InputError if it is
    none."""
    if is_time(budget):
        seconds = replace(method_configs()["lean-nerf"], time_budget=budget).budget_seconds
        return {"time_budget": budget if members == 1 or seconds is None else f"{seconds / members:g}"}
    steps = budget.removesuffix(STEPS)
    valid = steps.isdecimal() and int(steps) > 0
    check_value("budgets", quote(budget), valid, 'a time, as 90s or 10m, or a number of steps, as "2000 steps"')
    return {"max_num_iterations": max(1, int(steps) // members)}


def run_trial(trial: Trial, scenes: Path, workplace: Path, settings: Settings, at_once: int = 1) -> Run:
    """Train in a process of its own, and measure on test, validation and some training views.

    Args:
        at_once: How many trainings share the machine's cores.

    Returns:
        size of the images, width and height in pixels; PSNR on each split, None where validation views are the test
        views; SSIM on the test views; steps; seconds of the budget that were used, and CPU seconds; rows of the
        finest cells; the process's peak of resident memory, GiB; seconds that rendering and measuring
        a test view take.
    """
    return run_in_subprocess(_train_and_measure, trial, scenes, workplace, settings, at_once)


def _train_and_measure(trial: Trial, scenes: Path, workplace: Path, settings: Settings, at_once: int) -> Run:
    torch.set_num_threads(max(1, torch.get_num_threads() // at_once))
    with contextlib.redirect_stderr(io.StringIO()):
        trained = [_train(trial, member, scenes, workplace) for member in range(MEMBERS.get(trial.variant, 1))]
    peak = resident_memory("VmHWM")
    models = [member.model for member in trained]
    model = models[0] if len(models) == 1 else Ensemble(models)
    pictures = to_pictures(read_test_views(trained[0].config))
    start = time.monotonic()
    results = evaluate(model, pictures)
    seconds_per_view = (time.monotonic() - start) / len(pictures)
    return {
        "size": list(pictures[0].image.shape[1::-1]),
        "psnr": round(results["psnr"], 3),
        "ssim": round(results["ssim"], 4),
        "val_psnr": _mean_psnr(model, trial, scenes, "val"),
        "train_psnr": _mean_psnr(model, trial, scenes, "train", settings.num_train_views),
        "steps": sum(member.steps for member in trained),
        "seconds": round(sum(member.seconds for member in trained), 2),
        "cpu_seconds": round(sum(member.cpu_seconds for member in trained), 2),
        "level": max(int(model.grid.level) for model in models),
        "rows": sum(model.grid.num_rows for model in models),
        "memory": round(peak / 2**30, 2),
        "seconds_per_view": round(seconds_per_view, 3),
    }


class _Trained(NamedTuple):
    """What is left of a training: not its optimizer, which takes more memory than the model."""

    model: LeanModel
    config: TrainerConfig
    steps: int
    seconds: float
    cpu_seconds: float


def _train(trial: Trial, member: int, scenes: Path, workplace: Path) -> _Trained:
    """A trial's training, or one of several: member 0, 1, ..."""
    changes = {
        "data": scenes / trial.scene,
        "downscale": trial.downscale,
        **training_length(trial.budget, MEMBERS.get(trial.variant, 1)),
        "output_dir": workplace / "runs",
        "machine.seed": trial.seed + SEEDS_APART * member,
        **VARIANTS[trial.variant],
    }
    trainer = prepare(override(method_configs()["lean-nerf"], changes))
    start = time.process_time()
    trainer.train()
    if trainer.stop_requested:
        raise KeyboardInterrupt
    cpu_seconds, seconds = time.process_time() - start, trainer.elapsed + trainer.setup_seconds
    return _Trained(trainer.pipeline.model, trainer.config, trainer.next_step, seconds, cpu_seconds)


def _mean_psnr(model: Any, trial: Trial, scenes: Path, split: Split, count: int | None = None) -> float | None:
    """On a split, or on so many of its views; None if there is no such split, or it is the test split."""
    views = read_split(scenes / trial.scene, split, DataSettings(downscale=trial.downscale))
    if views is None or (split == "val" and views.eval_every is not None):
        return None
    if count is not None:
        views = views.subset(np.linspace(0, len(views.names) - 1, count).astype(int).tolist())
    return round(evaluate(model, to_pictures(views))["psnr"], 3)
