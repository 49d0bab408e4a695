"""One trial of the chart: test PSNR after seconds of training, under a plan that fills the time that it has. lean-nerf,
which can be given a time budget, is trained anew for each budget.

Training time runs from reading the data (scene analysis and tables included) to the end of a step; imports and
evaluations are left out. Trainings on one thread are timed in CPU seconds, which other work on the machine hardly
changes.
"""

from __future__ import annotations

import contextlib
import io
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import torch

from edge_se_sampler.bench.chart.variants import VARIANTS
from edge_se_sampler.bench.machine import resident_memory
from edge_se_sampler.bench.outcomes import measure_outcome
from edge_se_sampler.bench.results import Run
from edge_se_sampler.engine.config import TrainerConfig, override
from edge_se_sampler.engine.evaluation import evaluate
from edge_se_sampler.engine.metrics import composite_on, psnr
from edge_se_sampler.engine.rendering import Picture, render_rays, to_pictures
from edge_se_sampler.engine.session import prepare, read_test_views
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models.compilation import compile_ops
from edge_se_sampler.models.config import LeanModelConfig
from edge_se_sampler.models.ray_model import RayModel

EVAL_SECONDS = (1, 2, 3, 5, 7, 10, 14, 20, 30, 45, 60, 80, 100)
"""Seconds of training after which the test views are evaluated."""
BUDGETS = (3, 7, 20)
"""Shorter trainings of models that follow a time budget, s: those of less than half of the whole time."""
PROBE_STEPS = 12
"""Steps from the end of the plan, the slower ones, whose time tells how many will fit; the first quarter is warm-up."""
PROBE_FRACTION = 1 / 30
"""Fraction of the time that is trained before them, because cells may be subdivided, which makes steps slower."""
MAX_PLAN_ERROR = 0.1
"""A plan that misses its time by more than this fraction is repeated once, by how long its steps took."""


@dataclass(frozen=True)
class ChartSettings:
    """The flags that a result depends on."""

    seconds: float = 60
    threads: int = 1
    image_size: int = 100
    """Longer side of the images, pixels."""
    data: str = ""
    """Name of the folder of scenes; none: synthetic ones."""

    @property
    def clock(self) -> Callable[[], float]:
        return time.process_time if self.threads == 1 else time.perf_counter

    @property
    def source(self) -> str:
        """Where the scenes are from, in words."""
        if self.data:
            return f"the scenes in {self.data}"
        return "simple synthetic scenes that share only their names with NeRF-synthetic's"

    @property
    def unit(self) -> str:
        return "CPU seconds on one core" if self.threads == 1 else f"seconds on {self.threads} cores"


@dataclass(frozen=True)
class Trial:
    variant: str
    scene: str
    seed: int


def config_of(trial: Trial, data: Path, output_dir: Path) -> TrainerConfig:
    """What a trial trains; its number of iterations is still open."""
    variant = VARIANTS[trial.variant]
    run = {"data": data, "output_dir": output_dir, "machine.seed": trial.seed, "machine.device_type": "cpu"}
    return override(method_configs()[variant.method], {**variant.changes, **run})


def train_and_evaluate(trial: Trial, settings: ChartSettings, data: Path) -> Run:
    """Train, and evaluate on the way.

    Returns:
        psnr and outcome at the end; seconds, of them ready_seconds before the first step; steps, and the planned ones;
        queries: points at which networks were evaluated in training; peak_bytes of memory, evaluations included, above
        what imports take; and curve: [seconds, steps, queries, mean test PSNR] at every evaluation.
    """
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        torch.set_num_threads(settings.threads)
        memory_before = resident_memory()
        config = config_of(trial, data, Path(folder))
        follows_budget = isinstance(config.pipeline.model, LeanModelConfig)
        run = (_train_budgets if follows_budget else _train_planned)(config, settings)
        return {**run, "peak_bytes": max(0, resident_memory("VmHWM") - memory_before)}


def _train_budgets(config: TrainerConfig, settings: ChartSettings) -> Run:
    """The longest training; its curve has the ends of the shorter ones before its own."""
    compile_ops("cpu")  # or load them: like imports
    torch.optim.Adam([torch.zeros(1)])  # the first optimizer imports much of torch
    ends, run = [], {}
    for budget in (*(budget for budget in BUDGETS if 2 * budget < settings.seconds), settings.seconds):
        run = _train(replace(config, time_budget=str(budget)), settings)
        ends.append(run["curve"][-1])
    return {**run, "curve": ends}


def _train_planned(config: TrainerConfig, settings: ChartSettings) -> Run:
    """With as many iterations as fit."""
    run = _train(replace(config, max_num_iterations=iterations_within(config, settings)), settings)
    ready = run["ready_seconds"]
    fitting = max(1, round(run["steps"] * (settings.seconds - ready) / (run["seconds"] - ready)))
    if abs(1 - run["planned_steps"] / fitting) > MAX_PLAN_ERROR:
        return _train(replace(config, max_num_iterations=fitting), settings)
    return run


def iterations_within(config: TrainerConfig, settings: ChartSettings) -> int:
    """How many iterations fit into the training time after reading the data, at the speed of the plan's last steps."""
    planned, times = 10_000, []
    start = settings.clock()
    trainer = prepare(replace(config, max_num_iterations=planned))
    ready = settings.clock() - start
    for step in range(planned - PROBE_STEPS):
        if settings.clock() - start > ready + PROBE_FRACTION * settings.seconds:
            break
        trainer.train_iteration(step)
    for step in range(planned - PROBE_STEPS, planned):
        start = settings.clock()
        trainer.train_iteration(step)
        times.append(settings.clock() - start)
    return max(PROBE_STEPS, round((settings.seconds - ready) / statistics.median(times[PROBE_STEPS // 4 :])))


def _train(config: TrainerConfig, settings: ChartSettings) -> Run:
    """A training of the iterations or of the time budget that the config has."""
    start = settings.clock()
    trainer = prepare(config)
    ready = spent = round(settings.clock() - start, 3)
    model, pictures = trainer.pipeline.model, to_pictures(read_test_views(trainer.config))
    queries = count_queries(model)
    due = [] if config.time_budget else [seconds for seconds in EVAL_SECONDS if ready < seconds < settings.seconds]
    curve: list[list[float]] = []
    results: dict[str, Any] = {}
    trainer.plan.decide(0, spent)
    for steps in count(1):
        start = settings.clock()
        trainer.train_iteration(steps - 1)
        spent += settings.clock() - start
        trainer.plan.decide(steps, spent)
        is_last = steps == trainer.plan.num_steps or spent >= settings.seconds
        if is_last or (due and spent >= due[0]):
            due = [seconds for seconds in due if seconds > spent]
            queries[:] = [sum(queries)]
            results = evaluate(model, pictures) if is_last else {"psnr": quick_psnr(model, pictures)}
            del queries[1:]  # those of the evaluation
            curve.append([round(spent, 3), steps, queries[0], round(results["psnr"], 3)])
        if is_last:
            break
    outcome = measure_outcome(results["images"], pictures, model.config.background_level)["outcome"]
    planned = trainer.plan.num_steps or curve[-1][1]
    run = {"planned_steps": planned, "ready_seconds": ready, "psnr": results["psnr"], "outcome": outcome}
    return run | dict(zip(("seconds", "steps", "queries"), curve[-1], strict=False)) | {"curve": curve}


def quick_psnr(model: RayModel, pictures: list[Picture]) -> float:
    """Mean PSNR over the views, each of every third pixel."""
    rows, values = slice(None, None, 3), []
    for picture in pictures:
        rendered = render_rays(model, picture.rays(model.device)[rows]).clamp(0, 1).double()
        truth = torch.from_numpy(composite_on(picture.image, model.config.background_level)).reshape(-1, 3)[rows]
        values.append(psnr(float((rendered - truth).square().mean())))
    return statistics.mean(values)


def count_queries(model: RayModel) -> list[int]:
    """A list that grows by the number of points whenever one of the model's networks is evaluated; not that of
    lean-nerf, which its kernels evaluate."""
    counts: list[int] = []
    for network in model.networks:
        getattr(model, network).register_forward_hook(lambda _, inputs, __: counts.append(len(inputs[0])))
    return counts
