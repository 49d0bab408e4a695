"""`edge-se bench schedule`. Torch-free until it runs."""

from __future__ import annotations

from dataclasses import dataclass

from edge_se_sampler.bench.command import ExperimentCommand
from edge_se_sampler.bench.results import Run
from edge_se_sampler.bench.runner import Experiment
from edge_se_sampler.errors import InputError


@dataclass(frozen=True, kw_only=True)
class BenchSchedule(ExperimentCommand):
    """Test the adaptive schedule: failures, paired with Random's, and PSNR against the best fixed early phase.
    Resumes."""

    seeds: tuple[int, ...] = tuple(range(10))
    """Of the test of failures."""
    length_seeds: tuple[int, ...] = (0, 1, 2)
    """Of the comparison with fixed early phases, over planned lengths; the best fixed one is selected on others."""

    def experiment(self) -> Experiment:
        from edge_se_sampler.bench.paper import trials as paper
        from edge_se_sampler.bench.schedule import trials as schedule

        if overlap := sorted(set(self.length_seeds) & set(schedule.selection_seeds(schedule.LENGTHS[0]))):
            raise InputError(f"--length-seeds: the fixed phase is selected on {overlap}; name others")
        settings = schedule.Settings()

        def trials(runs: list[Run]) -> list[schedule.Trial]:
            failures = schedule.list_failure_trials(settings, self.seeds)
            return failures + schedule.list_length_trials(runs, self.length_seeds)

        def arguments(trial: schedule.Trial) -> tuple[object, ...]:
            data = paper.synthetic_scene(trial.table, trial.scene, paper.Settings(), self.workplace)
            return data, self.workplace / "runs"

        return Experiment("schedule", settings, trials, schedule.run_trial, arguments)
