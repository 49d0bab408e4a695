"""Settings of the data manager. Torch-free."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

from edge_se_sampler.protocol import InstantiateConfig, PixelSamplerConfig
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig

DataFormat = Literal["auto", "blender", "transforms", "colmap", "llff"]
Masks = Literal["ignore", "object"]


@dataclass(frozen=True)
class VanillaDataManagerConfig(InstantiateConfig):
    """Keeps all images in memory; a pixel sampler chooses the pixels of each step."""

    _target: ClassVar[type | str] = "edge_se_sampler.data.datamanager:VanillaDataManager"

    train_num_rays_per_batch: int | None = None
    """Rays of a training step; left out, the preset of the model's size decides."""
    skip_empty_rays: bool = False
    """Train only on pixels whose ray hits a cell that may be occupied (the visual hull): others have no gradient."""
    pixel_sampler: PixelSamplerConfig = field(default_factory=EdgeSEPixelSamplerConfig)
    """Chooses the pixels. In Python any config with nerfstudio's contract will do, nerfstudio's own included."""
