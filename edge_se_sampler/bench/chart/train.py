"""One training of the chart: test PSNR at moments of training time, under a plan that fills that time.

Training time runs from reading the data (hull and tables included) to the end of a step; imports and looking at test
views are left out.
"""

from __future__ import annotations

import contextlib
import io
import multiprocessing
import statistics
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from edge_se_sampler.bench.chart.variant import Cell, config_of
from edge_se_sampler.bench.machine import resident_memory
from edge_se_sampler.bench.outcome import background_measures, foreground_share, outcome
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.evaluation import evaluate, shade_behind
from edge_se_sampler.engine.session import prepare, test_pictures
from edge_se_sampler.engine.trainer import Trainer

LOOKS = (1, 2, 3, 5, 7, 10, 14, 20, 30, 45, 60, 80, 100)
"""Seconds of training after which the test views are looked at."""
TRIED = 12
"""Steps of the plan's end, the dearer ones, that tell how many will fit; the first few of them do not count."""


@dataclass(frozen=True)
class Scale:
    """How long."""

    seconds: float = 60
    """Of training; the plan, which learning rate and phases follow, is as long."""


def run_in_own_process(cell: Cell, scale: Scale, data: Path) -> dict[str, Any]:
    """`run_cell` in a process that nothing else has grown."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as alone:
        return alone.submit(run_cell, cell, scale, data).result()


def run_cell(cell: Cell, scale: Scale, data: Path) -> dict[str, Any]:
    """Train a cell and measure it on the way.

    Returns:
        its place, how it ended, seconds, of which it was getting ready, steps, network evaluations, bytes of memory
        at most above what imports take, and `curve`: seconds, steps, evaluations and mean test PSNR at every look.
    """
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        config = config_of(cell, data, Path(folder))
        iterations = iterations_within(config, scale.seconds)
        config = replace(config, max_num_iterations=iterations, steps_per_eval_image=iterations)
        before = resident_memory()
        began = time.perf_counter()
        trainer = prepare(config)
        ready = time.perf_counter() - began
        told = _trained(trainer, ready, scale.seconds)
        told["peak_bytes"] = max(0, resident_memory("VmHWM") - before)
    return {**asdict(cell), "planned_steps": iterations, "ready_seconds": round(ready, 3), **told}


def iterations_within(config: TrainerConfig, seconds: float) -> int:
    """How many iterations fit into a training time: getting ready, and steps as they are late in the plan."""
    with tempfile.TemporaryDirectory() as folder:
        planned = 10_000
        began = time.perf_counter()
        trainer = prepare(replace(config, max_num_iterations=planned, output_dir=Path(folder)))
        ready = time.perf_counter() - began
        times = []
        for step in range(planned - TRIED, planned):
            began = time.perf_counter()
            trainer.train_iteration(step)
            times.append(time.perf_counter() - began)
    return max(TRIED, round((seconds - ready) / statistics.median(times[TRIED // 4 :])))


def _trained(trainer: Trainer, ready: float, seconds: float) -> dict[str, Any]:
    model, pictures = trainer.pipeline.model, test_pictures(trainer.config)
    evaluations = _Count(model)
    looks = [look for look in LOOKS if ready < look < seconds]
    curve, results, spent = [], {}, ready
    for step in range(trainer.planned_steps):
        began = time.perf_counter()
        trainer.train_iteration(step)
        spent += time.perf_counter() - began
        last = step + 1 == trainer.planned_steps or spent >= seconds
        if last or (looks and spent >= looks[0]):
            looks = [look for look in looks if look > spent]
            asked = evaluations.points
            results = evaluate(model, pictures)
            evaluations.points = asked
            curve.append([round(spent, 3), step + 1, asked, round(results["psnr"], 3)])
        if last:
            break
    background = background_measures(pictures, shade_behind(model))
    background_psnr = sum(alone["psnr"] or 0.0 for alone in background) / len(background)
    return {
        "psnr": results["psnr"],
        "outcome": outcome(results["psnr"], background_psnr, foreground_share(results, background)),
        "seconds": curve[-1][0],
        "steps": curve[-1][1],
        "evaluations": curve[-1][2],
        "curve": curve,
    }


class _Count:
    """Points that a model's networks have been asked about."""

    def __init__(self, model: Any) -> None:
        self.points = 0
        for level in model.levels:
            getattr(model, level).register_forward_hook(self._add)

    def _add(self, _: torch.nn.Module, asked: tuple[Any, ...], __: Any) -> None:
        self.points += len(asked[0])
