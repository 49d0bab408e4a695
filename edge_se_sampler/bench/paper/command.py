"""`edge-se bench paper`. Torch-free until it runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from edge_se_sampler.bench.command import ExperimentCommand
from edge_se_sampler.errors import InputError, check_known

if TYPE_CHECKING:
    from edge_se_sampler.bench.runner import Experiment


@dataclass(frozen=True, kw_only=True)
class BenchPaper(ExperimentCommand):
    """Reproduce the paper's tables and figures; test its claims. Writes result.json, README.md, pictures; resumes."""

    preset: Literal["cpu", "paper"] = "cpu"
    """Synthetic scenes, small enough for a CPU; or the paper's own size, for --data."""
    data: Path | None = None
    """A NeRF-synthetic folder (chair, drums, ficus, hotdog, lego, materials, mic), for --preset paper."""
    tables: tuple[int, ...] = ()
    """1 to 4 are the paper's, 5 to 18 ours (configs/paper/README.md has their titles); none: all."""
    scenes: tuple[str, ...] = ()
    """Of the seven, Lego under the name bricks; none: all."""
    strategies: tuple[str, ...] = ()
    """Of the paper's six, under the methods' names; none: all."""

    def experiment(self) -> Experiment:
        from edge_se_sampler.bench.paper import trials as paper
        from edge_se_sampler.bench.runner import Experiment

        check_known("tables", self.tables, paper.TABLES)
        check_known("scenes", self.scenes, paper.SCENES)
        check_known("strategies", self.strategies, paper.LABELS)
        if (self.data is None) != (self.preset == "cpu"):
            raise InputError("--preset paper needs --data, a NeRF-synthetic folder; --preset cpu renders its scenes")
        trials = paper.list_trials(self.tables, self.scenes, self.strategies, self.seeds)
        if not trials:
            raise InputError("--tables and --strategies: no chosen table has a chosen strategy")
        if self.data is not None:
            paper.check_data(self.data, self.scenes or paper.SCENES)
        settings = paper.PRESETS[self.preset]

        def arguments(trial: paper.Trial) -> tuple[object, ...]:
            if self.data is None:
                data = paper.synthetic_scene(trial.table, trial.scene, settings, self.workplace)
            else:
                placement = paper.TABLES[trial.table].placement
                data = paper.real_scene(self.data, trial.scene, placement, self.workplace)
            return settings, data, self.workplace

        return Experiment("paper", settings, lambda _: trials, paper.run_trial, arguments)
