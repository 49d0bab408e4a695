"""`edge-se bench step`: the dense faithful training step (1024 rays, two networks of 8 x 256, 64 + 128 samples) against
nerf-pytorch's. Each program trains in a process of its own, on all cores; they take a step in turn.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.baselines.results import BaselineSettings
from edge_se_sampler.bench.baselines.run import PROGRAMS, Clock, Task, TimeIsUp, silent_folder, version_of
from edge_se_sampler.bench.overrides import MANAGER, MODEL, override
from edge_se_sampler.bench.scenes import cached_scene
from edge_se_sampler.bench.timing import time_interleaved
from edge_se_sampler.engine.session import prepare
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs

WARMUP = 2
"""Steps of each before those that count: the first ones read the data and take memory from the system."""


def measure(checkout: Path, workplace: Path, rounds: int, size: str = "paper", rays: int = 1024) -> dict[str, Any]:
    """Seconds per step of nerf-pytorch and of vanilla-nerf, as `seconds`, and `nerf_pytorch_version`.

    Args:
        checkout: of nerf-pytorch.
        rounds: timed steps of each.
        size, rays: of vanilla-nerf; nerf-pytorch's are the paper's.

    Raises:
        InputError: nerf-pytorch is not there, or fails.
    """
    version, data = version_of(checkout), cached_scene(workplace, "bricks").resolve()
    context = multiprocessing.get_context("spawn")
    programs = {"nerf-pytorch": (_train_nerf_pytorch, checkout.resolve()), "vanilla-nerf": (_train_ours, size, rays)}
    steps: dict[str, Callable[[int], Any]] = {}
    for name, program in programs.items():
        pipe, other_end = context.Pipe()
        context.Process(target=_train_in_turns, args=(other_end, data, *program), daemon=True).start()
        other_end.close()
        steps[name] = lambda _, pipe=pipe: (pipe.send("step"), pipe.recv())
    try:
        seconds = time_interleaved(steps, rounds, WARMUP)
    except (EOFError, BrokenPipeError):
        raise InputError(f"--checkout {checkout}: nerf-pytorch does not train; see edge-se bench baselines") from None
    return {"nerf_pytorch_version": version, "seconds": seconds}


def _train_in_turns(pipe: Connection, data: Path, train: Callable[..., None], *options: Any) -> None:
    with contextlib.suppress(TimeIsUp), silent_folder() as folder:
        train(_Turns(pipe), data, folder, *options)


def _train_ours(turns: _Turns, data: Path, folder: Path, size: str, rays: int) -> None:
    changes = {"data": data, "output_dir": folder, "max_num_iterations": 1000, "machine.device_type": "cpu"}
    changes |= {f"{MODEL}.size": size, f"{MANAGER}.train_num_rays_per_batch": rays}
    trainer = prepare(override(method_configs()["vanilla-nerf"], changes))
    turns.start()
    for step in range(trainer.planned_steps):
        trainer.train_iteration(step)
        turns.after_step(lambda: 0.0)


def _train_nerf_pytorch(turns: _Turns, data: Path, folder: Path, checkout: Path) -> None:
    sys.path.insert(0, str(checkout))
    settings = BaselineSettings(program="nerf-pytorch", flags="--precrop_iters 0", program_version="")
    PROGRAMS["nerf-pytorch"](Task(settings, checkout, data, seed=0), folder, turns)


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
