"""edge-se bench stability. Torch-free until it runs."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path

from edge_se_sampler.bench.command import ExperimentCommand, find_scene
from edge_se_sampler.bench.runner import Experiment
from edge_se_sampler.errors import check_known


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
        scenes = {scene for label in chosen if (scene := SETTINGS[label].scene) is not None}
        folders = {scene: find_scene(self.scenes_dir, scene) for scene in scenes}
        # seed by seed, so that an unfinished sweep covers all settings and strategies
        every = product(self.seeds, chosen, self.strategies or STRATEGIES)
        trials = [Trial(setting, strategy, seed) for seed, setting, strategy in every]
        size = TrainingSize()

        def arguments(trial: Trial) -> tuple[object, ...]:
            return size, folders.get(SETTINGS[trial.setting].scene or "")

        return Experiment("stability", size, lambda _: trials, run_trial, arguments)
