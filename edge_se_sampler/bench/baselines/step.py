"""The dense faithful step, 1024 rays through two networks of 8 x 256 with 64 + 128 samples, against nerf-pytorch's.

Each program trains in a process of its own, on all cores; they take a step in turn.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

from edge_se_sampler.bench.baselines.run import PROGRAMS, Clock, Task, TimeIsUp, version_of
from edge_se_sampler.bench.chart.train import Scale
from edge_se_sampler.bench.machine import machine
from edge_se_sampler.engine.config import MachineConfig
from edge_se_sampler.engine.session import prepare
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs

FORGOTTEN = 2
"""Steps of each before those that count: memory is still being taken from the system."""


def bench_step(
    checkout: Path, data: Path, rounds: int, size: Literal["paper", "tiny"] = "paper", rays: int = 1024
) -> dict[str, Any]:
    """Seconds of each one's steps, medians, and ours as a share of theirs.

    Args:
        size, rays: of ours; theirs are the paper's.

    Raises:
        InputError: nerf-pytorch is not there, or fails.
    """
    told = {"version": version_of(checkout), "machine": machine()}
    context = multiprocessing.get_context("spawn")
    pipes, seconds = {}, {"theirs": [], "ours": []}
    for who, train, more in (("theirs", _theirs, (checkout,)), ("ours", _ours, (size, rays))):
        pipes[who], end = context.Pipe()
        context.Process(target=train, args=(end, data.resolve(), *more), daemon=True).start()
        end.close()
    try:
        for _ in range(FORGOTTEN + rounds):
            for who, pipe in pipes.items():
                pipe.send("go")
                seconds[who].append(round(pipe.recv(), 3))
    except (EOFError, BrokenPipeError):
        raise InputError(f"--checkout {checkout}: nerf-pytorch does not train; see edge-se bench beside") from None
    medians = {who: statistics.median(values[FORGOTTEN:]) for who, values in seconds.items()}
    return {**told, "seconds": seconds, "medians": medians, "ratio": round(medians["ours"] / medians["theirs"], 3)}


def _ours(pipe: Connection, data: Path, size: Literal["paper", "tiny"], rays: int) -> None:
    config = method_configs()["vanilla-nerf"]
    model = replace(config.pipeline.model, size=size)
    manager = replace(config.pipeline.datamanager, train_num_rays_per_batch=rays)
    pipeline = replace(config.pipeline, model=model, datamanager=manager)
    with _unseen() as folder:
        turn = _Turn(pipe)
        config = replace(config, data=data, output_dir=folder, max_num_iterations=1000, pipeline=pipeline)
        trainer = prepare(replace(config, machine=MachineConfig(device_type="cpu")))
        turn.begin()
        for step in range(trainer.planned_steps):
            trainer.train_iteration(step)
            turn.step_over(lambda: 0.0)


def _theirs(pipe: Connection, data: Path, checkout: Path) -> None:
    sys.path.insert(0, str(checkout.resolve()))
    with _unseen() as folder:
        PROGRAMS["nerf-pytorch"](
            Task("nerf-pytorch", checkout, "--precrop_iters 0", data, 0, Scale()), folder, _Turn(pipe)
        )


@contextlib.contextmanager
def _unseen() -> Iterator[Path]:
    """A folder for what a training writes; nothing is shown, and the end of the rounds ends it."""
    with (
        tempfile.TemporaryDirectory() as folder,
        open(os.devnull, "w") as nowhere,
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
        contextlib.suppress(TimeIsUp),
    ):
        yield Path(folder)


class _Turn(Clock):
    """In the place of a clock: a step waits until it is asked for, and tells how long it took."""

    def __init__(self, pipe: Connection) -> None:
        self.pipe, self._since = pipe, 0.0

    def begin(self) -> None:
        try:
            self.pipe.recv()
        except EOFError:
            raise TimeIsUp from None
        self._since = time.perf_counter()

    def step_over(self, psnr: Callable[[], float]) -> None:
        del psnr
        self.pipe.send(time.perf_counter() - self._since)
        self.begin()
