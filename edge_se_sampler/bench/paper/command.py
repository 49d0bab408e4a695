"""`edge-se bench paper`. Torch-free until it runs."""

from __future__ import annotations

from dataclasses import dataclass

from edge_se_sampler.bench.command import ExperimentCommand
from edge_se_sampler.bench.runner import Experiment
from edge_se_sampler.errors import InputError, check_known


@dataclass(frozen=True, kw_only=True)
class BenchPaper(ExperimentCommand):
    """Reproduce the paper's tables and figures; test its claims. Writes result.json, README.md, pictures; resumes."""

    tables: tuple[int, ...] = ()
    """1 to 4 are the paper's, 5 to 18 ours (configs/paper/README.md has their titles); none: all."""
    scenes: tuple[str, ...] = ()
    """Of the seven synthetic ones, Lego under the name bricks; none: all."""
    strategies: tuple[str, ...] = ()
    """Of the paper's six, under the methods' names; none: all."""

    def experiment(self) -> Experiment:
        from edge_se_sampler.bench.paper import trials as paper

        check_known("tables", self.tables, paper.TABLES)
        check_known("scenes", self.scenes, paper.SCENES)
        check_known("strategies", self.strategies, paper.LABELS)
        trials = paper.list_trials(self.tables, self.scenes, self.strategies, self.seeds)
        if not trials:
            raise InputError("--tables and --strategies: no chosen table has a chosen strategy")
        settings = paper.Settings()

        def arguments(trial: paper.Trial) -> tuple[object, ...]:
            data = paper.synthetic_scene(trial.table, trial.scene, settings, self.workplace)
            return settings, data, self.workplace

        return Experiment("paper", settings, lambda _: trials, paper.run_trial, arguments)
