"""Trainings on real scenes that differ in how pixels are chosen, each as long as a number of CPU seconds or of steps.

CPU seconds of a training run from when the images are read, all tables included, to the end of its last step; other
work on the machine hardly changes them. Learning rate and cells follow them, or the steps.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from edge_se_sampler.bench.outcomes import measure_outcome
from edge_se_sampler.bench.runner import Run
from edge_se_sampler.data.capture import Split
from edge_se_sampler.data.dataset import DataSettings, read_split
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.config import MODEL, SAMPLER, TrainerConfig, override
from edge_se_sampler.engine.evaluation import evaluate
from edge_se_sampler.engine.metrics import composite_on
from edge_se_sampler.engine.pipeline import Pipeline
from edge_se_sampler.engine.plan import Plan
from edge_se_sampler.engine.rendering import to_pictures
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.session import disable_malloc_trimming, resolve_config
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models.lean import compile_ops
from edge_se_sampler.sampling.registry import PIXEL_STRATEGIES

PlanName = Literal["seconds", "steps"]
PLANS: tuple[PlanName, ...] = ("seconds", "steps")
Placement = Literal["centered", "shifted"]
PLACEMENTS: tuple[Placement, ...] = ("centered", "shifted")
"""The scene as it is; its pictures on a larger canvas, off center."""
UNIFORM = "uniform"


@dataclass(frozen=True)
class Length:
    """How long a model is trained, and on how many test views at most, evenly spread, it is measured."""

    seconds: float
    steps: int
    test_views: int


@dataclass(frozen=True)
class Settings:
    """What all trainings have in common."""

    nerf: Length = Length(60, 300, 9)
    lean: Length = Length(10, 800, 25)


@dataclass(frozen=True)
class Model:
    """What is trained."""

    method: str
    changes: dict[str, Any]
    length: Literal["nerf", "lean"]
    """Field of `Settings`."""
    has_masks: bool = True
    """Whether the training images keep their alpha; without, they are composited on white."""


MODELS = {
    "nerf": Model("vanilla-nerf", {f"{MODEL}.size": "tiny"}, "nerf"),
    "lean": Model("lean-nerf", {}, "lean"),
    "lean-no-masks": Model("lean-nerf", {}, "lean", has_masks=False),
}


@dataclass(frozen=True)
class Strategy:
    """How pixels are chosen."""

    description: str
    settings: dict[str, Any] = field(default_factory=dict)
    """Of the pixel sampler, whose early and late strategy are uniform otherwise."""
    models: tuple[str, ...] = tuple(MODELS)
    """Those that can be trained with it."""
    model_settings: dict[str, Any] = field(default_factory=dict)
    """Of the model's config."""


STRATEGIES = {
    **{n: Strategy(known.description, dict.fromkeys(known.phases, n)) for n, known in PIXEL_STRATEGIES.items()},
    "se-coarse": Strategy(
        "the same, of the coarse network's errors", {"late": "se", "error_source": "coarse"}, models=("nerf",)
    ),
    "se-cached": Strategy("the same, of errors that training found before", {"late": "se", "error_source": "cached"}),
    "edge-se": Strategy("edge first, then se", {"early": "edge", "late": "se"}),
    "hard-samples": Strategy(
        "all pixels alike, the samples of their rays by their gradients", {}, ("nerf",), {"hard_samples": True}
    ),
}
"""Every one of the registry in all phases that it may stand for; ways to squared errors, and the paper's combination;
and uniform pixels of which hard samples are trained."""


@dataclass(frozen=True)
class Trial:
    """One training."""

    model: str
    scene: str
    downscale: int
    placement: Placement
    plan: PlanName
    strategy: str
    seed: int


def list_trials(
    models: Sequence[str],
    scenes: Sequence[str],
    downscales: Sequence[int],
    placements: Sequence[Placement],
    plans: Sequence[PlanName],
    strategies: Sequence[str],
    seeds: Sequence[int],
) -> list[Trial]:
    """Seed by seed and scene by scene, so that what is compared is trained side by side, of images read once."""
    return [
        Trial(model, scene, downscale, placement, plan, strategy, seed)
        for seed, model, downscale, placement, scene, plan, strategy in product(
            seeds, models, downscales, placements, scenes, plans, strategies
        )
        if model in STRATEGIES[strategy].models
    ]


def build_config(trial: Trial, settings: Settings, output_dir: Path) -> TrainerConfig:
    """What a trial trains. An early phase lasts a tenth of the plan of steps, under both plans."""
    model, strategy = MODELS[trial.model], STRATEGIES[trial.strategy]
    length: Length = getattr(settings, model.length)
    changes = {
        "output_dir": output_dir,
        "experiment_name": "strategies",
        "max_num_iterations": length.steps if trial.plan == "steps" else None,
        "machine.seed": trial.seed,
        "machine.device_type": "cpu",
        **model.changes,
        **{f"{MODEL}.{name}": value for name, value in strategy.model_settings.items()},
    }
    early_phase = {"schedule": "steps", "early_steps": max(1, length.steps // 10)}
    sampler = {"early": UNIFORM, "late": UNIFORM, **early_phase, **strategy.settings}
    changes |= {f"{SAMPLER}.{name}": value for name, value in sampler.items()}
    return override(method_configs()[model.method], changes)


def run_trial(trial: Trial, settings: Settings, data: Path) -> Run:
    """Train on one thread, and measure on test views.

    Returns:
        size of the images, width and height in pixels; what `measure_outcome` measures; PSNR on the object and in the
        band around edges; steps; seconds: CPU seconds of the training, of them ready_seconds before the first step;
        cpu_seconds of all, reading and evaluating included.
    """
    torch.set_num_threads(1)
    begin = time.process_time()
    model, length = MODELS[trial.model], getattr(settings, MODELS[trial.model].length)
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        train, test = (read_views(data, trial.downscale, split) for split in ("train", "test"))
        config = build_config(trial, settings, Path(folder))
        views = train if model.has_masks else without_alpha(train)
        trainer, run = _train(config, views, length.seconds if trial.plan == "seconds" else None)
        pictures = to_pictures(test.subset(range(0, len(test.names), -(-len(test.names) // length.test_views))))
        results = evaluate(trainer.pipeline.model, pictures)
    return {
        "size": list(pictures[0].image.shape[1::-1]),
        **measure_outcome(results["images"], pictures, trainer.pipeline.model.config.background_level),
        **{key: results[key] for key in ("foreground_psnr", "edge_band_psnr")},
        **run,
        "cpu_seconds": round(time.process_time() - begin, 2),
    }


@lru_cache(maxsize=4)
def read_views(data: Path, downscale: int, split: Split) -> Views:
    """A split of a scene, kept for the trainings on it that follow; InputError if it is missing or bad."""
    views = read_split(data, split, DataSettings(downscale=downscale))
    assert views is not None  # InputError for a missing training split; every scene here has a test split
    return views


def without_alpha(views: Views) -> Views:
    """The views composited on white, RGB."""
    images = (np.rint(composite_on(image / np.float32(255)) * 255).astype(np.uint8) for image in views.images)
    return replace(views, images=tuple(images))


def _train(config: TrainerConfig, views: Views, seconds: float | None) -> tuple[Trainer, Run]:
    """Train for so many CPU seconds, which the learning rate follows; None: for the config's number of steps."""
    compile_ops("cpu")  # or load them: like imports
    torch.optim.Adam([torch.zeros(1)])  # a process's first one imports for a second
    disable_malloc_trimming()
    start = time.process_time()
    config = resolve_config(config, views)
    pipeline = Pipeline.build(config, views, "cpu")
    trainer = config.setup(run=RunFolder.create(config), pipeline=pipeline, preview=None)
    if seconds is not None:
        trainer.plan = Plan(None, time_budget=seconds)
    ready = spent = time.process_time() - start
    trainer.plan.decide(0, spent)
    step = 0
    while step != trainer.plan.num_steps:
        trainer.train_iteration(step)
        step, spent = step + 1, time.process_time() - start
        trainer.plan.decide(step, spent)
    return trainer, {"steps": step, "seconds": round(spent, 3), "ready_seconds": round(ready, 3)}
