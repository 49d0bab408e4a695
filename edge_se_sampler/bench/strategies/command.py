"""edge-se bench strategies. Torch-free until it runs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from edge_se_sampler.bench.command import ExperimentCommand, find_scene
from edge_se_sampler.bench.runner import Experiment
from edge_se_sampler.errors import InputError, check_known, check_value

if TYPE_CHECKING:
    from edge_se_sampler.bench.strategies.trials import Trial


@dataclass(frozen=True, kw_only=True)
class BenchStrategies(ExperimentCommand):
    """Compare every way of choosing pixels with uniform pixels: real scenes, equal steps and equal CPU seconds; NeRF,
    lean-nerf with and without masks, and nerfstudio's nerfacto. Resumes."""

    scenes_dir: Path
    """Folder of Blender scenes, such as NeRF-synthetic's (lego, chair, ...) with their official splits, and of
    captures."""
    models: tuple[Literal["nerf", "lean", "lean-no-masks", "nerfacto"], ...] = ("nerf", "lean", "lean-no-masks")
    """NeRF of size tiny; lean-nerf; lean-nerf on images without alpha; a small nerfacto, which needs all of nerfstudio
    1.1.5 in the same environment."""
    scenes: tuple[str, ...] = ("lego", "chair")
    """Folders in it."""
    captures: tuple[str, ...] = ()
    """Captures in it that lean-no-masks and nerfacto are trained on, too, as they are: centered, at the coarsest of the
    downscales."""
    downscales: tuple[int, ...] = (8, 4)
    """Every so many pixels along both axes become one."""
    placements: tuple[Literal["centered", "shifted"], ...] = ("centered", "shifted")
    """The scene as it is, or its copy by `edge-se offcenter`."""
    plans: tuple[Literal["seconds", "steps"], ...] = ("seconds", "steps")
    """Equal CPU seconds (NeRF and nerfacto 60) or equal steps (300, lean-nerf 800)."""
    lean_seconds: int = 10
    """CPU seconds of lean-nerf's trainings; more for larger images, into a folder of their own."""
    strategies: tuple[str, ...] = ()
    """Ways of choosing pixels; none: all. --dry-run lists their names."""

    def experiment(self) -> Experiment:
        from edge_se_sampler.bench.baselines.folders import copied_scene
        from edge_se_sampler.bench.nerfstudio.host import require_nerfstudio
        from edge_se_sampler.bench.strategies.train import run_trial
        from edge_se_sampler.bench.strategies.trials import (
            NERFACTO,
            OF_CAPTURES,
            STRATEGIES,
            Settings,
            list_trials,
        )
        from edge_se_sampler.bench.train import offcenter_copies

        check_known("strategies", self.strategies, STRATEGIES)
        check_value("downscales", self.downscales, min(self.downscales, default=0) >= 1, "at least 1 each")
        if NERFACTO in self.models:
            require_nerfstudio("--models nerfacto")
        captured = [model for model in self.models if model in OF_CAPTURES]
        if self.captures and not captured:
            raise InputError(f"--captures: add {' or '.join(OF_CAPTURES)} to --models, which alone are trained on them")
        check_value("lean-seconds", self.lean_seconds, self.lean_seconds > 0, "above 0")
        folders = {scene: find_scene(self.scenes_dir, scene) for scene in (*self.scenes, *self.captures)}
        lean = replace(Settings.lean, seconds=self.lean_seconds)
        settings, workplace = Settings(lean=lean), self.workplace.resolve()
        chosen = self.strategies or tuple(STRATEGIES)
        trials = list_trials(self.models, self.scenes, self.downscales, self.placements, self.plans, chosen, self.seeds)
        coarsest = (max(self.downscales),)
        trials += list_trials(captured, self.captures, coarsest, ("centered",), self.plans, chosen, self.seeds)

        def arguments(trial: Trial) -> tuple[Settings, Path]:
            scene = folders[trial.scene]
            data = scene if trial.placement == "centered" else offcenter_copies(scene, workplace) / "shifted"
            return settings, copied_scene(workplace, data, trial.downscale) if trial.model == NERFACTO else data

        return Experiment("strategies", settings, lambda _: trials, run_trial, arguments)
