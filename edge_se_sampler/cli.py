"""`edge-se`: the command line. Torch is imported only by the commands that compute, so that --help is quick."""

from __future__ import annotations

import contextlib
import difflib
import io
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import tyro

from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import registered_methods
from edge_se_sampler.sampling_settings import EdgeSEPixelSamplerConfig


@dataclass(frozen=True)
class Demo:
    """See it: Random against Edge + SE on an off-centre, mostly white scene, in a few minutes."""

    output_dir: Path = Path()
    """Where demo.png, demo.json and the folder demo/ (scene and runs) are left."""
    seed: int = 0
    """Of weights, pixels and jitter; both methods start from the same weights."""

    def run(self) -> None:
        from edge_se_sampler.bench.demo import METHODS, demo

        for outcome in demo(self.output_dir, self.seed):
            print(
                f"{METHODS[outcome.method]:>9}: {outcome.results['psnr']:.2f} dB in {outcome.seconds:.0f} s of training"
            )
        print(f"see {self.output_dir / 'demo.png'} and {self.output_dir / 'demo.json'}")


@dataclass(frozen=True)
class Scenes:
    """Make the seven scenes (stand-ins for NeRF's) as Blender folders."""

    out: Path
    """Folder that receives one folder a scene; nothing existing is overwritten."""
    names: tuple[str, ...] = ("chair", "drums", "ficus", "hotdog", "bricks", "materials", "mic")
    """Which scenes."""
    size: int = 100
    """Rows and columns of an image."""
    num_train: int = 50
    """Training views."""
    num_val: int = 5
    """Validation views."""
    num_test: int = 10
    """Test views."""
    placement: Literal["centered", "shifted", "rotated"] = "centered"
    """Object in the middle; moved in the image plane (cx, cy in the json); or cameras turned away from it."""
    offset: tuple[float, float] = (0.2, 0.15)
    """Where the object goes from the middle, right and down, as fractions of the image (shifted, rotated)."""
    seed: int = 0
    """Of the training and validation poses."""

    def run(self) -> None:
        from edge_se_sampler.data.made.folder import make_scenes
        from edge_se_sampler.engine.progress import Progress

        progress = Progress(len(self.names) * (self.num_train + self.num_val + self.num_test), "rendering scenes")
        try:
            made = make_scenes(
                self.out,
                self.names,
                size=self.size,
                num_train=self.num_train,
                num_val=self.num_val,
                num_test=self.num_test,
                placement=self.placement,
                offset=self.offset,
                seed=self.seed,
                progress=lambda done, _: progress.update(done),
            )
        finally:
            progress.close()
        for path in made:
            print(path)


@dataclass(frozen=True)
class Offcenter:
    """Move the object of one's own images off the centre, bit for bit: padded, shifted, and cx, cy in the json."""

    data: Path
    """A Blender folder."""
    out: Path
    """Folder that receives centered/ (padded only) and shifted/; it must not be there, or be empty."""
    shift: tuple[float, float] = (0.2, 0.15)
    """Where the picture goes, right and down, as fractions of its width and height; rounded to whole pixels."""
    pad: tuple[float, float] | None = None
    """Added left and right, and above and below, as such fractions; left out, as much as the shift: all fits."""

    def run(self) -> None:
        from edge_se_sampler.data.offcenter import offcenter
        from edge_se_sampler.engine.progress import Progress

        progress = Progress(0, "padding views")

        def show(done: int, total: int) -> None:
            progress.total = total
            progress.update(done)

        try:
            made = offcenter(self.data, self.out, self.shift, self.pad, show)
        finally:
            progress.close()
        for path in made:
            print(path)


@dataclass(frozen=True)
class Train:
    """Train a method on a Blender folder: edge-se train METHOD --data DIR."""


@dataclass(frozen=True)
class Resume:
    """Continue an interrupted run in place, under its own settings."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    max_seconds: float | None = None
    """Stop this session after that time."""

    def run(self) -> None:
        from edge_se_sampler.engine.run_folder import RunFolder
        from edge_se_sampler.engine.session import prepare_resume

        _train(prepare_resume(RunFolder(self.run_folder), self.max_seconds))


@dataclass(frozen=True)
class Eval:
    """Measure a run on its held-out views."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    output_path: Path = Path("eval.json")
    """The json to write."""
    render_output_path: Path | None = None
    """Folder for the rendered views (ground truth | rendering)."""

    def run(self) -> None:
        from edge_se_sampler.engine.reports import evaluate_run

        results = evaluate_run(self.run_folder, self.output_path, self.render_output_path)
        print(f"PSNR {results['psnr']:.2f} dB over {results['num_images']} views; see {self.output_path}")


@dataclass(frozen=True)
class Render:
    """Show a run as a video."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    output_path: Path = Path("render.gif")
    """The video to write, .gif or .mp4 (extra [video])."""
    kind: Literal["spiral", "test"] = "spiral"
    """A turn around the scene, or the held-out cameras."""
    num_frames: int = 60
    """Frames of the spiral."""
    frames_per_second: int = 20
    """Speed of the video."""

    def run(self) -> None:
        from edge_se_sampler.engine.reports import render_run

        render_run(self.run_folder, self.output_path, self.kind, self.num_frames, self.frames_per_second)
        print(self.output_path)


@dataclass(frozen=True)
class Show:
    """Look at one's own images as a sampler sees them: view, probability, and where a batch falls."""

    data: Path
    """A Blender folder."""
    output_path: Path = Path("show.png")
    """The picture to write."""
    strategy: Literal["uniform", "precrop", "edge"] = "edge"
    """Which way of drawing is shown."""
    num_views: int = 3
    """How many training views."""
    seed: int = 0
    """Of the draw."""
    pixel_sampler: EdgeSEPixelSamplerConfig = field(default_factory=EdgeSEPixelSamplerConfig)
    """Settings of the sampler."""

    def run(self) -> None:
        from edge_se_sampler.data.blender import read_blender
        from edge_se_sampler.show import show

        if self.num_views < 1:
            raise InputError(f"--num-views is {self.num_views}: must be at least 1")
        views = read_blender(self.data, "train")
        show(views, self.pixel_sampler, self.strategy, self.output_path, self.num_views, self.seed)
        print(self.output_path)


@dataclass(frozen=True)
class Methods:
    """List every method and where it comes from."""

    def run(self) -> None:
        for name, method in registered_methods().items():
            print(f"{name:<20} {method.specification.description}  [{method.origin}]")


@dataclass(frozen=True)
class Bench:
    """Measure: edge-se bench samplers, quality, paper or nerfstudio."""


@dataclass(frozen=True)
class BenchSamplers:
    """Time building tables, drawing and selecting pixels; compare the memory of SE with Random's."""

    output_path: Path | None = None
    """A json to write besides printing."""
    images: int = 100
    """Images in the tables."""
    size: int = 800
    """Rows and columns of an image."""
    draws: int = 4096
    """Pixels a draw."""
    repeats: int = 200
    """Rounds; the median of each kind of draw is reported."""

    def run(self) -> None:
        from edge_se_sampler.bench.samplers import bench_samplers, table_of
        from edge_se_sampler.engine.files import make_folder, write_json

        if self.output_path is not None:
            make_folder(self.output_path.parent, "--output-path, folder")
        if min(self.images, self.size, self.draws, self.repeats) < 1:
            raise InputError("--images, --size, --draws and --repeats must be at least 1")
        result = bench_samplers(self.images, self.size, self.draws, self.repeats)
        print(table_of(result))
        if self.output_path is not None:
            write_json(self.output_path, result)


@dataclass(frozen=True)
class BenchQuality:
    """Train a method on a made scene for some minutes; leave result.json and curve.png."""

    output_dir: Path
    """Where the result goes."""
    workplace: Path = Path("bench")
    """Where the scene and the run are kept."""
    method: str = "edge-se-nerf"
    """One of edge-se methods."""
    scene: str = "bricks"
    """One of edge-se scenes."""
    seconds: float = 180
    """Of training at most."""
    seed: int = 0
    """Of weights, pixels and jitter."""

    def run(self) -> None:
        from edge_se_sampler.bench.quality import bench_quality

        if self.method not in registered_methods():
            raise InputError(f"--method {self.method!r} is not registered; see edge-se methods")
        result = bench_quality(self.output_dir, self.workplace, self.method, self.scene, self.seconds, self.seed)
        print(f"{result['results']['psnr']:.2f} dB after {result['seconds']:.0f} s; see {self.output_dir}")


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

        result = bench_nerfstudio(
            self.output_dir, self.workplace, self.scene, self.seeds, self.iterations, self.rays, self.samples
        )
        for method, told in result["failures"].items():
            print(
                f"{method}: {told['failed']} of {told['runs']} failed, {told['at_background']} at the background; "
                f"{told['mean_psnr']:.2f} dB on average"
            )


@dataclass(frozen=True)
class BenchPaper:
    """Remake the paper's tables 1 to 4 on made scenes; leave result.json and tables.md. Goes on where it was ended."""

    output_dir: Path
    """Where the result goes; cells that it already has are kept."""
    workplace: Path = Path("bench")
    """Where scenes and runs are kept; workers on other machines must see it."""
    tables: tuple[int, ...] = ()
    """Of 1 to 4; none: all. 1, 2: NeRF with all views; 3, 4: InfoNeRF with 10; 2, 4: off centre."""
    scenes: tuple[str, ...] = ()
    """Of the seven made scenes; none: all."""
    strategies: tuple[str, ...] = ()
    """Of the paper's six, under the methods' names; none: all."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of weights, pixels and jitter."""
    workers: int | None = None
    """Cells trained at once, a thread each; left out, as many as there are cores."""
    scheduler: str | None = None
    """Address of a dask scheduler whose workers take the cells ([cluster] extra), instead of --workers."""

    def run(self) -> None:
        from edge_se_sampler.bench.paper.cell import PRESETS, TABLES, cells
        from edge_se_sampler.bench.paper.published import SCENES, STRATEGIES
        from edge_se_sampler.bench.paper.run import cores, executor_of, make_data, run_cells
        from edge_se_sampler.bench.paper.tables import tables_of
        from edge_se_sampler.engine.files import make_folder, write_atomically

        for flag, chosen, known in (
            ("tables", self.tables, tuple(TABLES)),
            ("scenes", self.scenes, SCENES),
            ("strategies", self.strategies, STRATEGIES),
        ):
            for name in chosen:
                if name not in known:
                    raise InputError(f"--{flag}: {name!r} is none of {', '.join(map(str, known))}")
        if not self.seeds or (self.workers is not None and self.workers < 1):
            raise InputError("--seeds and --workers: at least one")
        preset = PRESETS["cpu"]
        todo = cells(self.tables, self.scenes, self.strategies, self.seeds)
        new_executor = executor_of(self.workers or cores(), self.scheduler)
        make_folder(self.output_dir, "--output-dir")
        data_of = make_data(preset, todo, self.workplace)
        result = run_cells(todo, preset, data_of, self.output_dir, self.workplace, new_executor, threads=1)
        write_atomically(self.output_dir / "tables.md", tables_of(result).encode())
        for error in result["errors"]:
            print(f"table {error['table']}, {error['scene']}, {error['strategy']}, {error['seed']}: {error['error']}")
        print(f"{len(result['runs'])} cells; see {self.output_dir / 'tables.md'}")


COMMANDS: dict[str, type] = {
    "demo": Demo,
    "scenes": Scenes,
    "offcenter": Offcenter,
    "train": Train,
    "resume": Resume,
    "eval": Eval,
    "render": Render,
    "show": Show,
    "methods": Methods,
    "bench": Bench,
}
BENCHES: dict[str, type] = {
    "samplers": BenchSamplers,
    "quality": BenchQuality,
    "nerfstudio": BenchNerfstudio,
    "paper": BenchPaper,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; exit code 2 for bad input, 1 for a training that diverged, 130 for Ctrl-C."""
    try:
        _run(list(sys.argv[1:] if arguments is None else arguments))
    except InputError as problem:
        _leave(str(problem), 2)
    except FloatingPointError as problem:
        _leave(str(problem), 1)
    except KeyboardInterrupt:
        _leave("interrupted", 130)


def _leave(message: str, code: int) -> None:
    print(f"edge-se: {message}", file=sys.stderr)
    sys.exit(code)


def _run(arguments: list[str]) -> None:
    if arguments == ["--version"]:
        from edge_se_sampler import __version__

        print(__version__)
    elif arguments[:1] == ["train"]:
        methods = {name: method.specification for name, method in registered_methods().items()}
        kind = tyro.extras.subcommand_type_from_defaults(
            {name: method.config for name, method in methods.items()},
            {name: method.description for name, method in methods.items()},
        )
        config = _parse(kind, arguments[1:], "edge-se train", list(methods))
        from edge_se_sampler.engine.session import prepare

        _train(prepare(config))
    elif arguments[:1] == ["bench"]:
        _parse(_one_of(BENCHES), arguments[1:], "edge-se bench", list(BENCHES)).run()
    else:
        _parse(_one_of(COMMANDS), arguments, "edge-se", list(COMMANDS)).run()


def _one_of(commands: dict[str, type]) -> Any:
    """The type that tyro parses into one of the commands."""
    kinds = tuple(Annotated[kind, tyro.conf.subcommand(name)] for name, kind in commands.items())  # type: ignore[valid-type]
    return Union[kinds]  # noqa: UP007


def _parse(kind: Any, arguments: list[str], program: str, names: list[str]) -> Any:
    """tyro's parse, its boxed complaint turned into one line."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(tyro.conf.configure(tyro.conf.FlagConversionOff)(kind), args=arguments, prog=program)
    except SystemExit as end:
        if not end.code:
            raise
        raise InputError(_one_line(complaint.getvalue(), arguments, program, names)) from None


def _one_line(complaint: str, arguments: list[str], program: str, names: list[str]) -> str:
    """The gist of tyro's complaint, with the nearest name that exists."""
    if not arguments or (arguments[0] not in names and not arguments[0].startswith("-")):
        near = difflib.get_close_matches(arguments[0], names, n=1, cutoff=0.4) if arguments else []
        hint = f"did you mean {near[0]!r}?" if near else f"choose one of {', '.join(names)}"
        return f"{program} has no {arguments[0]!r}; {hint}" if arguments else f"{program} what? {hint}"
    lines = [line.strip("│╭╮╰╯ ") for line in complaint.splitlines()]
    body = " ".join(line for line in lines[1:] if line)
    body, *suggestions = re.split(r" ?─{4,} ?", body)
    nearest = re.search(r"(--[\w.-]+)", " ".join(suggestions[:1])) if "Perhaps" in "".join(suggestions[:1]) else None
    hint = f"; did you mean {nearest.group(1)}?" if nearest else ""
    return f"{body}{hint} (see {program} {arguments[0]} --help)"


def _train(trainer: Any) -> None:
    """Train and say where the result is."""
    from edge_se_sampler.engine.session import summary

    print(summary(trainer.config, trainer.run), flush=True)
    trainer.train()
    if trainer.stop_requested:
        _leave(
            f"stopped after {trainer.next_step} iterations and saved; continue: edge-se resume {trainer.run.path}", 130
        )
    print(f"{trainer.next_step} of {trainer.planned_steps} iterations in {trainer.elapsed:.1f} s of training")
    print(f"measure it: edge-se eval {trainer.run.path}")
    if trainer.next_step < trainer.planned_steps:
        print(f"continue:   edge-se resume {trainer.run.path}")


if __name__ == "__main__":
    main()
