"""Commands of `edge-se` that train, or take a run that has been trained. Torch is imported only when a command runs."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.errors import InputError
from edge_se_sampler.export.commands import ExportCameras, ExportMesh, ExportPoints, ExportSplats
from edge_se_sampler.methods import method_configs
from edge_se_sampler.ranks import is_main
from edge_se_sampler.viewer.address import ViewerConfig, check_viser

if TYPE_CHECKING:
    from edge_se_sampler.engine.run_folder import RunFolder


@dataclass(frozen=True)
class Training:
    """What edge-se train METHOD takes."""

    config: Annotated[TrainerConfig, tyro.conf.arg(name="")]
    view: tyro.conf.UseCounterAction[int] = 0
    """Fly through the model in the browser while it trains."""
    viewer: ViewerConfig = field(default_factory=ViewerConfig)

    def run(self) -> None:
        if self.view:
            self.viewer.check()
        elif self.viewer != ViewerConfig():
            raise InputError("--viewer.host and --viewer.port have no effect without --view: add it, or leave them out")
        from edge_se_sampler.engine.session import prepare

        trainer = prepare(self.config)
        if not (self.view and is_main()):
            train(trainer)
            return
        from edge_se_sampler.viewer.server import view_training

        view_training(trainer, self.viewer, train)


@dataclass(frozen=True)
class _RunCommand:
    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder."""

    def _load(self) -> tuple[RunFolder, TrainerConfig]:
        return load_run(self.run_folder)


@dataclass(frozen=True)
class _PictureCommand(_RunCommand):
    average_with: tuple[Path, ...] = ()
    """More runs on the same data, with other seeds: pictures are the mean of what all of them render, which takes as
    much longer. What they get wrong differs, and cancels in part."""

    def _load_all(self) -> list[tuple[RunFolder, TrainerConfig]]:
        return [load_run(folder) for folder in (self.run_folder, *self.average_with)]


@dataclass(frozen=True)
class Resume(_RunCommand):
    """Continue an interrupted run in place, under its own settings, or extend a finished one."""

    max_seconds: float | None = None
    """Stop this session after so many seconds."""
    max_num_iterations: int | None = None
    """Planned iterations from now on, which the learning rate follows; the early phase keeps its length."""
    changed_data: bool = False
    """Train on, although the training images are not those that the run began with."""

    def run(self) -> None:
        from edge_se_sampler.engine.session import prepare_resume

        train(prepare_resume(*self._load(), self.max_seconds, self.max_num_iterations, self.changed_data))


@dataclass(frozen=True)
class Eval(_PictureCommand):
    """Measure a run on its held-out views."""

    output_path: Path = Path("eval.json")
    """The json file to write."""
    render_output_path: Path | None = None
    """Folder for pictures of the views: ground truth on the left, rendering on the right."""

    def run(self) -> None:
        from edge_se_sampler.engine.evaluation import evaluate_run

        results = evaluate_run(self._load_all(), self.output_path, self.render_output_path)
        print(f"PSNR {results['psnr']:.2f} dB over {results['num_images']} views; see {self.output_path}")


@dataclass(frozen=True)
class Render(_PictureCommand):
    """Render a run as a video, or as a folder of frames."""

    output_path: Path = Path("render.gif")
    """The video to write, .gif or .mp4 (extra [video]). Without an ending it is a folder: OUTPUT/00000.png and so on,
    and frames.json, which says what they are; what was interrupted there goes on."""
    outputs: tuple[Literal["rgb", "rgba", "accumulation", "depth", "raw-depth"], ...] = ("rgb",)
    """What to show, side by side in a video: colors; in folders alone, colors with straight alpha; opacity; depth in
    colors, near is red; in folders alone, depth along the optical axis as 16 bits, in the units that frames.json
    says."""
    kind: Literal["spiral", "interpolate", "train", "test"] | None = None
    """Cameras: a turn around what the training views look at, or to and fro where they are on one side of it (spiral,
    the default); a path through the training views in their order; the training views; the held-out ones."""
    camera_path: Path | None = None
    """Cameras of nerfstudio's viewer (camera_path.json) in place of a kind, in the units and axes of the run's data."""
    dataparser_transforms: Path | None = None
    """The dataparser_transforms.json of a run of nerfstudio on the same data: the camera path is in that run's units
    and axes."""
    num_frames: int | None = None
    """Frames of spiral and interpolate, by default 60."""
    frames_per_second: float | None = None
    """Frame rate of the video; by default the camera path's, or 20."""
    depth_unit: float | None = None
    """What 1 means in raw-depth, world units; by default the power of ten that lets 16 bits reach to the far depth."""

    def run(self) -> None:
        from edge_se_sampler.engine.video import render_run

        options = {key: value for key, value in vars(self).items() if key not in ("run_folder", "average_with")}
        render_run(self._load_all(), **options)
        print(self.output_path)


@dataclass(frozen=True)
class Export(_RunCommand):
    """Take a run to other programs: edge-se export RUN mesh|points|cameras|splats."""

    what: Annotated[
        Annotated[ExportMesh, tyro.conf.subcommand("mesh")]
        | Annotated[ExportPoints, tyro.conf.subcommand("points")]
        | Annotated[ExportCameras, tyro.conf.subcommand("cameras")]
        | Annotated[ExportSplats, tyro.conf.subcommand("splats")],
        tyro.conf.arg(name=""),
    ]

    def run(self) -> None:
        print(self.what.export(*self._load()))


@dataclass(frozen=True)
class View(ViewerConfig, _RunCommand):
    """Fly through a run in the browser; another process may be training it."""

    html: Path | None = None
    """Write one html file that needs no server instead: points, cameras and a turntable."""

    def run(self) -> None:
        check_viser()
        if self.html is None:
            from edge_se_sampler.viewer.server import view_run

            view_run(*self._load(), self)
        else:
            if (self.host, self.port) != (ViewerConfig.host, ViewerConfig.port):
                raise InputError("--host and --port have no effect with --html, which needs no server; leave them out")
            from edge_se_sampler.viewer.html import write_html

            write_html(*self._load(), self.html)
            print(self.html)


def load_run(folder: Path) -> tuple[RunFolder, TrainerConfig]:
    """A run's folder and its config; InputError if there is none."""
    from edge_se_sampler.engine.run_folder import RunFolder

    run = RunFolder(folder)
    return run, run.config(method_configs())


def train(trainer: Any) -> None:
    """Train, and say where the result is. Exits with 130 if it was stopped by Ctrl-C."""
    from edge_se_sampler.engine.progress import write_line
    from edge_se_sampler.engine.session import describe_run

    if is_main():
        print(describe_run(trainer), flush=True)
    trainer.train()
    if not is_main():
        sys.exit(130 if trainer.stop_requested else 0)
    resume = f"edge-se resume {quote(str(trainer.run.path))}"
    stopping, has_ended = trainer.early_stopping, trainer.next_step == trainer.plan.num_steps
    if trainer.stop_requested and not has_ended:
        write_line(f"edge-se: stopped after {trainer.next_step} iterations and saved; continue: {resume}")
        sys.exit(130)
    print(f"{trainer.next_step} of {trainer.plan.num_steps or '?'} iterations in {trainer.elapsed:.1f} s of training")
    if stopping.is_due and not has_ended:
        print(f"stopped: no gain of {stopping.min_gain:g} dB in the last {stopping.patience} previews")
    print(f"measure it: edge-se eval {quote(str(trainer.run.path))}")
    if not has_ended:
        print(f"continue:   {resume}")
