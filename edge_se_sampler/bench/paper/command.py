"""`edge-se bench paper`. Torch-free until it runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from edge_se_sampler.bench.command import ExperimentCommand, find_scene
from edge_se_sampler.bench.runner import Experiment
from edge_se_sampler.errors import InputError, check_known


@dataclass(frozen=True, kw_only=True)
class BenchPaper(ExperimentCommand):
    """Reproduce the paper's tables and figures; test its claims. Writes result.json, README.md, pictures; resumes."""

    tables: tuple[int, ...] = ()
    """1 to 4 are the paper's, 5 to 18 ours (configs/paper/README.md has their titles); none: all."""
    scenes: tuple[str, ...] = ()
    """Of the seven synthetic ones, Lego under the name bricks, and real-lego and real-chair; none: all, the real ones
    where --scenes-dir is given."""
    scenes_dir: Path | None = None
    """Folder with NeRF-synthetic's folders lego and chair."""
    strategies: tuple[str, ...] = ()
    """Of the paper's six, under the methods' names; none: all."""

    def experiment(self) -> Experiment:
        from edge_se_sampler.bench.paper import trials as paper

        check_known("tables", self.tables, paper.TABLES)
        check_known("scenes", self.scenes, (*paper.SCENES, *paper.REAL_SCENES))
        check_known("strategies", self.strategies, paper.LABELS)
        scenes = self.scenes or (*paper.SCENES, *(paper.REAL_SCENES if self.scenes_dir else ()))
        folders = {
            scene: find_scene(self.scenes_dir, scene.removeprefix("real-"))
            for scene in scenes
            if scene in paper.REAL_SCENES
        }
        trials = paper.list_trials(self.tables, scenes, self.strategies, self.seeds)
        if not trials:
            raise InputError("--tables and --strategies: no chosen table has a chosen strategy")
        settings = paper.Settings()

        def arguments(trial: paper.Trial) -> tuple[object, ...]:
            if real := folders.get(trial.scene):
                data = paper.placed_copy(trial.table, real, self.workplace)
            else:
                data = paper.synthetic_scene(trial.table, trial.scene, settings, self.workplace)
            return settings, data, self.workplace

        return Experiment("paper", settings, lambda _: trials, paper.run_trial, arguments)
