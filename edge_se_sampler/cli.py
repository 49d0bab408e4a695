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

from edge_se_sampler.bench.commands import BENCHES
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs, registered_methods
from edge_se_sampler.models.config import LeanModelConfig, check_fineness
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig


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
    placement: Literal["centered", "padded", "shifted", "rotated"] = "centered"
    """Object in the middle; as small there as shifted has it; moved in the image plane (cx, cy in the json); or
    cameras turned away from it."""
    offset: tuple[float, float] = (0.2, 0.15)
    """Where the object goes from the middle, right and down, as fractions of the image (all but centered)."""
    seed: int = 0
    """Of the training and validation poses."""

    def run(self) -> None:
        from edge_se_sampler.data.synthetic.folder import make_scenes
        from edge_se_sampler.engine.progress import Progress

        with Progress(0, "rendering scenes") as progress:
            paths = make_scenes(
                self.out,
                self.names,
                size=self.size,
                num_train=self.num_train,
                num_val=self.num_val,
                num_test=self.num_test,
                placement=self.placement,
                offset=self.offset,
                seed=self.seed,
                progress=progress.update,
            )
        for path in paths:
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

        with Progress(0, "moving views off the center") as progress:
            paths = offcenter(self.data, self.out, self.shift, self.pad, progress.update)
        for path in paths:
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

        run = RunFolder(self.run_folder)
        _train(prepare_resume(run, run.config(method_configs()), self.max_seconds))


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
        from edge_se_sampler.engine.run_folder import RunFolder

        run = RunFolder(self.run_folder)
        results = evaluate_run(run, run.config(method_configs()), self.output_path, self.render_output_path)
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
        from edge_se_sampler.engine.run_folder import RunFolder

        run = RunFolder(self.run_folder)
        config = run.config(method_configs())
        render_run(run, config, self.output_path, self.kind, self.num_frames, self.frames_per_second)
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
        from edge_se_sampler.engine.files import check_output
        from edge_se_sampler.engine.show import show

        if self.num_views < 1:
            raise InputError(f"--num-views is {self.num_views}: must be at least 1")
        if self.pixel_sampler.num_rays_per_batch < 1:
            raise InputError(
                f"--pixel-sampler.num-rays-per-batch is {self.pixel_sampler.num_rays_per_batch}: must be at least 1"
            )
        check_output(self.output_path)
        views = read_blender(self.data, "train")
        show(views, self.pixel_sampler, self.strategy, self.output_path, self.num_views, self.seed)
        print(self.output_path)


@dataclass(frozen=True)
class Inspect:
    """What a scene needs, derived from its cameras and its alpha, as economy auto does: numbers and a picture."""

    data: Path
    """A Blender folder."""
    output_path: Path = Path("inspect.png")
    """The picture to write."""
    near: float = LeanModelConfig.near
    """Depth along the optical axis at which samples begin, world units."""
    far: float = LeanModelConfig.far
    """Depth at which samples end."""
    voxel_size_px: float = LeanModelConfig.voxel_size_px
    """Side of a cell, in pixels' footprints."""
    step_size_voxels: float = LeanModelConfig.step_size_voxels
    """Distance between samples, in sides of a cell."""

    def run(self) -> None:
        from edge_se_sampler.data.blender import read_blender
        from edge_se_sampler.engine.files import check_output
        from edge_se_sampler.engine.inspection import inspect

        check_output(self.output_path)
        asked = LeanModelConfig(
            near=self.near, far=self.far, voxel_size_px=self.voxel_size_px, step_size_voxels=self.step_size_voxels
        )
        check_fineness(asked)
        print(inspect(read_blender(self.data, "train"), asked, self.output_path))
        print(self.output_path)


@dataclass(frozen=True)
class Methods:
    """List every method and where it comes from."""

    def run(self) -> None:
        for name, method in registered_methods().items():
            print(f"{name:<20} {method.specification.description}  [{method.origin}]")


@dataclass(frozen=True)
class Bench:
    """Measure samplers and trainings; the experiments behind the README's numbers."""


COMMANDS: dict[str, type] = {
    "demo": Demo,
    "scenes": Scenes,
    "offcenter": Offcenter,
    "train": Train,
    "resume": Resume,
    "eval": Eval,
    "render": Render,
    "show": Show,
    "inspect": Inspect,
    "methods": Methods,
    "bench": Bench,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; exit code 2 for bad input, 1 for a training that diverged, 130 for Ctrl-C."""
    try:
        _run(list(sys.argv[1:] if arguments is None else arguments))
    except InputError as problem:
        _leave(str(problem), 2)
    except FloatingPointError as problem:
        _leave(str(problem), 1)
    except (MemoryError, RuntimeError) as problem:
        if isinstance(problem, RuntimeError) and "alloc" not in str(problem):
            raise
        _leave("there is not enough memory for this; ask for fewer rays, or a smaller model", 2)
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
    body, *suggestions = [part for part in re.split(r" ?[─-]{4,} ?", body) if part]  # dashes where boxes cannot be
    nearest = re.search(r"(--[\w.-]+)", " ".join(suggestions[:1])) if "Perhaps" in "".join(suggestions[:1]) else None
    hint = f"; did you mean {nearest.group(1)}?" if nearest else ""
    return f"{body}{hint} (see {program} {arguments[0]} --help)"


def _train(trainer: Any) -> None:
    """Train and say where the result is."""
    from edge_se_sampler.engine.session import summary

    print(summary(trainer), flush=True)
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
