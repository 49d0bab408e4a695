"""edge-se bench stability. Torch-free until it runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from edge_se_sampler.bench.command import ExperimentCommand
from edge_se_sampler.errors import check_known

if TYPE_CHECKING:
    from edge_se_sampler.bench.runner import Experiment


@dataclass(frozen=True, kw_only=True)
class BenchStability(ExperimentCommand):
    """Count failed trainings by sampling strategy and setting (size and place of the object, background, density,
    initial weights, ...). Resumes."""

    settings: tuple[str, ...] = ()
    """By the names of --dry-run, e.g. "off centre, 10 views"; none: all 24."""
    strategies: tuple[str, ...] = ()
    """The paper's six by method, reinit and adaptive; none: all."""
    seeds: tuple[int, ...] = tuple(range(10))
    """Of weights, pixels and jitter."""

    def experiment(self) -> Experiment:
        from edge_se_sampler.bench.runner import Experiment
        from edge_se_sampler.bench.stability.settings import SETTINGS, STRATEGIES, list_all_trials
        from edge_se_sampler.bench.stability.train import TrainingSize, run_trial

        check_known("settings", self.settings, SETTINGS)
        check_known("strategies", self.strategies, STRATEGIES)
        trials = list_all_trials(self.settings or SETTINGS, self.strategies or STRATEGIES, self.seeds)
        size, views = TrainingSize(), (self.workplace / "stability" / "views").resolve()
        return Experiment("stability", size, lambda _: trials, run_trial, lambda _: (size, views))
