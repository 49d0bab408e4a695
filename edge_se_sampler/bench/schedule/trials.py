"""The trainings that test the adaptive schedule: does one fail, and is it as good as the best fixed early phase.

arm   "random": Random. "adaptive": Edge + SE under the adaptive schedule, dead networks reinitialized.
      "0.02" ... "0.5": the same with an early phase of that share of the iterations
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

from edge_se_sampler.bench.paper import trials as paper
from edge_se_sampler.bench.paper.published import SCENES
from edge_se_sampler.bench.results import Run
from edge_se_sampler.bench.train import train_and_measure
from edge_se_sampler.engine.config import SAMPLER, TrainerConfig, override

SHARES = ("0.02", "0.05", "0.1", "0.2", "0.5")
CONFIGURATIONS = (1, 2, 5, 6)
"""Tables of `bench paper`: NeRF with all views or ten, centred or off centre."""
LENGTHS = (300, 1000, 3000, 10_000)
SCENES_OF_LENGTHS = ((1, "drums"), (1, "bricks"), (2, "chair"), (2, "mic"))
"""Table and scene; two centred, two off centre."""


@dataclass(frozen=True)
class Settings:
    """How large the experiment is; the rest is as in `bench paper`."""

    iterations: int = 500
    """Of the part "failures"."""


@dataclass(frozen=True)
class Trial:
    """One training."""

    part: Literal["failures", "lengths"]
    table: int
    scene: str
    iterations: int
    arm: str
    seed: int


def list_failure_trials(settings: Settings, seeds: Sequence[int]) -> list[Trial]:
    """Random and the adaptive schedule in 28 configurations, paired seed by seed."""
    every = product(seeds, CONFIGURATIONS, SCENES, ("random", "adaptive"))
    return [Trial("failures", table, scene, settings.iterations, arm, seed) for seed, table, scene, arm in every]


def list_length_trials(runs: list[Run], seeds: Sequence[int]) -> list[Trial]:
    """Every fixed share of every planned length on the seeds of selection; where all of those have been trained, the
    best share and the adaptive schedule, paired, on the seeds that are reported."""
    trials, scores = [], score_shares(runs)
    for length in LENGTHS:
        every: list[Any] = [*product(selection_seeds(length), SCENES_OF_LENGTHS, SHARES)]
        if length in scores:
            every += product(seeds, SCENES_OF_LENGTHS, (best_share(scores[length]), "adaptive"))
        trials += [Trial("lengths", table, scene, length, arm, seed) for seed, (table, scene), arm in every]
    return trials


def selection_seeds(length: int) -> tuple[int, ...]:
    """Seeds on which the fixed share is selected: two, but one where a training is long."""
    return (100, 101) if length < LENGTHS[-1] else (100,)


def psnrs_by_trial(runs: list[Run], length: int) -> dict[tuple[str, int, str, int], float]:
    """(arm, table, scene, seed) -> PSNR of the runs of a planned length."""
    return {
        (run["arm"], run["table"], run["scene"], run["seed"]): run["psnr"]
        for run in runs
        if (run["part"], run["iterations"]) == ("lengths", length)
    }


def score_shares(runs: list[Run]) -> dict[int, dict[str, float]]:
    """Planned length -> fixed share -> mean PSNR on the seeds of selection; only lengths of which all are trained."""
    scores = {}
    for length in LENGTHS:
        keys = [(table, scene, seed) for seed in selection_seeds(length) for table, scene in SCENES_OF_LENGTHS]
        psnrs = psnrs_by_trial(runs, length)
        if all((share, *key) in psnrs for share in SHARES for key in keys):
            scores[length] = {share: statistics.mean(psnrs[(share, *key)] for key in keys) for share in SHARES}
    return scores


def best_share(scores: dict[str, float]) -> str:
    return max(scores, key=scores.__getitem__)


def build_config(trial: Trial, data: Path, output_dir: Path) -> TrainerConfig:
    strategy = "vanilla-nerf" if trial.arm == "random" else "edge-se-nerf"
    settings = replace(paper.Settings(), iterations=trial.iterations)
    paper_trial = paper.Trial(trial.table, trial.scene, strategy, trial.seed)
    changes: dict[str, Any] = {"experiment_name": "-".join(map(str, asdict(trial).values()))}
    if trial.arm == "adaptive":
        changes |= {f"{SAMPLER}.schedule": "adaptive", "reinit_dead": True}
    elif trial.arm != "random":
        changes |= {f"{SAMPLER}.early_fraction": float(trial.arm), "reinit_dead": True}
    return override(paper.build_config(paper_trial, settings, data, output_dir), changes)


def run_trial(trial: Trial, data: Path, output_dir: Path) -> Run:
    """Train a trial and measure it."""
    return train_and_measure(build_config(trial, data, output_dir))
