"""One training of the chart: test PSNR at moments of training time, under a plan that fills that time.

Training time runs from reading the data (hull and tables included) to the end of a step; imports and looking at test
views are left out. Trainings of one thread are timed in CPU seconds, which other work on the machine changes little.
"""

from __future__ import annotations

import contextlib
import io
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from edge_se_sampler.bench.chart.variants import Cell, config_of
from edge_se_sampler.bench.machine import resident_memory
from edge_se_sampler.bench.outcome import judged
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.evaluation import Picture, evaluate, get_background_color, render_rays
from edge_se_sampler.engine.metrics import composite_on, psnr
from edge_se_sampler.engine.session import prepare, test_pictures
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.models.ray_model import RayModel

LOOKS = (1, 2, 3, 5, 7, 10, 14, 20, 30, 45, 60, 80, 100)
"""Seconds of training after which the test views are looked at."""
LOOKED_AT = 3
"""A look takes every third pixel of each test view; the last one, all."""
TRIED = 12
"""Steps of the plan's end, the dearer ones, that tell how many will fit; the first few of them do not count."""
WARMED_UP = 1 / 30
"""Share of the time that is trained before, for cells may be split, and steps cost more then."""
PLAN_OFF = 0.1
"""A plan that misses its time by more than this share is made anew, once, by how long its steps took."""


@dataclass(frozen=True)
class Scale:
    """How long."""

    seconds: float = 60
    """Of training; the plan, which learning rate and phases follow, is as long."""
    threads: int = 1
    """Of a training. One: seconds are the CPU's; more: seconds of the clock on the wall."""
    pixels: int = 100
    """Longer side of the images."""

    @property
    def clock(self) -> Callable[[], float]:
        """Seconds."""
        return time.process_time if self.threads == 1 else time.perf_counter


def run_cell(cell: Cell, scale: Scale, data: Path) -> dict[str, Any]:
    """Train a cell and measure it on the way.

    Returns:
        its place, how it ended, seconds, of which it was getting ready, steps, network evaluations, bytes of memory
        at most, looks included, above what imports take, and `curve`: seconds, steps, evaluations and mean test PSNR
        at every look.
    """
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        torch.set_num_threads(scale.threads)
        before = resident_memory()
        config = config_of(cell, data, Path(folder))
        told = _planned(config, iterations_within(config, scale), scale)
        ready = told["ready_seconds"]
        fits = max(1, round(told["steps"] * (scale.seconds - ready) / (told["seconds"] - ready)))
        if abs(1 - told["planned_steps"] / fits) > PLAN_OFF:
            told = _planned(config, fits, scale)
        told["peak_bytes"] = max(0, resident_memory("VmHWM") - before)
    return asdict(cell) | told


def iterations_within(config: TrainerConfig, scale: Scale) -> int:
    """How many iterations fit into a training time: getting ready, and steps as they are late in the plan."""
    with tempfile.TemporaryDirectory() as folder:
        planned = 10_000
        began = scale.clock()
        trainer = prepare(replace(config, max_num_iterations=planned, output_dir=Path(folder)))
        ready = scale.clock() - began
        for step in range(planned - TRIED):
            if scale.clock() - began > ready + WARMED_UP * scale.seconds:
                break
            trainer.train_iteration(step)
        times = []
        for step in range(planned - TRIED, planned):
            began = scale.clock()
            trainer.train_iteration(step)
            times.append(scale.clock() - began)
    return max(TRIED, round((scale.seconds - ready) / statistics.median(times[TRIED // 4 :])))


def _planned(config: TrainerConfig, iterations: int, scale: Scale) -> dict[str, Any]:
    config = replace(config, max_num_iterations=iterations, steps_per_eval_image=iterations)
    began = scale.clock()
    trainer = prepare(config)
    ready = round(scale.clock() - began, 3)
    return {"planned_steps": iterations, "ready_seconds": ready} | _trained(trainer, ready, scale)


def _trained(trainer: Trainer, ready: float, scale: Scale) -> dict[str, Any]:
    model, pictures = trainer.pipeline.model, test_pictures(trainer.config)
    evaluations = _Count(model)
    looks = [look for look in LOOKS if ready < look < scale.seconds]
    curve, results, spent = [], {}, ready
    for step in range(trainer.planned_steps):
        began = scale.clock()
        trainer.train_iteration(step)
        spent += scale.clock() - began
        last = step + 1 == trainer.planned_steps or spent >= scale.seconds
        if last or (looks and spent >= looks[0]):
            looks = [look for look in looks if look > spent]
            asked = evaluations.points
            results = evaluate(model, pictures) if last else {"psnr": glance(model, pictures)}
            evaluations.points = asked
            curve.append([round(spent, 3), step + 1, asked, round(results["psnr"], 3)])
        if last:
            break
    return {
        "psnr": results["psnr"],
        "outcome": judged(results, pictures, get_background_color(model))["outcome"],
        "seconds": curve[-1][0],
        "steps": curve[-1][1],
        "evaluations": curve[-1][2],
        "curve": curve,
    }


def glance(model: RayModel, pictures: list[Picture]) -> float:
    """Mean PSNR over the views, each of every third pixel."""
    shade, rows, told = get_background_color(model), slice(None, None, LOOKED_AT), []
    for picture in pictures:
        rendered = render_rays(model, picture.rays(model.device)[rows]).clamp(0, 1).double()
        truth = torch.from_numpy(composite_on(picture.image, shade)).reshape(-1, 3)[rows]
        told.append(psnr(float((rendered - truth).square().mean())))
    return statistics.mean(told)


class _Count:
    """Points that a model's networks have been asked about."""

    def __init__(self, model: Any) -> None:
        self.points = 0
        for level in model.networks:
            getattr(model, level).register_forward_hook(self._add)

    def _add(self, _: torch.nn.Module, asked: tuple[Any, ...], __: Any) -> None:
        self.points += len(asked[0])
