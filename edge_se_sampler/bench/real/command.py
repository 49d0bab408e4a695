"""edge-se bench real. Torch-free until it runs."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path

from edge_se_sampler.bench.command import ExperimentCommand, find_scene
from edge_se_sampler.bench.runner import Experiment
from edge_se_sampler.errors import check_known, check_value


@dataclass(frozen=True, kw_only=True)
class BenchReal(ExperimentCommand):
    """Train lean-nerf on real scenes with time budgets, one training at a time on all cores; tabulate and chart test
    PSNR beside the baselines in the folder. Resumes."""

    scenes_dir: Path
    """Folder of scenes in any format that edge-se train reads: Blender folders, such as NeRF-synthetic's (lego, chair,
    ...) with their official splits, or captures, every 8th image of which is held out."""
    scenes: tuple[str, ...] = ("lego", "chair")
    """Folders in it."""
    downscales: tuple[int, ...] = (2,)
    """Every so many pixels along both axes become one."""
    budgets: tuple[str, ...] = ("1m", "3m")
    """Time budgets, as in edge-se train, or numbers of steps ("2000 steps"), the same on any machine."""
    variants: tuple[str, ...] = ("lean-nerf",)
    """By their labels in the page; one thing is changed in each."""
    workers: int | None = None
    """Trainings at once, which share the cores; left out, one on all of them."""

    def experiment(self) -> Experiment:
        from edge_se_sampler.bench.real.trials import VARIANTS, Settings, Trial, run_trial, training_length
        from edge_se_sampler.engine.config import override
        from edge_se_sampler.methods import method_configs

        check_known("variants", self.variants, VARIANTS)
        check_value("downscales", self.downscales, min(self.downscales, default=0) >= 1, "at least 1 each")
        for budget in self.budgets:
            override(method_configs()["lean-nerf"], training_length(budget)).check_plan()
        for scene in self.scenes:
            find_scene(self.scenes_dir, scene)
        every = product(self.seeds, self.downscales, self.budgets, self.scenes, self.variants)
        trials = [Trial(scene, down, budget, variant, seed) for seed, down, budget, scene, variant in every]
        settings, at_once = Settings(), self.workers or self.default_workers()
        arguments = self.scenes_dir.resolve(), self.workplace.resolve(), settings, at_once
        return Experiment("real", settings, lambda _: trials, run_trial, lambda _: arguments)

    def default_workers(self) -> int:
        return 1
