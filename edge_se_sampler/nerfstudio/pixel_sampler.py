"""The pixel sampler on nerfstudio's base classes.

Imports no more of nerfstudio than its pixel samplers, so that the contract can be tested without a full installation.
"""
# pyright: reportMissingImports=false
# nerfstudio's pins rule out the environment that is linted; here its classes count as unknown

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from nerfstudio.data.pixel_samplers import PixelSampler, PixelSamplerConfig

from edge_se_sampler.errors import InputError
from edge_se_sampler.sampling.pixel_sampler import ImportantPixels
from edge_se_sampler.sampling.settings import SamplingSettings

UNBOUND = (
    "edge-se-sampler: this pixel sampler is not bound to a training run and draws uniformly, as evaluation should; "
    "to train with it, use EdgeSEDataManagerConfig or attach(trainer)"
)
NEEDS_WEIGHTS = "weights the loss, and nerfstudio's losses take no weights; train with edge-se"
USE_OWN_SAMPLER = "take one of nerfstudio's own methods, whose sampler supports them"


@dataclass
class EdgeSEPixelSamplerConfig(SamplingSettings, PixelSamplerConfig):
    """The sampler's settings and nerfstudio's in one class, which its flags and config.yml need."""

    _target: type = field(default_factory=lambda: EdgeSEPixelSampler)
    images_per_step: Literal["one", "all"] = "all"
    """Draw a step's pixels from all loaded images (nerfstudio) or from one image (the paper); an image is chosen
    first, a pixel in it second."""
    soft_mining_alpha: float = 0.0
    """Loss weights of Soft Mining: none, for nerfstudio's losses take no weights."""
    loss_takes_weights: ClassVar[bool] = False
    """Whether the model's loss takes the batch's weights."""

    def rules(self) -> list[tuple[str, bool, str]]:
        """Those of every host, and nerfstudio's."""
        no_weights = "nerfstudio's losses take no weights; leave it at 0, or train with edge-se"
        not_alone = "nerfstudio's models render coarse colors only together with the fine ones; take fine or cached"
        rules = [*super().rules(), ("error_source", self.error_source != "coarse", not_alone)]
        if self.loss_takes_weights:
            return rules
        return [
            *rules,
            ("importance_weight", not self.importance_weight, no_weights),
            ("soft_mining_alpha", not self.soft_mining_alpha, no_weights),
            *((phase, getattr(self, phase) != "expansive", NEEDS_WEIGHTS) for phase in ("early", "late")),
        ]

    def check(self) -> None:
        """Raise InputError for a value, a combination or a camera that has no meaning here."""
        super().check()
        # both come from the cameras: the host's sampler then draws by solid angle, or inside the crop circle alone
        if bool(self.is_equirectangular):
            raise InputError("the cameras are equirectangular: not supported here; " + USE_OWN_SAMPLER)
        if self.fisheye_crop_radius is not None:
            raise InputError("the cameras have a fisheye crop radius: not supported here; " + USE_OWN_SAMPLER)


class EdgeSEPixelSampler(ImportantPixels, PixelSampler):
    """The sampler of the standalone program on nerfstudio's base class, with nerfstudio's settings."""

    _warned = False

    def sample(self, image_batch: dict[str, Any]) -> dict[str, Any]:
        """As ImportantPixels.sample; an unbound sampler says once that it draws uniformly. InputError, too, for a
        strategy of another package that weights the loss where the model's takes no weights."""
        if not self.is_bound and not self._warned:
            self._warned = True
            print(UNBOUND, file=sys.stderr)
        pixels = super().sample(image_batch)
        if "weight" in pixels and not self.config.loss_takes_weights:
            raise InputError(f"pixel-sampler: {self.strategy} {NEEDS_WEIGHTS}")
        return pixels

    def __getstate__(self) -> Any:
        """Refuse to be sent to a worker process (nerfstudio's ParallelDataManager), which has no model."""
        raise InputError(
            "a pixel sampler in a worker process has neither the step nor the model, and would draw uniformly: set "
            "config.pipeline.datamanager to an EdgeSEDataManagerConfig instead of a ParallelDataManagerConfig"
        )
