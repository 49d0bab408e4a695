"""`edge-se bench step`: the dense faithful training step (1024 rays, two networks of 8 x 256, 64 + 128 samples) against
nerf-pytorch's. Each program trains in a process of its own, on all cores; they take a step in turn.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.baselines.results import BaselineSettings
from edge_se_sampler.bench.baselines.run import PROGRAMS, Clock, Task, TimeIsUp, version_of
from edge_se_sampler.bench.overrides import MANAGER, MODEL, override
from edge_se_sampler.bench.timing import time_interleaved
from edge_se_sampler.engine.session import prepare
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs

WARMUP = 2
"""Steps of each before those that count: the first ones read the data and take memory from the system."""


def measure_step(checkout: Path, data: Path, rounds: int, size: str = "paper", rays: int = 1024) -> dict[str, Any]:
    """Seconds per step of nerf-pytorch and of vanilla-nerf, as `seconds`, and `nerf_pytorch_version`.

    Args:
        checkout: of nerf-pytorch.
        data: a Blender folder.
        rounds: timed steps of each.
        size, rays: of vanilla-nerf; nerf-pytorch's are the paper's.

    Raises:
        InputError: nerf-pytorch is not there, or fails.
    """
    version = version_of(checkout)
    context = multiprocessing.get_context("spawn")
    programs = {"nerf-pytorch": (_train_nerf_pytorch, checkout), "vanilla-nerf": (_train_ours, size, rays)}
    steps: dict[str, Callable[[int], Any]] = {}
    for name, (train, *options) in programs.items():
        pipe, other_end = context.Pipe()
        context.Process(target=train, args=(other_end, data.resolve(), *options), daemon=True).start()
        other_end.close()
        steps[name] = lambda _, pipe=pipe: (pipe.send("step"), pipe.recv())
    try:
        seconds = time_interleaved(steps, rounds, WARMUP)
    except (EOFError, BrokenPipeError):
        raise InputError(f"--checkout {checkout}: nerf-pytorch does not train; see edge-se bench baselines") from None
    return {"nerf_pytorch_version": version, "seconds": seconds}


def _train_ours(pipe: Connection, data: Path, size: str, rays: int) -> None:
    with _silent_folder() as folder:
        changes = {"data": data, "output_dir": folder, "max_num_iterations": 1000, "machine.device_type": "cpu"}
        changes |= {f"{MODEL}.size": size, f"{MANAGER}.train_num_rays_per_batch": rays}
        trainer = prepare(override(method_configs()["vanilla-nerf"], changes))
        turns = _Turns(pipe)
        turns.start()
        for step in range(trainer.planned_steps):
            trainer.train_iteration(step)
            turns.after_step(lambda: 0.0)


def _train_nerf_pytorch(pipe: Connection, data: Path, checkout: Path) -> None:
    sys.path.insert(0, str(checkout.resolve()))
    with _silent_folder() as folder:
        settings = BaselineSettings(program="nerf-pytorch", flags="--precrop_iters 0", program_version="")
        task = Task(settings, checkout, data, seed=0)
        PROGRAMS["nerf-pytorch"](task, folder, _Turns(pipe))


@contextlib.contextmanager
def _silent_folder() -> Iterator[Path]:
    """A temporary folder for what a training writes; it prints nothing, and ends with the last round."""
    with (
        tempfile.TemporaryDirectory() as folder,
        open(os.devnull, "w") as devnull,
        contextlib.redirect_stdout(devnull),
        contextlib.redirect_stderr(devnull),
        contextlib.suppress(TimeIsUp),
    ):
        yield Path(folder)


class _Turns(Clock):
    """Instead of a clock: every step waits for a message, and is answered when it is over."""

    def __init__(self, pipe: Connection) -> None:
        self.pipe = pipe

    def start(self) -> None:
        try:
            self.pipe.recv()
        except EOFError:
            raise TimeIsUp from None

    def after_step(self, psnr: Callable[[], float]) -> None:
        del psnr
        self.pipe.send("done")
        self.start()
