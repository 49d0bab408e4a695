"""The chart's commands: edge-se bench chart, and bench beside for other programs. Torch-free until one runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from edge_se_sampler.bench.baselines.results import ProgramName
from edge_se_sampler.errors import InputError, check_known


@dataclass(frozen=True)
class BenchChart:
    """Chart PSNR against training seconds: methods, and one thing changed at a time; leave result.json, table.md and
    pictures, and chart.html. Goes on where it was ended."""

    output_dir: Path
    """Where the result goes; trainings that it already has are kept."""
    workplace: Path = Path("bench")
    """Where synthetic scenes are kept."""
    data: Path | None = None
    """Folder with a Blender folder a scene, all of one size of image; left out, seven synthetic scenes of 100 x 100."""
    variants: tuple[str, ...] = ()
    """Which; none: all. --dry-run tells what they are."""
    scenes: tuple[str, ...] = ("bricks",)
    """Of the seven, or of --data."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of weights, pixels and jitter."""
    seconds: float = 60
    """Of training, and of the plan, of each."""
    threads: int = 1
    """Of a training. One: as many trainings at once as there are cores, timed in CPU seconds; more: fewer at once,
    timed by the clock on the wall, so leave the machine alone."""
    external: tuple[Path, ...] = ()
    """Results of other programs, drawn beside: json files with name, version, command, machine, and runs, each with
    scene, seed and curve, a list of [seconds, PSNR]; threads, if told, must be the chart's."""
    dry_run: tyro.conf.UseCounterAction[int] = 0
    """Only tell which variants there are, and how much is done; trains nothing, writes nothing."""

    def run(self) -> None:
        from concurrent.futures import ThreadPoolExecutor

        from edge_se_sampler.bench.baselines.results import read_external
        from edge_se_sampler.bench.chart.outputs import write_outputs
        from edge_se_sampler.bench.chart.train import Scale, run_cell
        from edge_se_sampler.bench.chart.variants import VARIANTS, cells
        from edge_se_sampler.bench.experiment import alone, begun, default_workers, missing, run_cells
        from edge_se_sampler.engine.figures import require_pyplot
        from edge_se_sampler.engine.files import make_folder

        check_known("variants", self.variants, VARIANTS)
        _check_chosen(self.seeds, self.scenes, self.seconds, self.threads)
        scale = Scale(self.seconds, self.threads, _pixels(self.data, self.scenes))
        others = [read_external(path, "--external", scale) for path in self.external]
        path = self.output_dir / "result.json"
        todo, result = cells(self.variants, self.scenes, self.seeds), begun(path, scale)
        if self.dry_run:
            for name in self.variants or VARIANTS:
                print(f"{name:<16} {VARIANTS[name].label}")
            print(f"{len(todo)} trainings of {scale.seconds:g} s, {len(missing(todo, result))} still to do")
            return
        require_pyplot()
        make_folder(self.output_dir, "--output-dir")
        workers = max(1, default_workers() // self.threads)
        data = {scene: _folder(self.data, self.workplace, scene) for scene in self.scenes}
        run_cells(
            todo, result, path, lambda: ThreadPoolExecutor(workers),
            lambda cell: alone(run_cell, cell, scale, data[cell.scene]), lambda _: (),
        )  # fmt: skip
        write_outputs(result, others or result.get("external", []), self.output_dir)
        for error in result["errors"]:
            print(f"{error['variant']}, {error['scene']}, {error['seed']}: {error['error']}")
        print(f"{len(result['runs'])} trainings; see {self.output_dir / 'table.md'}")


@dataclass(frozen=True, kw_only=True)
class BenchBeside:
    """Train another program, unchanged, on the chart's scenes, timed and looked at as ours are; leave a json for
    bench chart --external. Goes on where it was ended."""

    program: ProgramName
    """Which. nerf-pytorch and tensorf come as a --checkout and want what they import; nerfstudio's are in the
    environment."""
    output_path: Path
    """The json; runs that it already has are kept."""
    checkout: Path | None = None
    """A git checkout of the program."""
    flags: str = ""
    """The program's own, in one string, besides those that name the data."""
    label: str = ""
    """What tells these flags from others, in the chart."""
    workplace: Path = Path("bench")
    """Where synthetic scenes are kept."""
    data: Path | None = None
    """Folder with a Blender folder a scene, all of one size of image; as bench chart has it."""
    scenes: tuple[str, ...] = ("bricks",)
    """Of the seven, or of --data."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of weights, pixels and jitter."""
    seconds: float = 60
    """Of training, of each."""
    threads: int = 1
    """Of a training, as bench chart has it; one training at a time."""

    def run(self) -> None:
        from edge_se_sampler.bench.baselines.run import run_beside
        from edge_se_sampler.bench.chart.train import Scale
        from edge_se_sampler.engine.files import make_room

        _check_chosen(self.seeds, self.scenes, self.seconds, self.threads)
        scale = Scale(self.seconds, self.threads, _pixels(self.data, self.scenes))
        make_room(self.output_path)
        scenes = {scene: _folder(self.data, self.workplace, scene) for scene in self.scenes}
        result = run_beside(
            self.program,
            self.checkout,
            self.label,
            self.flags,
            scenes,
            self.seeds,
            scale,
            self.output_path,
        )
        for run in result["runs"]:
            seconds, psnr = run["curve"][-1]
            print(f"{result['name']}, {run['scene']}, {run['seed']}: {psnr:.2f} dB after {seconds:.0f} s")


def _check_chosen(seeds: tuple[int, ...], scenes: tuple[str, ...], seconds: float, threads: int) -> None:
    if not (seeds and scenes):
        raise InputError("--seeds and --scenes: give at least one of each")
    if not 1 <= seconds < float("inf"):
        raise InputError(f"--seconds is {seconds}: must be at least 1")
    if threads < 1:
        raise InputError(f"--threads is {threads}: must be at least 1")


def _pixels(data: Path | None, scenes: tuple[str, ...]) -> int:
    """Longer side of the scenes' images."""
    from edge_se_sampler.bench.chart.train import Scale
    from edge_se_sampler.data.blender import read_blender
    from edge_se_sampler.data.synthetic.catalogue import ANALOG_OF

    if data is None:
        check_known("scenes", scenes, ANALOG_OF)
        return Scale().pixels
    sides = {scene: max(read_blender(data / scene, "train").images[0].shape[:2]) for scene in scenes}
    if len(set(sides.values())) > 1:
        told = ", ".join(f"{scene} {side}" for scene, side in sides.items())
        raise InputError(f"--data {data}: scenes of different sizes ({told} pixels): chart them apart")
    return next(iter(sides.values()))


def _folder(data: Path | None, workplace: Path, scene: str) -> Path:
    """A scene's, made if there are no --data."""
    from edge_se_sampler.bench.scenes import cached_scene

    return cached_scene(workplace, scene) if data is None else data / scene
