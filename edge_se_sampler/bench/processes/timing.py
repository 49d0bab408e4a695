"""Training steps of one process and of several, timed in turns."""

from __future__ import annotations

import multiprocessing
import os
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from contextlib import contextmanager
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch.distributed import TCPStore  # pyright: ignore[reportPrivateImportUsage]

from edge_se_sampler import ranks
from edge_se_sampler.bench.machine import median_milliseconds
from edge_se_sampler.bench.results import Run
from edge_se_sampler.bench.runner import initialize_worker
from edge_se_sampler.bench.train import cached_scene
from edge_se_sampler.engine.config import MANAGER, override
from edge_se_sampler.engine.session import prepare
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.errors import check_value
from edge_se_sampler.methods import method_configs

STEPS = {"vanilla-nerf": 2, "lean-nerf": 20}
"""Of a round, by method: lean-nerf's are short."""


def measure(workplace: Path, processes: int, rays: tuple[int, ...], rounds: int) -> list[Run]:
    """Median milliseconds of a step in `one` process and in `several`, for each method and number of rays. InputError
    if there are fewer threads than processes."""
    threads, runs = torch.get_num_threads(), []
    check_value("processes", processes, 2 <= processes <= threads, f"at least 2, and at most {threads}, the threads")
    data = cached_scene(workplace, "bricks", num_train=10, num_val=1, num_test=1)
    with (
        tempfile.TemporaryDirectory() as folder,
        start_ranks(1, threads) as one,
        start_ranks(processes, threads // processes) as several,
    ):
        for (method, steps), count in product(STEPS.items(), sorted({*rays})):
            arguments = (method, count, (1 + rounds) * steps, data, Path(folder))
            calls = {"one": one, "several": several}
            cases = {name: partial(call, train_round, *arguments) for name, call in calls.items()}
            times = {name: value / steps for name, value in median_milliseconds(cases, rounds).items()}
            runs.append({"method": method, "rays": count, "steps": steps, "milliseconds": times})
    return runs


@contextmanager
def start_ranks(count: int, threads: int) -> Iterator[Callable[..., list[Any]]]:
    """Start processes that train together, with so many threads each. Yields what calls a function in all of them and
    returns its values; it must end in none before it has begun in all, as where it adds up gradients. ConnectionError:
    one of them was killed."""
    store = TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(count, spawn, _join_ranks, (count, threads, store.port)) as pool:

        def call(*function: Any) -> list[Any]:
            return [future.result() for future in [pool.submit(*function) for _ in range(count)]]

        try:
            yield call
        except BrokenExecutor:
            raise ConnectionError("a process was killed; is there too little memory?") from None
        except BaseException:
            for child in multiprocessing.active_children():  # they may wait for each other
                child.terminate()
            raise


def _join_ranks(count: int, threads: int, port: int) -> None:
    """Become one of the ranks, as if torchrun, which keeps the store that they meet at, had started this process."""
    initialize_worker()
    torch.set_num_threads(threads)
    rank = TCPStore("127.0.0.1", port).add("ranks", 1) - 1
    names = {"WORLD_SIZE": count, "RANK": rank, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    names |= {"TORCHELASTIC_USE_AGENT_STORE": True, "TORCHELASTIC_RESTART_COUNT": 0}
    os.environ.update({name: str(value) for name, value in names.items()})
    ranks.join("cpu")


def train_round(method: str, rays: int, iterations: int, data: Path, runs: Path, number: int) -> None:
    """The steps of a round, in all ranks; before the first, set up the training."""
    trainer = prepare_trainer(method, rays, iterations, data, runs)
    for step in range(number * STEPS[method], (number + 1) * STEPS[method]):
        trainer.train_iteration(step)


@lru_cache(1)
def prepare_trainer(method: str, rays: int, iterations: int, data: Path, runs: Path) -> Trainer:
    changes = {"data": data, "output_dir": runs, "machine.device_type": "cpu", "max_num_iterations": iterations}
    return prepare(override(method_configs()[method], changes | {f"{MANAGER}.train_num_rays_per_batch": rays}))
