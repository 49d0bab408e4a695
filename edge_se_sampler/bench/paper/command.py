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
        from edge_se_sampler.bench.paper.published import SCENES
        from edge_se_sampler.bench.paper.scenes import check_data, real_scene
        from edge_se_sampler.bench.paper.trials import PRESETS, TABLES, Trial, list_trials, run_trial, synthetic_scene
        from edge_se_sampler.bench.runner import Experiment
        from edge_se_sampler.bench.strategies import LABELS

        check_known("tables", self.tables, TABLES)
        check_known("scenes", self.scenes, SCENES)
        check_known("strategies", self.strategies, LABELS)
        if (self.data is None) != (self.preset == "cpu"):
            raise InputError("--preset paper needs --data, a NeRF-synthetic folder; --preset cpu renders its scenes")
        settings = PRESETS[self.preset]
        trials = list_trials(self.tables, self.scenes, self.strategies, self.seeds)
        if not trials:
            raise InputError("--tables and --strategies: no chosen table has a chosen strategy")
        if self.data is not None:
            check_data(self.data, self.scenes or SCENES)

        def arguments(trial: Trial) -> tuple[object, ...]:
            if self.data is None:
                data = synthetic_scene(trial.table, trial.scene, settings, self.workplace)
            else:
                data = real_scene(self.data, trial.scene, TABLES[trial.table].placement, self.workplace)
            return settings, data, self.workplace

        return Experiment("paper", settings, lambda _: trials, run_trial, arguments)
