"""The commands of `edge-se`; here those on data and experiments. Torch is imported only when a command runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from edge_se_sampler.data.config import DataFormat
from edge_se_sampler.data.config import Masks as MeaningOfMasks
from edge_se_sampler.engine.config import PipelineConfig, TrainerConfig
from edge_se_sampler.errors import check_value
from edge_se_sampler.methods import registered_methods
from edge_se_sampler.models.config import MAX_RAYS, LeanModelConfig, ModelConfig, NeRFModelConfig
from edge_se_sampler.run_commands import Eval, Export, Render, Resume, View
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig

if TYPE_CHECKING:
    from edge_se_sampler.data.views import Views


@dataclass(frozen=True)
class Demo:
    """Train Random, Edge + SE and lean-nerf on an off-center, mostly white scene, in two to three minutes."""

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

    def _read(self, model: ModelConfig) -> Views:
        """The training views; `model` is what they are to be trained with."""
        from edge_se_sampler.engine.session import read_train_views

        names = ("data", "data_format", "masks", "eval_every", "downscale")
        settings = {name: getattr(self, name) for name in names}
        return read_train_views(TrainerConfig(**settings, pipeline=PipelineConfig(model=model)))


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
        check_value("pixel-sampler.num-rays-per-batch", rays, 1 <= rays <= MAX_RAYS, f"from 1 to {MAX_RAYS}")
        check_output(self.output_path, ".png")
        views = self._read(NeRFModelConfig())
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

        check_output(self.output_path, ".png")
        config = LeanModelConfig(near=self.near, far=self.far, voxel_size_px=self.voxel_size_px)
        print(inspect(self._read(config), config, self.output_path))
        print(self.output_path)


@dataclass(frozen=True, kw_only=True)
class Masks:
    """Find the masks of an object in front of a plain background: a wall, a table, a turntable."""

    data: Path
    """Folder of images and cameras; the masks are written into it, as `masks/` or beside images_2 as `masks_2/`."""
    out: Path | None = None
    """Write `masks/` into this folder instead, where --data may not be written to."""
    data_format: DataFormat = "auto"
    """Insist on a format where a folder has several."""
    output_path: Path = Path("masks.png")
    """The picture to write, to judge the masks by."""

    def run(self) -> None:
        from edge_se_sampler.data.dataset import DataSettings
        from edge_se_sampler.masks.command import make_masks

        print(make_masks(self.data, DataSettings(self.data_format), self.output_path, self.out))


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
