"""The trainings of `trials`, on one thread each.

CPU seconds of a training run from when the images are read, all tables included, to the end of its last step; other
work on the machine hardly changes them. Learning rate and cells follow them, or the steps.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from edge_se_sampler.bench.results import Run
from edge_se_sampler.bench.strategies.measures import measure
from edge_se_sampler.bench.strategies.nerfacto import run_nerfacto
from edge_se_sampler.bench.strategies.trials import (
    MODELS,
    NERFACTO,
    STRATEGIES,
    Length,
    Settings,
    Trial,
    measured_views,
    read_views,
    sampler_settings,
)
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
from edge_se_sampler.models.compilation import compile_ops


def run_trial(trial: Trial, settings: Settings, data: Path) -> Run:
    """Train on one thread, and measure on test views.

    Args:
        data: the scene; nerfacto's is downscaled already.

    Returns:
        size of the images, width and height in pixels; what `measure_outcome` measures; PSNR on the object and in the
        band around edges; steps; seconds: CPU seconds of the training, of them ready_seconds before the first step;
        cpu_seconds of all, reading and evaluating included.
    """
    if trial.model == NERFACTO:
        return run_nerfacto(trial, settings, data)
    torch.set_num_threads(1)
    begin = time.process_time()
    model, length = MODELS[trial.model], getattr(settings, MODELS[trial.model].length)
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        train, test = (read_views(data, trial.downscale, split) for split in ("train", "test"))
        config = build_config(trial, settings, Path(folder))
        views = train if model.has_masks else without_alpha(train)
        trainer, run = _train(config, views, length.seconds if trial.plan == "seconds" else None)
        pictures = to_pictures(test.subset(measured_views(test, length)))
        images = evaluate(trainer.pipeline.model, pictures)["images"]
    return {
        "size": list(pictures[0].image.shape[1::-1]),
        **measure(images, pictures, trainer.pipeline.model.config.background_level),
        **run,
        "cpu_seconds": round(time.process_time() - begin, 2),
    }


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
    sampler = sampler_settings(trial.strategy, length)
    changes |= {f"{SAMPLER}.{name}": value for name, value in sampler.items()}
    return override(method_configs()[model.method], changes)


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
