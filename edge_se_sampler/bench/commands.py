"""The measuring commands, edge-se bench NAME. Torch-free until one runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from edge_se_sampler.bench.chart.commands import BenchBeside, BenchChart
from edge_se_sampler.bench.micro.command import BenchSamplers, BenchScoring, BenchStep
from edge_se_sampler.bench.stability.command import BenchStability
from edge_se_sampler.errors import InputError, check_known


@dataclass(frozen=True)
class BenchNerfstudio:
    """Count failures inside nerfstudio, with its own sampler and with ours; leave result.json. Resumes."""

    output_dir: Path
    """Where the result goes; runs that it already has are kept."""
    workplace: Path = Path("bench")
    """Where the scene and nerfstudio's runs are kept."""
    scene: str = "chair"
    """One of edge-se scenes."""
    seeds: tuple[int, ...] = tuple(range(10))
    """Of weights, pixels and jitter."""
    iterations: int = 1500
    """Of every run."""
    rays: int = 32
    """Pixels a step."""
    samples: int = 16
    """Coarse samples a ray, and as many importance samples."""

    def run(self) -> None:
        from edge_se_sampler.bench.nerfstudio import bench_nerfstudio

        if not self.seeds or min(self.iterations, self.rays, self.samples) < 1:
            raise InputError("--seeds, --iterations, --rays and --samples: at least one of each")
        result = bench_nerfstudio(
            self.output_dir, self.workplace, self.scene, self.seeds, self.iterations, self.rays, self.samples
        )
        for method, told in result["failures"].items():
            print(
                f"{method}: {told['failed']} of {told['runs']} failed, {told['at_background']} at the background; "
                f"{told['mean_psnr']:.2f} dB on average"
            )


@dataclass(frozen=True, kw_only=True)
class _Parallel:
    """What benches of many trainings have in common."""

    workers: int | None = None
    """Trainings at once, a thread each; left out, as many as there are cores, or one where there is a GPU."""
    scheduler: str | None = None
    """Address of a dask scheduler whose workers take them ([cluster] extra), instead of --workers; start those with
    one thread each, for CPU seconds are a process's."""

    def processes(self) -> int:
        """--workers, checked."""
        from edge_se_sampler.bench.experiment import default_workers

        if self.workers is not None and self.workers < 1:
            raise InputError(f"--workers is {self.workers}: give at least one")
        return self.workers or default_workers()


@dataclass(frozen=True, kw_only=True)
class BenchPaper(_Parallel):
    """Remake the paper's tables and figures, and judge its claims; leave result.json, tables.md, pictures and
    report.html. Goes on where it was ended."""

    output_dir: Path
    """Where the result goes; cells that it already has are kept."""
    preset: Literal["cpu", "paper"] = "cpu"
    """Synthetic scenes, small enough for a CPU; or the paper's own size, for --data."""
    data: Path | None = None
    """A NeRF-synthetic folder (chair, drums, ficus, hotdog, lego, materials, mic), for --preset paper."""
    workplace: Path = Path("bench")
    """Where scenes and runs are kept; workers on other machines must see it."""
    tables: tuple[int, ...] = ()
    """The paper's 1 to 4, ours from 5; none: all. --dry-run tells what they are."""
    scenes: tuple[str, ...] = ()
    """Of the seven, Lego under the name bricks; none: all."""
    strategies: tuple[str, ...] = ()
    """Of the paper's six, under the methods' names; none: all."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of weights, pixels and jitter."""
    dry_run: tyro.conf.UseCounterAction[int] = 0
    """Only tell which cells there are and how long they will take; trains nothing, writes nothing."""

    def run(self) -> None:
        from edge_se_sampler.bench.experiment import begun, executor_of, missing, run_cells
        from edge_se_sampler.bench.paper.estimate import plan_of
        from edge_se_sampler.bench.paper.outputs import keep_view, write_outputs
        from edge_se_sampler.bench.paper.published import SCENES, STRATEGIES
        from edge_se_sampler.bench.paper.scenes import check_real, real_scenes, synthetic_scenes
        from edge_se_sampler.bench.paper.trials import PRESETS, TABLES, cells, run_cell
        from edge_se_sampler.engine.figures import require_pyplot
        from edge_se_sampler.engine.files import make_folder

        check_known("tables", self.tables, TABLES)
        check_known("scenes", self.scenes, SCENES)
        check_known("strategies", self.strategies, STRATEGIES)
        if not self.seeds:
            raise InputError("--seeds: give at least one")
        workers = self.processes()
        if (self.data is None) != (self.preset == "cpu"):
            raise InputError("--preset paper needs --data, a NeRF-synthetic folder; --preset cpu makes its scenes")
        preset = PRESETS[self.preset]
        todo = cells(self.tables, self.scenes, self.strategies, self.seeds)
        if not todo:
            raise InputError("--tables and --strategies: no chosen table has a chosen strategy; see --dry-run")
        if self.data is not None:
            check_real(self.data, todo)
        path = self.output_dir / "result.json"
        result = begun(path, preset)
        if self.dry_run:
            print(plan_of(todo, len(todo) - len(missing(todo, result)), preset, workers))
            return
        require_pyplot()
        new_executor = executor_of(workers, self.scheduler)
        make_folder(self.output_dir / "views", "--output-dir")
        if self.data is None:
            data_of = synthetic_scenes(preset, todo, self.workplace)
        else:
            data_of = real_scenes(self.data, todo, self.workplace)
        run_cells(
            todo, result, path, new_executor, run_cell,
            lambda cell: (preset, data_of(cell), self.workplace / "runs"),
            lambda cell, run: keep_view(self.output_dir, cell, run),
        )  # fmt: skip
        write_outputs(result, data_of, self.output_dir)
        for error in result["errors"]:
            print(f"table {error['table']}, {error['scene']}, {error['strategy']}, {error['seed']}: {error['error']}")
        print(f"{len(result['runs'])} cells; see {self.output_dir / 'report.html'}")


@dataclass(frozen=True, kw_only=True)
class BenchSchedule(_Parallel):
    """Put schedule auto to the test: failures of 280 runs paired with Random's, and PSNR over planned lengths against
    fixed ones; leave result.json, table.md and lengths.png. Goes on where it was ended."""

    output_dir: Path
    """Where the result goes; trainings that it already has are kept."""
    workplace: Path = Path("bench")
    """Where scenes and runs are kept."""
    parts: tuple[Literal["failures", "lengths"], ...] = ("failures", "lengths")
    """Which of the two tests."""
    failure_seeds: tuple[int, ...] = tuple(range(10))
    """Of the runs that may fail."""
    length_seeds: tuple[int, ...] = (0, 1, 2)
    """Of the runs over planned lengths; the fixed length is chosen on others."""

    def run(self) -> None:
        from edge_se_sampler.bench.experiment import begun, executor_of, run_cells
        from edge_se_sampler.bench.paper.scenes import synthetic_scenes
        from edge_se_sampler.bench.paper.trials import PRESETS
        from edge_se_sampler.bench.schedule.summary import best_shares, write_outputs
        from edge_se_sampler.bench.schedule.trials import (
            LENGTHS,
            Cell,
            Scale,
            choice_cells,
            choice_seeds,
            failure_cells,
            length_cells,
            run_cell,
        )
        from edge_se_sampler.engine.figures import require_pyplot
        from edge_se_sampler.engine.files import make_folder

        if not (self.parts and self.failure_seeds and self.length_seeds):
            raise InputError("--parts, --failure-seeds and --length-seeds: give at least one of each")
        if chosen_on := sorted(set(self.length_seeds) & set(choice_seeds(LENGTHS[0]))):
            raise InputError(f"--length-seeds: the fixed length is chosen on {chosen_on}; name others")
        workers = self.processes()
        scale, path = Scale(), self.output_dir / "result.json"
        todo = failure_cells(scale, self.failure_seeds) if "failures" in self.parts else []
        result = begun(path, scale)
        require_pyplot()
        new_executor = executor_of(workers, self.scheduler)
        make_folder(self.output_dir, "--output-dir")
        lengths = LENGTHS if "lengths" in self.parts else ()
        data_of = synthetic_scenes(
            PRESETS["cpu"], [*todo, *(cell for length in lengths for cell in choice_cells(length))], self.workplace
        )
        runs, errors = self.workplace / "runs", []

        def train(cells: list[Cell]) -> None:
            run_cells(cells, result, path, new_executor, run_cell, lambda cell: (data_of(cell), runs))
            errors.extend(result["errors"])

        if todo:
            train(todo)
        for length in lengths:
            train(choice_cells(length))
            best = best_shares(result["runs"]).get(length)
            if best is not None:
                train(length_cells(length, best, self.length_seeds))
        result["errors"] = errors
        write_outputs(result, self.output_dir)
        for error in result["errors"]:
            print(f"{error['part']}, table {error['table']}, {error['scene']}, {error['arm']}: {error['error']}")
        print(f"{len(result['runs'])} trainings; see {self.output_dir / 'table.md'}")


@dataclass(frozen=True)
class BenchReport:
    """Write the README.md and pictures of an experiment's folder again; trains nothing."""

    folder: tyro.conf.Positional[Path]
    """Folder with the result of another bench command."""
    readme: Path | None = None
    """A text whose tables between `<!-- table: NAME -->` and `<!-- end -->` are filled in too."""
    workplace: Path = Path("bench")
    """Where the experiment left renderings; pictures made of them are drawn again only if they are there."""

    def run(self) -> None:
        from edge_se_sampler.bench.report import write_report

        write_report(self.folder, self.readme, self.workplace)
        print(f"wrote {self.folder / 'README.md'}")


BENCHES: dict[str, type] = {
    "samplers": BenchSamplers,
    "scoring": BenchScoring,
    "nerfstudio": BenchNerfstudio,
    "paper": BenchPaper,
    "stability": BenchStability,
    "schedule": BenchSchedule,
    "chart": BenchChart,
    "beside": BenchBeside,
    "step": BenchStep,
    "report": BenchReport,
}
