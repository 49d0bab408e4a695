"""edge-se bench nerfstudio. Torch-free until it runs."""

from __future__ import annotations

from dataclasses import dataclass

from edge_se_sampler.bench.command import ExperimentCommand
from edge_se_sampler.bench.runner import Experiment


@dataclass(frozen=True, kw_only=True)
class BenchNerfstudio(ExperimentCommand):
    """Count failed trainings inside nerfstudio, with its own pixel sampler and with Edge + SE. Needs nerfstudio 1.1.5
    in the same environment. Resumes."""

    seeds: tuple[int, ...] = tuple(range(10))
    """Of weights, pixels and jitter."""

    def experiment(self) -> Experiment:
        from importlib.metadata import version

        from edge_se_sampler.bench.nerfstudio.host import require_nerfstudio
        from edge_se_sampler.bench.nerfstudio.train import METHODS, SCENE_OPTIONS, TrainingSettings, Trial, run_trial
        from edge_se_sampler.bench.train import cached_scene

        require_nerfstudio("bench nerfstudio")
        settings = TrainingSettings(nerfstudio=version("nerfstudio"))
        trials = [Trial(method, seed) for seed in self.seeds for method in METHODS]

        def arguments(_: Trial) -> tuple[object, ...]:
            return settings, cached_scene(self.workplace, settings.scene, **SCENE_OPTIONS), self.workplace

        return Experiment("nerfstudio", settings, lambda _: trials, run_trial, arguments)

    def default_workers(self) -> int:
        """One: a training uses as many threads as torch takes."""
        return 1
