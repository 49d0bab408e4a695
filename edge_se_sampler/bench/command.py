"""What the commands of all experiments have in common. Torch-free until one runs."""

from __future__ import annotations

import os
import sys
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

import tyro

from edge_se_sampler.bench.report import write_report
from edge_se_sampler.bench.runner import ALL, Experiment, Shard, executor_factory, list_trials, run_experiment
from edge_se_sampler.bench.statistics import require_scipy_stats
from edge_se_sampler.engine.figures import require_pyplot
from edge_se_sampler.errors import InputError, check_value


def find_scene(scenes_dir: Path | None, name: str) -> Path:
    """A scene's folder in --scenes-dir, absolute; InputError if it is not there, or no folder of scenes was given."""
    if scenes_dir is None:
        raise InputError(f"the scene {name} needs --scenes-dir, the folder of NeRF-synthetic's scenes")
    folder = scenes_dir.resolve() / name
    if not folder.is_dir():
        raise InputError(f"--scenes-dir {scenes_dir}: has no folder {name}; give the folder of the scenes")
    return folder


@dataclass(frozen=True, kw_only=True)
class ExperimentCommand(ABC):
    """Trains what its result.json lacks, then writes the report."""

    output_dir: Path
    """Where result.json, README.md and pictures go; trainings that it already has are kept."""
    workplace: Path = Path("bench")
    """Where scenes, runs and renderings are kept; workers on other machines must see it."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of weights, pixels and jitter."""
    workers: int | None = None
    """Trainings at once, one thread each; left out, as many as there are cores, or one where there is a GPU."""
    scheduler: str | None = None
    """Address of a dask scheduler whose workers train ([cluster] extra), instead of --workers; start those with
    one thread each, for CPU seconds are a process's."""
    shard: str | None = None
    """Train only a share of the trainings, as 2/8 does the second of eight, for job arrays: its result goes to
    OUTPUT_DIR/shards. The same command without it takes over what is there, trains the rest, and reports."""
    dry_run: tyro.conf.UseCounterAction[int] = 0
    """Only list the trainings and how many are pending; trains nothing, writes nothing."""

    @abstractmethod
    def experiment(self) -> Experiment:
        """What is trained; InputError if a flag's value has no meaning."""

    def run(self) -> None:
        """Train and report; InputError as `experiment`, `run_experiment` and `write_report`; exit code 1 if a training
        ended in an error."""
        check_value("seeds", "empty", bool(self.seeds), "at least one number")
        check_value("workers", self.workers, self.workers is None or self.workers > 0, "at least 1")
        experiment, shard = self.experiment(), Shard.parse(self.shard)
        if self.dry_run:
            list_trials(experiment, self.output_dir, shard)
            return
        require_pyplot()
        require_scipy_stats()
        new_executor = executor_factory(self.workers or self.default_workers(), self.scheduler)
        result = run_experiment(experiment, self.output_dir, new_executor, shard)
        page = shard.path(self.output_dir)
        if shard == ALL:
            write_report(self.output_dir, workplace=self.workplace)
            page = self.output_dir / "README.md"
        print(f"{len(result['runs'])} trainings; see {page}")
        if failed := len(result["errors"]):
            print(f"edge-se: {failed} failed, as said above; the same command tries them again", file=sys.stderr)
            sys.exit(1)

    def default_workers(self) -> int:
        """How many trainings at once if --workers is left out: as many as CPUs that this process may use; a GPU is one
        worker's."""
        import torch

        if torch.cuda.is_available():
            return 1
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
