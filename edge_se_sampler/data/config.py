"""What can be set of the data manager. Torch-free."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from edge_se_sampler.protocol import InstantiateConfig, PixelSamplerConfig
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig


@dataclass(frozen=True)
class VanillaDataManagerConfig(InstantiateConfig):
    """Images in memory, pixels chosen by a pixel sampler."""

    _target: ClassVar[type | str] = "edge_se_sampler.data.datamanager:VanillaDataManager"

    train_num_rays_per_batch: int | None = None
    """Rays of a training step; left out, the model's size decides."""
    skip_empty_rays: bool = False
    """Train only on pixels whose ray meets what the model's economy has kept: the others have no gradient."""
    pixel_sampler: PixelSamplerConfig = field(default_factory=EdgeSEPixelSamplerConfig)
    """Which pixels are trained on. In Python any host's config may stand here, nerfstudio's own included."""
