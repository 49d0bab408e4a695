"""Important-pixel sampling on nerfstudio's own base classes.

Imports no more of nerfstudio than its pixel samplers, so that the contract can be tested without a full installation.
"""
# pyright: reportMissingImports=false
# nerfstudio's pins rule out the environment that is linted; here its classes count as unknown

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import Any, Literal

from nerfstudio.data.pixel_samplers import PixelSampler, PixelSamplerConfig

from edge_se_sampler.errors import InputError
from edge_se_sampler.sampling.pixel_sampler import ImportantPixels
from edge_se_sampler.sampling.settings import SamplingSettings

UNBOUND = (
    "edge-se-sampler: this pixel sampler follows no training run and draws uniformly, as evaluation and export should; "
    "to train with it, use EdgeSEDataManagerConfig or attach(trainer)"
)
INSTEAD = "take one of nerfstudio's own methods, whose sampler knows them"


@dataclass
class EdgeSEPixelSamplerConfig(SamplingSettings, PixelSamplerConfig):
    """Our settings beside nerfstudio's, because tyro's flags and config.yml want one class that is one of theirs."""

    _target: type = field(default_factory=lambda: EdgeSEPixelSampler)
    images_per_step: Literal["one", "all"] = "all"
    """Draw a step's pixels from all images at hand (nerfstudio) or from one image (the paper); an image is chosen
    first, a pixel in it second."""

    def check(self) -> None:
        """Raise InputError for a value, a combination or a camera that has no meaning here."""
        super().check()
        if self.importance_weight:
            raise InputError(
                f"pixel-sampler.importance-weight is {self.importance_weight}: nerfstudio's losses take no weights; "
                "leave it at 0, or train with edge-se"
            )
        if self.error_source == "coarse":
            raise InputError(
                f"pixel-sampler.error-source is {self.error_source!r}: nerfstudio's models render their coarse colours "
                "only together with the fine ones; take fine or cached"
            )
        # both come from the cameras: the host's sampler then draws by solid angle, or inside the crop circle alone
        if bool(self.is_equirectangular):
            raise InputError("the cameras are equirectangular: important pixels suit other cameras only; " + INSTEAD)
        if self.fisheye_crop_radius is not None:
            raise InputError("the cameras have a fisheye_crop_radius: important pixels ignore it; " + INSTEAD)


class EdgeSEPixelSampler(ImportantPixels, PixelSampler):
    """The same sampling as on our own protocol's base; the host contributes its config and its number of rays."""

    def sample(self, image_batch: dict[str, Any]) -> dict[str, Any]:
        """As ImportantPixels.sample; a sampler that follows no training run says so, once, and draws uniformly."""
        if not self.is_bound and not self._warned:
            self._warned = True
            print(UNBOUND, file=sys.stderr)
        return super().sample(image_batch)

    _warned = False

    def __getstate__(self) -> Any:
        """Refuse to be sent to a worker process (nerfstudio's ParallelDataManager), where no model could be asked."""
        raise InputError(
            "a pixel sampler in a worker process knows neither step nor model, and would draw uniformly: set "
            "config.pipeline.datamanager to an EdgeSEDataManagerConfig instead of a ParallelDataManagerConfig"
        )
