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


def resolved(config: NeRFModelConfig, size: str) -> NeRFModelConfig:
    """The config with every None replaced by the size's value."""
    preset = SIZES[size].model
    chosen = {key: getattr(preset, key) if value is None else value for key, value in vars(config).items()}
    return replace(config, **chosen | {"size": size})
