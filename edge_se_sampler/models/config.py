"""What can be set of the models, and what the three sizes stand for. Torch-free."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, TypeVar

from edge_se_sampler.errors import InputError, check_value
from edge_se_sampler.protocol import ADDED_LATER, InstantiateConfig

INFINITY = float("inf")
MAX_DEPTH = 1e25
"""World units: a checkpoint's box, which reaches so far, may not be larger than 1e30."""
MAX_SAMPLES, MAX_RAYS = 2**14, 2**24
"""Of a ray along it, and rays of a step: more would be a mistake, or a stranger's."""
BYTES_PER_RAY = 2**15
"""Of the lean model's samples on a ray of a training step."""
RAYS_PER_CHUNK = 2**16
"""Rays that it looks at at once."""
GIB_PER_PIXEL = 1 / 400
"""Memory of the lean model's cells, by the longest side of the images."""
MAX_MEMORY = 2**20
"""GiB for them: more would be a mistake, or a stranger's."""
POINTS_PER_CHUNK = {"cpu": 2**14, "cuda": 2**19}
"""Points that NeRF evaluates at once, by device: bounds the memory. Each chunk draws its own jitter, so another value
gives another (equally good) training run."""


@dataclass(frozen=True)
class SizePreset:
    """The numbers that a size stands for: networks, samples of a ray, and a training schedule that suits them."""

    width: int
    depth: int
    position_frequencies: int
    direction_frequencies: int
    learning_rate: float
    rays: int
    """Of a training step."""
    iterations: int
    num_coarse_samples: int = 0
    num_importance_samples: int = 0
    num_unseen_rays: int = 0

    def overridden_by(self, values: Mapping[str, Any]) -> SizePreset:
        """The preset with its numbers replaced by the values of the same names; None replaces nothing."""
        return replace(self, **{key: value for key, value in values.items() if key in vars(self) and value is not None})


# A small network is wide rather than deep: a deep narrow one more often starts dead, at the same quality. Higher
# learning rates than tiny's lose a network now and then.
NERF_PRESETS = {
    "paper": SizePreset(256, 8, 10, 4, 5e-4, 1024, 200_000, num_coarse_samples=64, num_importance_samples=128),
    "small": SizePreset(128, 4, 8, 3, 2e-3, 512, 20_000, num_coarse_samples=48, num_importance_samples=48),
    "tiny": SizePreset(96, 2, 6, 2, 3e-3, 512, 1_500, num_coarse_samples=32, num_importance_samples=32),
}
LEAN_PRESETS = {
    "paper": SizePreset(64, 1, 0, 0, 2.8e-2, 8192, 7_000),
    "small": SizePreset(64, 1, 0, 0, 2.8e-2, 4096, 5_000),
    "tiny": SizePreset(64, 1, 0, 0, 2.8e-2, 2048, 4_000),
}


@dataclass(frozen=True)
class ModelConfig(InstantiateConfig, ABC):
    """What every model has. What is left out (None) follows from the size, see `apply_preset`."""

    presets: ClassVar[Mapping[str, SizePreset]] = NERF_PRESETS

    size: Literal["auto", "paper", "small", "tiny"] = "auto"
    """Decides what no other flag does: a NeRF's networks and samples, rays of a step, and iterations (paper: 200,000,
    small: 20,000, tiny: 1,500; of lean-nerf 7,000, 5,000, 4,000). auto: tiny for images of at most 128 pixels on their
    longer side, small up to 256, else paper."""
    background_color: Literal["white", "black", "random"] = "white"
    """Background of the scene; random: another color for every training ray, white in evaluation."""
    near: float | None = None
    """Depth along the optical axis at which samples begin, world units; by default from the scene, see inspect."""
    far: float | None = None
    """Depth at which samples end, world units; by default from the scene."""
    voxel_size_px: float = 1.0
    """A quarter of a grid cell's size, where there is a grid (empty-space-skipping), in footprints of a pixel at the
    center of the scene; larger where there would be too many cells."""

    @property
    def preset(self) -> SizePreset:
        """The numbers of its size, which is not auto, with those set here in their place: none is left open."""
        return self.presets[self.size].overridden_by(vars(self))

    @property
    def depths(self) -> tuple[float, float]:
        """Near and far; NeRF-synthetic's, where no scene has decided."""
        return 2.0 if self.near is None else self.near, 6.0 if self.far is None else self.far

    @property
    def background_level(self) -> float:
        """The evaluation background's red, green and blue, all the same: 0 black, 1 white."""
        return 0.0 if self.background_color == "black" else 1.0

    @property
    def needs_grid(self) -> bool:
        """Whether the model is built on the scene's occupancy grid."""
        return True

    @property
    def culls_by_alpha(self) -> bool:
        """Whether the grid is the visual hull of the alpha masks, where there are any."""
        return True

    @abstractmethod
    def training_memory(self, has_alpha: bool, rays: int) -> int:
        """Bytes that training with so many rays a step takes at most on a CPU, beside images, which have alpha or not;
        the size is decided."""

    def check(self, prefix: str = "") -> None:
        """Raise InputError, with flags' names of this prefix, if a value is out of its range; the size is decided."""
        near, far = self.depths
        if not 0 <= near < far <= MAX_DEPTH:
            raise InputError(f"--{prefix}near is {near}, --{prefix}far {far}: 0 <= near < far <= {MAX_DEPTH:g}")
        size_px = self.voxel_size_px
        check_value(f"{prefix}voxel-size-px", size_px, 0.01 <= size_px <= 1000, "at least 0.01, at most 1000")


@dataclass(frozen=True)
class NeRFModelConfig(ModelConfig):
    """The original NeRF: two networks, coarse and fine."""

    _target: ClassVar[type | str] = "edge_se_sampler.models.nerf:NeRFModel"

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
    num_coarse_samples: int | None = None
    """Stratified samples along a ray."""
    num_importance_samples: int | None = None
    """Further samples for the fine network, drawn by the coarse one's weights."""
    density_activation: Literal["relu", "softplus"] = "relu"
    """What makes the raw density non-negative; softplus (shifted by 1, the last interval finite) cannot die."""
    density_noise: float = 0.0
    """Standard deviation of noise added to the raw density in training."""
    empty_space_skipping: bool = False
    """Evaluate the networks only in the cells that may hold something, by the cameras and alpha; see inspect."""
    hard_samples: bool = field(default=False, metadata=ADDED_LATER)
    """Evaluate all samples, but differentiate only those that matter, drawn by their gradients: cheaper, noisier."""

    @property
    def needs_grid(self) -> bool:
        return self.empty_space_skipping

    @property
    def culls_by_alpha(self) -> bool:
        return self.empty_space_skipping

    def training_memory(self, has_alpha: bool, rays: int) -> int:
        """Of two networks the weights, their gradients and Adam's two means; of a chunk's points what each layer
        returns, and its gradient."""
        preset = self.preset
        layers = preset.depth + 2  # one more for features, a half for the direction, the encodings
        num_points = max(POINTS_PER_CHUNK["cpu"], 2 * preset.num_coarse_samples + preset.num_importance_samples)
        return 4 * preset.width * layers * (2 * 4 * preset.width + 2 * num_points)

    def check(self, prefix: str = "") -> None:
        super().check(prefix)
        preset = self.preset
        check_value(f"{prefix}depth", preset.depth, preset.depth >= 1, "at least 1")
        width_rule = "at least 2 (the layer of the direction has half of it)"
        check_value(f"{prefix}width", preset.width, preset.width >= 2, width_rule)
        for name in ("position", "direction"):
            frequencies = getattr(preset, f"{name}_frequencies")
            check_value(f"{prefix}{name}-frequencies", frequencies, 0 <= frequencies <= 24, "between 0 and 24")
        coarse, fine = preset.num_coarse_samples, preset.num_importance_samples
        check_value(f"{prefix}num-coarse-samples", coarse, 3 <= coarse <= MAX_SAMPLES, f"3 to {MAX_SAMPLES}")
        check_value(f"{prefix}num-importance-samples", fine, 1 <= fine <= MAX_SAMPLES, f"1 to {MAX_SAMPLES}")
        check_value(f"{prefix}density-noise", self.density_noise, 0 <= self.density_noise < INFINITY, "at least 0")


@dataclass(frozen=True)
class LeanModelConfig(ModelConfig):
    """Density and features at the corners of sparse cells, and a small network for color."""

    _target: ClassVar[type | str] = "edge_se_sampler.models.lean:LeanModel"
    presets: ClassVar[Mapping[str, SizePreset]] = LEAN_PRESETS

    voxel_size_px: float = 1.0
    """About the size of the finest cells, in footprints of a pixel at the center of the scene; as memory and what was
    seen of the scene allow, half as large to twice as large."""
    cull_by_alpha: bool = True
    """Leave out what lies outside the visual hull of the alpha masks."""
    near_share: float | None = field(default=None, metadata=ADDED_LATER)
    """Rays begin no nearer than at this share of the way to what the cameras look at. By default as a reconstruction's
    points tell; without those, 0 where masks show all of an object, else as features tell, or 0.45 without any. 0 with
    a near."""
    step_size_voxels: float = 1.0
    """Distance between samples, as a multiple of a cell's size."""
    alpha_threshold: float = 0.02
    """Samples of less opacity are left out."""
    weight_threshold: float = 0.004
    """Samples that count less in their ray's color are not asked for one."""
    transmittance_threshold: float = 0.006
    """A ray ends where less of its light passes."""
    visible_threshold: float = field(default=0.05, metadata=ADDED_LATER)
    """Where less of a ray's light arrives, training changes the color, but not the density: else what a surface lets
    through would make opaque what is behind it, which other views may see beside it."""
    prune_weight: float = 0.04
    """Cells that never counted more in a ray's color are pruned."""
    density_lr_scale: float = 7.5
    """Learning rate of the density, as a multiple of the network's."""
    feature_lr_scale: float = 3.6
    """Learning rate of the features, as a multiple of the network's."""
    total_variation: float = 1e-5
    """How much, beside a ray's squared error, squared differences between features of neighboring corners count."""
    alpha_loss: float = 0.3
    """How much, beside a ray's squared error, that of its opacity against alpha counts: else what has the background's
    color may float in front of it."""
    supersample: bool = True
    """In trainings long enough for it, let a pixel be the mean of 2 x 2 rays at last: better, but rendering takes up to
    four times as long."""
    max_memory: float | None = None
    """About how many GiB density and features may take in training: the finest cells become as small as that allows.
    Left out: 1 for images of 400 pixels, in proportion to their longest side."""

    @property
    def culls_by_alpha(self) -> bool:
        return self.cull_by_alpha

    def training_memory(self, has_alpha: bool, rays: int) -> int:
        """The rows of cells and their corners, and the samples of a step's rays; the box that holds them, most of it
        empty, takes as much again where no hull makes it small."""
        assert self.max_memory is not None
        valid = 0 < self.max_memory <= MAX_MEMORY  # what is not, is refused later
        rows = int(self.max_memory * 2**30 if valid else 0)
        return (rows if has_alpha and self.cull_by_alpha else 2 * rows) + BYTES_PER_RAY * min(rays, RAYS_PER_CHUNK)

    def check(self, prefix: str = "") -> None:
        super().check(prefix)
        step = self.step_size_voxels
        check_value(f"{prefix}step-size-voxels", step, 0.05 <= step < INFINITY, "at least 0.05")
        share = self.near_share
        check_value(f"{prefix}near-share", share, share is None or 0 <= share < 1, "in [0, 1)")
        thresholds = ("alpha_threshold", "weight_threshold", "transmittance_threshold", "visible_threshold")
        for name in (*thresholds, "prune_weight"):
            value = getattr(self, name)
            check_value(prefix + name.replace("_", "-"), value, 0 <= value < 1, "in [0, 1)")
        for name in ("total_variation", "alpha_loss"):
            value = getattr(self, name)
            check_value(prefix + name.replace("_", "-"), value, 0 <= value < INFINITY, "at least 0")
        memory = self.max_memory
        limits = f"above 0 and at most {MAX_MEMORY:,}"
        check_value(f"{prefix}max-memory", memory, memory is None or 0 < memory <= MAX_MEMORY, limits)
        for name in ("density_lr_scale", "feature_lr_scale"):
            value = getattr(self, name)
            check_value(prefix + name.replace("_", "-"), value, 0 < value < INFINITY, "above 0")


@dataclass(frozen=True)
class InfoNeRFModelConfig(NeRFModelConfig):
    """NeRF with InfoNeRF's losses on rays of poses between the training views, for few of them."""

    _target: ClassVar[type | str] = "edge_se_sampler.models.infonerf:InfoNeRFModel"

    num_unseen_rays: int | None = None
    """Unseen rays of a step; left out, as many as are trained on (its code: 1024 and 1024); 0: none."""
    entropy_weight: float = 0.001
    """Weight of the unseen rays' entropy, in bits."""
    entropy_threshold: float = 0.1
    """Accumulation above which a ray counts as one that hits something."""
    gain_weight: float = 0.0
    """Weight of the information gain, which renders every ray twice. InfoNeRF's code ships with 0 for Blender scenes
    and 2e-5 for DTU; at 1 training does not converge."""
    gain_degrees: float = 5.0
    """Largest angle about each axis by which rays are rotated for the information gain."""
    gain_rate: float = 0.5
    """Factor by which gain_weight decays every gain_steps."""
    gain_steps: int = 5000
    """Iterations between two such decays."""

    def check(self, prefix: str = "") -> None:
        super().check(prefix)
        check_value(f"{prefix}num-unseen-rays", self.num_unseen_rays, self.preset.num_unseen_rays >= 0, "at least 0")
        for name in ("entropy_weight", "gain_weight", "gain_degrees", "gain_rate"):
            value = getattr(self, name)
            check_value(prefix + name.replace("_", "-"), value, 0 <= value < INFINITY, "at least 0")
        threshold = self.entropy_threshold
        check_value(f"{prefix}entropy-threshold", threshold, 0 <= threshold < 1, "in [0, 1)")
        check_value(f"{prefix}gain-steps", self.gain_steps, self.gain_steps >= 1, "at least 1")


Model = TypeVar("Model", bound=ModelConfig)


def decide_size(config: Model, longest: int) -> Model:
    """The config with what is left to the training images replaced by what suits the longest side of them, in pixels:
    size "auto", and the lean model's memory."""
    if isinstance(config, LeanModelConfig) and config.max_memory is None:
        config = replace(config, max_memory=round(GIB_PER_PIXEL * longest, 3))
    if config.size != "auto":
        return config
    return replace(config, size="tiny" if longest <= 128 else "small" if longest <= 256 else "paper")


def apply_preset(config: Model, rays: int) -> Model:
    """A config whose size is decided, with every None replaced by the size's number; as many unseen rays as `rays`,
    those of a training step."""
    preset = vars(config.presets[config.size]) | {"num_unseen_rays": rays}
    return replace(config, **{key: preset[key] for key in preset if getattr(config, key, 0) is None})
