"""What can be set of the NeRF model, and its three sizes. Torch-free."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Generic, Literal, TypeVar

from edge_se_sampler.errors import InputError
from edge_se_sampler.protocol import InstantiateConfig


@dataclass(frozen=True)
class ModelConfig(InstantiateConfig):
    """What every model has. What is left out (None) follows from the size."""

    size: Literal["auto", "paper", "small", "tiny"] = "auto"
    """Networks and samples: the paper's, or smaller ones for smaller images; auto decides by the images."""
    width: int | None = None
    """Neurons of a layer."""
    depth: int | None = None
    """Layers before the density; the encoded position joins again after the fifth."""
    position_frequencies: int | None = None
    """Frequencies that encode a position."""
    direction_frequencies: int | None = None
    """Frequencies that encode a direction."""
    initialization: Literal["xavier", "torch"] = "xavier"
    """Initial weights: Xavier with zero biases (the original), or torch's default (its ports)."""
    background_color: Literal["white", "black", "random"] = "white"
    """Background of the scene; random: another colour for every training ray, white in evaluation."""
    near: float = 2.0
    """Depth along the optical axis at which samples begin, world units."""
    far: float = 6.0
    """Depth at which samples end."""
    empty_space_skipping: bool = False
    """Whether what the scene does not need is left out: auto derives it from cameras and alpha, see inspect."""
    voxel_size_px: float = 1.0
    """Side of a cell that is kept or left out, in pixels' footprints at the middle of the scene; larger where there
    would be more cells than are worth their memory."""

    @property
    def background_level(self) -> float:
        """The evaluation background's red, green and blue, all the same: 0 black, 1 white."""
        return 0.0 if self.background_color == "black" else 1.0


@dataclass(frozen=True)
class NeRFModelConfig(ModelConfig):
    """The original NeRF: two networks, coarse and fine. With it neither is asked outside of the hull."""

    _target: ClassVar[type | str] = "edge_se_sampler.models.nerf:NeRFModel"

    num_coarse_samples: int | None = None
    """Stratified samples along a ray."""
    num_importance_samples: int | None = None
    """Further samples of the fine network, where the coarse one has seen something."""
    density_activation: Literal["relu", "softplus"] = "relu"
    """What makes the raw density non-negative; softplus (shifted by 1, the last interval finite) cannot die."""
    density_noise: float = 0.0
    """Standard deviation of noise added to the raw density in training."""


@dataclass(frozen=True)
class LeanModelConfig(ModelConfig):
    """One small network on features that are kept where the scene is, asked only there."""

    _target: ClassVar[type | str] = "edge_se_sampler.models.lean:LeanModel"

    empty_space_skipping: bool = True
    """Whether the parts below are at work; off: samples along all of the box."""
    cull_by_alpha: bool = True
    """Leave out what lies outside of the alpha masks' visual hull."""
    cull_by_density: bool = True
    """Leave out where training has seen no density; such cells are tried again now and then."""
    step_size_voxels: float = 1.0
    """Distance between samples, in sides of a cell."""
    feature_dim: int = 8
    """Numbers kept at each corner of a cell; 0: the network alone has to know the scene."""
    feature_lr_scale: float = 6.0
    """Learning rate of the features, in the network's."""

    @property
    def learns_cells(self) -> bool:
        """Whether training tells which cells are empty."""
        return self.empty_space_skipping and self.cull_by_density


@dataclass(frozen=True)
class InfoNeRFModelConfig(NeRFModelConfig):
    """NeRF with InfoNeRF's losses on rays of poses between the training views, for few of them."""

    _target: ClassVar[type | str] = "edge_se_sampler.models.infonerf:InfoNeRFModel"

    num_unseen_rays: int | None = None
    """Unseen rays of a step; left out, as many as it trains on (its code: 1024 and 1024); at 0 there is no entropy."""
    entropy_weight: float = 0.001
    """Of the rays' entropy, in bits."""
    entropy_threshold: float = 0.1
    """Accumulation above which a ray counts as one that hits."""
    gain_weight: float = 0.0
    """Of the information gain, which renders every ray twice. Its code ships with 0 for Blender scenes and 2e-5 for
    DTU; at 1 training does not converge."""
    gain_degrees: float = 5.0
    """Rays are turned by up to this about each axis."""
    gain_rate: float = 0.5
    """What the weight is multiplied with every gain_steps."""
    gain_steps: int = 5000
    """Iterations between two such decays."""


Model = TypeVar("Model", bound=ModelConfig)


@dataclass(frozen=True)
class SizePreset(Generic[Model]):
    """One size: the model, and a plan of training that suits it."""

    model: Model
    learning_rate: float
    rays: int
    iterations: int


def _nerf(size: Any, width: int, depth: int, position: int, direction: int, coarse: int, fine: int) -> NeRFModelConfig:
    shape = NeRFModelConfig(size, width, depth, position, direction)
    return replace(shape, num_coarse_samples=coarse, num_importance_samples=fine)


# tiny is wide rather than deep: 0.4 % of 500 seeds begin with a dead network, where 4 x 64 has 3.7 % of 300, at the
# same quality for the same steps. At a rate of 5e-3 one of 18 seeds lost a network early, at 2.5e-3 to 3e-3 none of 12.
SIZES: dict[str, SizePreset[NeRFModelConfig]] = {
    "paper": SizePreset(_nerf("paper", 256, 8, 10, 4, 64, 128), 5e-4, 1024, 200_000),
    "small": SizePreset(_nerf("small", 128, 4, 8, 3, 48, 48), 2e-3, 512, 20_000),
    "tiny": SizePreset(_nerf("tiny", 96, 2, 6, 2, 32, 32), 3e-3, 512, 1_500),
}


def _lean(size: Any, rays: int, iterations: int) -> SizePreset[LeanModelConfig]:
    shape = LeanModelConfig(size, width=64, depth=1, position_frequencies=6, direction_frequencies=2)
    return SizePreset(shape, 6e-3, rays, iterations)


# Seed 100. 100 pixels a side, 2500 steps, rate 2e-3 and features ten times that against 6e-3 and six times: bricks
# 32.23 and 32.61 dB, ficus 30.13 and 30.36, drums 29.28 and 29.71. Two layers and cells of 1.6 pixels against one and
# of 1.0, 60 CPU seconds: bricks 33.76 and 35.08 dB, materials 33.54 and 33.78, mic 33.09 and 33.57. Two layers and 2e-3
# against one and 6e-3: bricks at 200 pixels, 512 rays, 60 s, 33.80 and 34.86 dB; at 400 pixels, 1024 rays and 512,
# 100 s, 33.35 and 34.41, drums 29.77 and 30.75. 4, 6, 7 frequencies: 200 pixels, 40 s, bricks 33.91, 34.12, 34.12,
# drums 30.38, 30.42, 30.49; 4, 6, 8 at 400 pixels, 80 s, bricks 33.65, 33.88, 33.78; at 100 pixels see the chart
LEAN = {"paper": _lean("paper", 512, 30_000), "small": _lean("small", 512, 20_000), "tiny": _lean("tiny", 256, 12_000)}


def check_fineness(config: ModelConfig, prefix: str = "") -> None:
    """Refuse depths, cells and steps that no scene can be divided by.

    Args:
        prefix: of the flags' names.

    Raises:
        InputError: one is out of its range.
    """
    if not 0 <= config.near < config.far < float("inf"):
        raise InputError(f"--{prefix}near is {config.near}, --{prefix}far {config.far}: 0 <= near < far")
    if not 0 < config.voxel_size_px <= 1000:
        raise InputError(f"--{prefix}voxel-size-px is {config.voxel_size_px}: must be above 0, at most 1000")
    if isinstance(config, LeanModelConfig) and not 0.05 <= config.step_size_voxels < float("inf"):
        raise InputError(f"--{prefix}step-size-voxels is {config.step_size_voxels}: must be at least 0.05")


def size_for(pixels_a_side: int) -> str:
    """The size that "auto" stands for: by the images' longer side."""
    if pixels_a_side <= 128:
        return "tiny"
    return "small" if pixels_a_side <= 256 else "paper"


def preset_of(config: ModelConfig, size: str) -> SizePreset[Any]:
    """What a size stands for, with this kind of model."""
    return (LEAN if isinstance(config, LeanModelConfig) else SIZES)[size]


def apply_preset(config: Model, size: str, rays: int) -> Model:
    """The config with every None replaced by the size's value, or by a step's number of rays."""
    preset = preset_of(config, size).model
    if isinstance(config, InfoNeRFModelConfig) and config.num_unseen_rays is None:
        config = replace(config, num_unseen_rays=rays)
    chosen = {key: getattr(preset, key) if value is None else value for key, value in vars(config).items()}
    return replace(config, **chosen | {"size": size})
