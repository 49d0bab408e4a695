"""What every command of `edge-se` takes, and what it calls. Torch is imported only when a command runs."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from edge_se_sampler.data.config import DataFormat
from edge_se_sampler.data.config import Masks as MeaningOfMasks
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.errors import check_value
from edge_se_sampler.export.commands import ExportCameras, ExportMesh, ExportPoints, ExportSplats
from edge_se_sampler.methods import method_configs, registered_methods
from edge_se_sampler.models.config import LeanModelConfig
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig
from edge_se_sampler.viewer.address import ViewerConfig, check_viser

if TYPE_CHECKING:
    from edge_se_sampler.data.views import Views
    from edge_se_sampler.engine.run_folder import RunFolder


@dataclass(frozen=True)
class Demo:
    """Train Random, Edge + SE and lean-nerf on an off-center, mostly white scene, and compare them: three minutes."""

    output_dir: Path = Path()
    """Folder for demo.html, demo.png, demo.gif, demo.json and demo/ (the scene and the runs)."""
    seed: int = 0
    """Seed of weights, pixels and jitter; Random and Edge + SE start from the same weights."""

    def run(self) -> None:
        from edge_se_sampler.bench.demo import METHODS, run_demo

        for method, measured in run_demo(self.output_dir, self.seed)["methods"].items():
            psnr, seconds = measured["results"]["psnr"], measured["training_seconds"]
            print(f"{METHODS[method]:>9}: {psnr:.2f} dB in {seconds:.0f} s of training")
        print(f"see {self.output_dir / 'demo.html'} (in a browser), demo.png, demo.gif and demo.json")


@dataclass(frozen=True)
class Scenes:
    """Render the seven synthetic scenes (stand-ins for NeRF's) as Blender folders."""

    out: Path
    """Folder for one folder per scene; nothing existing is overwritten."""
    names: tuple[str, ...] = ("chair", "drums", "ficus", "hotdog", "bricks", "materials", "mic")
    """Scenes to render."""
    size: int = 100
    """Rows and columns of an image."""
    num_train: int = 50
    """Training views."""
    num_val: int = 5
    """Validation views."""
    num_test: int = 10
    """Test views."""
    placement: Literal["centered", "padded", "shifted", "rotated"] = "centered"
    """Where the object appears: in the center; there, but as small as in shifted; moved in the image plane (cx, cy in
    the json); or off the center because the cameras look past it."""
    offset: tuple[float, float] = (0.2, 0.15)
    """How far the object is moved right and down, as fractions of the image (not for centered)."""
    seed: int = 0
    """Seed of the training and validation poses."""

    def run(self) -> None:
        from edge_se_sampler.data.synthetic.folder import make_scenes
        from edge_se_sampler.engine.progress import Progress

        with Progress(0, "rendering scenes") as progress:
            paths = make_scenes(**vars(self), progress=progress.update)
        print(*paths, sep="\n")


@dataclass(frozen=True)
class Offcenter:
    """Move the object of your own images off the center without changing a pixel: pad them, and write cx, cy."""

    data: Path
    """A Blender folder."""
    out: Path
    """Folder for centered/ (padded only) and shifted/; it must not exist, or be empty."""
    shift: tuple[float, float] = (0.2, 0.15)
    """How far the image is moved right and down, as fractions of its width and height; rounded to whole pixels."""
    pad: tuple[float, float] | None = None
    """Padding on the left and right, and on the top and bottom, as such fractions; by default as much as the shift."""

    def run(self) -> None:
        from edge_se_sampler.data.offcenter import offcenter
        from edge_se_sampler.engine.progress import Progress

        with Progress(0, "moving views off the center") as progress:
            paths = offcenter(**vars(self), progress=progress.update)
        print(*paths, sep="\n")


@dataclass(frozen=True)
class Train:
    """Train a method on a folder of images and cameras: edge-se train METHOD --data DIR."""


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
        from edge_se_sampler.engine.session import prepare

        trainer = prepare(self.config)
        if not self.view:
            train(trainer)
            return
        from edge_se_sampler.viewer.server import view_training

        view_training(trainer, self.viewer, train)


@dataclass(frozen=True)
class _RunCommand:
    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder."""

    def _load(self) -> tuple[RunFolder, TrainerConfig]:
        from edge_se_sampler.engine.run_folder import RunFolder

        run = RunFolder(self.run_folder)
        return run, run.config(method_configs())


@dataclass(frozen=True)
class Resume(_RunCommand):
    """Continue an interrupted run in place, under its own settings."""

    max_seconds: float | None = None
    """Stop this session after so many seconds."""

    def run(self) -> None:
        from edge_se_sampler.engine.session import prepare_resume

        train(prepare_resume(*self._load(), self.max_seconds))


@dataclass(frozen=True)
class Eval(_RunCommand):
    """Measure a run on its held-out views."""

    output_path: Path = Path("eval.json")
    """The json file to write."""
    render_output_path: Path | None = None
    """Folder for pictures of the views: ground truth on the left, rendering on the right."""

    def run(self) -> None:
        from edge_se_sampler.engine.evaluation import evaluate_run

        results = evaluate_run(*self._load(), self.output_path, self.render_output_path)
        print(f"PSNR {results['psnr']:.2f} dB over {results['num_images']} views; see {self.output_path}")


@dataclass(frozen=True)
class Render(_RunCommand):
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
    num_frames: int = 60
    """Frames of spiral and interpolate."""
    frames_per_second: float | None = None
    """Frame rate of the video; by default the camera path's, or 20."""
    depth_unit: float | None = None
    """What 1 means in raw-depth, world units; by default the power of ten that lets 16 bits reach to the far depth."""

    def run(self) -> None:
        from edge_se_sampler.engine.video import render_run

        render_run(*self._load(), **{key: value for key, value in vars(self).items() if key != "run_folder"})
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
            from edge_se_sampler.viewer.html import write_html

            write_html(*self._load(), self.html)
            print(self.html)


@dataclass(frozen=True, kw_only=True)
class _Data:
    data: Path
    """A folder of images and their cameras, as in training."""
    data_format: DataFormat = "auto"
    """Format of the folder; auto: by what it has."""
    masks: MeaningOfMasks = "ignore"
    """What is outside of mask files: unknown (ignore), or background (object)."""
    eval_every: int | None = None
    """Every how many images one is left out, as held out in training; by default 8 where the data has no split."""
    downscale: int = 1
    """Average every DOWNSCALE x DOWNSCALE pixels first, as in training."""

    def _read(self) -> Views:
        from edge_se_sampler.engine.session import read_train_views

        names = ("data", "data_format", "masks", "eval_every", "downscale")
        return read_train_views(TrainerConfig(**{name: getattr(self, name) for name in names}))


@dataclass(frozen=True)
class _ShownSettings:
    num_rays_per_batch: int = EdgeSEPixelSamplerConfig.num_rays_per_batch
    """Pixels drawn from each view."""
    ignore_mask: bool = EdgeSEPixelSamplerConfig.ignore_mask
    """Draw from masked pixels too."""
    precrop_fraction: float = EdgeSEPixelSamplerConfig.precrop_fraction
    """Side of the precrop box as a share of the image's side."""
    edge_filter: Literal["sobel", "laplacian", "canny"] = EdgeSEPixelSamplerConfig.edge_filter
    """Edge operator."""
    edge_source: Literal["color", "alpha", "both"] = EdgeSEPixelSamplerConfig.edge_source
    """Edges of the color composited on white, of alpha, or the stronger of both."""
    edge_epsilon: float = EdgeSEPixelSamplerConfig.edge_epsilon
    """Strength that every pixel has besides its edge."""


@dataclass(frozen=True, kw_only=True)
class Show(_Data):
    """Picture what a sampler does to your own images: view, probability of every pixel, and the pixels of a batch."""

    output_path: Path = Path("show.png")
    """The picture to write."""
    strategy: Literal["uniform", "precrop", "edge"] = "edge"
    """Distribution that pixels are drawn from."""
    num_views: int = 3
    """Number of training views shown."""
    seed: int = 0
    """Seed of the drawn pixels."""
    pixel_sampler: _ShownSettings = _ShownSettings()
    """Settings of the distribution and the batch, under their names in training."""

    def run(self) -> None:
        from edge_se_sampler.engine.files import check_output
        from edge_se_sampler.engine.show import show

        rays = self.pixel_sampler.num_rays_per_batch
        check_value("num-views", self.num_views, self.num_views >= 1, "at least 1")
        check_value("pixel-sampler.num-rays-per-batch", rays, rays >= 1, "at least 1")
        check_output(self.output_path)
        views = self._read()
        config = EdgeSEPixelSamplerConfig(**vars(self.pixel_sampler))
        show(views, config, self.strategy, self.output_path, self.num_views, self.seed)
        print(self.output_path)


@dataclass(frozen=True, kw_only=True)
class Inspect(_Data):
    """Print and picture where a scene can be occupied, and the sizes derived from its cameras and alpha."""

    output_path: Path = Path("inspect.png")
    """The picture to write."""
    near: float | None = None
    """Depth along the optical axis at which samples begin, world units; by default from the scene."""
    far: float | None = None
    """Depth at which samples end; by default from the scene."""
    voxel_size_px: float = LeanModelConfig.voxel_size_px
    """About the size of the finest cells, in widths of a pixel at the center of the scene."""

    def run(self) -> None:
        from edge_se_sampler.engine.files import check_output
        from edge_se_sampler.engine.inspection import inspect

        check_output(self.output_path)
        config = LeanModelConfig(near=self.near, far=self.far, voxel_size_px=self.voxel_size_px)
        print(inspect(self._read(), config, self.output_path))
        print(self.output_path)


@dataclass(frozen=True, kw_only=True)
class Masks:
    """Find the masks of an object in front of a plain background: a wall, a table, a turntable."""

    data: Path
    """Folder of images and cameras; the masks are written into it, as `masks/` or beside images_2 as `masks_2/`."""
    data_format: DataFormat = "auto"
    """Insist on a format where a folder has several."""
    output_path: Path = Path("masks.png")
    """The picture to write, to judge the masks by."""

    def run(self) -> None:
        from edge_se_sampler.data.dataset import DataSettings
        from edge_se_sampler.masks.command import make_masks

        print(make_masks(self.data, DataSettings(self.data_format), self.output_path))


@dataclass(frozen=True)
class Methods:
    """List every method and the package that registered it."""

    def run(self) -> None:
        for name, method in registered_methods().items():
            print(f"{name:<20} {method.specification.description}  [{method.origin}]")


@dataclass(frozen=True)
class Bench:
    """Run the experiments and timings behind the published numbers."""


_COMMANDS = (Demo, Scenes, Offcenter, Train, Resume, Eval, Render, Export, View, Show, Inspect, Masks, Methods, Bench)
COMMANDS: dict[str, type] = {command.__name__.lower(): command for command in _COMMANDS}


def train(trainer: Any) -> None:
    """Train, and say where the result is. Exits with 130 if it was stopped by Ctrl-C."""
    from edge_se_sampler.engine.session import describe_run

    print(describe_run(trainer), flush=True)
    trainer.train()
    resume = f"edge-se resume {trainer.run.path}"
    if trainer.stop_requested:
        print(f"edge-se: stopped after {trainer.next_step} iterations and saved; continue: {resume}", file=sys.stderr)
        sys.exit(130)
    print(f"{trainer.next_step} of {trainer.plan.num_steps or '?'} iterations in {trainer.elapsed:.1f} s of training")
    print(f"measure it: edge-se eval {trainer.run.path}")
    if trainer.next_step != trainer.plan.num_steps:
        print(f"continue:   {resume}")
