"""What can be set of the NeRF model, and its three sizes. Torch-free."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from edge_se_sampler.protocol import InstantiateConfig


@dataclass(frozen=True)
class NeRFModelConfig(InstantiateConfig):
    """The original NeRF: two networks, coarse and fine. What is left out (None) follows from the size."""

    _target: ClassVar[type | str] = "edge_se_sampler.nerf.model:NeRFModel"

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
    num_coarse_samples: int | None = None
    """Stratified samples along a ray."""
    num_importance_samples: int | None = None
    """Further samples of the fine network, where the coarse one has seen something."""
    density_activation: Literal["relu", "softplus"] = "relu"
    """What makes the raw density non-negative; softplus (shifted by 1, the last interval finite) cannot die."""
    initialization: Literal["xavier", "torch"] = "xavier"
    """Initial weights: Xavier with zero biases (the original), or torch's default (its ports)."""
    density_noise: float = 0.0
    """Standard deviation of noise added to the raw density in training."""
    background_color: Literal["white", "black", "random"] = "white"
    """What is behind the scene; random: another colour for every training ray, white in evaluation."""
    near: float = 2.0
    """Depth along the optical axis at which samples begin, world units."""
    far: float = 6.0
    """Depth at which samples end."""


@dataclass(frozen=True)
class InfoNeRFModelConfig(NeRFModelConfig):
    """NeRF with InfoNeRF's losses on rays of poses between the training views, for few of them."""

    _target: ClassVar[type | str] = "edge_se_sampler.nerf.info:InfoNeRFModel"

    num_unseen_rays: int | None = None
    """Unseen rays of a step; left out, as many as it trains on (its code: 1024 and 1024)."""
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


@dataclass(frozen=True)
class SizePreset:
    """One size: the model, and a plan of training that suits it."""

    model: NeRFModelConfig
    learning_rate: float
    rays: int
    iterations: int


# tiny is wide rather than deep: 0.4 % of 500 seeds begin with a dead network, where 4 x 64 has 3.7 % of 300, at the
# same quality for the same steps. At a rate of 5e-3 one of 18 seeds lost a network early, at 2.5e-3 to 3e-3 none of 12.
SIZES: dict[str, SizePreset] = {
    "paper": SizePreset(NeRFModelConfig("paper", 256, 8, 10, 4, 64, 128), 5e-4, 1024, 200_000),
    "small": SizePreset(NeRFModelConfig("small", 128, 4, 8, 3, 48, 48), 2e-3, 512, 20_000),
    "tiny": SizePreset(NeRFModelConfig("tiny", 96, 2, 6, 2, 32, 32), 3e-3, 512, 1_500),
}


def size_for(pixels_a_side: int) -> str:
    """The size that "auto" stands for: by the images' longer side."""
    if pixels_a_side <= 128:
        return "tiny"
    return "small" if pixels_a_side <= 256 else "paper"


def resolved(config: NeRFModelConfig, size: str, rays: int) -> NeRFModelConfig:
    """The config with every None replaced by the size's value, or by a step's number of rays."""
    preset = SIZES[size].model
    if isinstance(config, InfoNeRFModelConfig) and config.num_unseen_rays is None:
        config = replace(config, num_unseen_rays=rays)
    chosen = {key: getattr(preset, key) if value is None else value for key, value in vars(config).items()}
    return replace(config, **chosen | {"size": size})
