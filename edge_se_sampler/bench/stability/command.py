"""edge-se bench stability. Torch-free until it runs."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path

from edge_se_sampler.bench.command import ExperimentCommand
from edge_se_sampler.bench.runner import Experiment
from edge_se_sampler.errors import InputError, check_known


@dataclass(frozen=True, kw_only=True)
class BenchStability(ExperimentCommand):
    """Count failed trainings by sampling strategy and setting (size and place of the object, background, density,
    initial weights, ...). Resumes."""

    settings: tuple[str, ...] = ()
    """By the labels that --dry-run lists, e.g. "off centre, 10 views"; none: all 24, and those of real scenes where
    --scenes-dir is given."""
    scenes_dir: Path | None = None
    """Folder with NeRF-synthetic's folders lego and chair."""
    strategies: tuple[str, ...] = ()
    """The paper's six by method, reinit and adaptive; none: all."""
    seeds: tuple[int, ...] = tuple(range(10))
    """Of weights, pixels and jitter."""

    def experiment(self) -> Experiment:
        from edge_se_sampler.bench.stability.settings import SETTINGS, STRATEGIES, SYNTHETIC_SETTINGS, Trial
        from edge_se_sampler.bench.stability.train import TrainingSize, run_trial

        check_known("settings", self.settings, SETTINGS)
        check_known("strategies", self.strategies, STRATEGIES)
        chosen = self.settings or (SYNTHETIC_SETTINGS if self.scenes_dir is None else SETTINGS)
        for scene in {SETTINGS[label].scene or "" for label in chosen} - {""}:
            if self.scenes_dir is None:
                raise InputError("--settings of real scenes need --scenes-dir, the folder of NeRF-synthetic's scenes")
            if not (self.scenes_dir / scene).is_dir():
                raise InputError(f"--scenes-dir {self.scenes_dir}: has no folder {scene}; give the scenes' folder")
        # seed by seed, so that an unfinished sweep covers all settings and strategies
        every = product(self.seeds, chosen, self.strategies or STRATEGIES)
        trials = [Trial(setting, strategy, seed) for seed, setting, strategy in every]
        size, scenes_dir = TrainingSize(), self.scenes_dir and self.scenes_dir.resolve()
        return Experiment("stability", size, lambda _: trials, run_trial, lambda _: (size, scenes_dir))
