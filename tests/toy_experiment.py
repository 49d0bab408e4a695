"""An experiment that trains nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.results import Run
from edge_se_sampler.bench.runner import Experiment


@dataclass(frozen=True)
class ToySettings:
    steps: int = 3


@dataclass(frozen=True)
class ToyTrial:
    scene: str
    seed: int


TRIALS = [ToyTrial("mic", seed) for seed in range(3)]


def train(trial: ToyTrial, *_: Any) -> Run:
    return {"psnr": 20.0 + trial.seed}


def toy_experiment(
    train: Callable[..., Run] = train,
    trials: Callable[[list[Run]], list[ToyTrial]] = lambda _: TRIALS,
    steps: int = 3,
    arguments: tuple[Any, ...] = (),
) -> Experiment:
    return Experiment("toy", ToySettings(steps), trials, train, lambda _: arguments)


def one_thread() -> Executor:
    return ThreadPoolExecutor(1)


def read(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "result.json").read_text())
