"""Important-pixel sampling on nerfstudio's own base classes.

Imports no more of nerfstudio than its pixel samplers, so that the contract can be tested without a full installation.
"""
# pyright: reportMissingImports=false
# nerfstudio's pins rule out the environment that is linted; here its classes count as unknown

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from nerfstudio.data.pixel_samplers import PixelSampler, PixelSamplerConfig

from edge_se_sampler.errors import InputError
from edge_se_sampler.pixel_sampler import ImportantPixels
from edge_se_sampler.sampling_settings import SamplingSettings

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
        # both come from the cameras: the host's sampler then draws by solid angle, or inside the crop circle alone
        if bool(self.is_equirectangular):
            raise InputError("the cameras are equirectangular: important pixels suit other cameras only; " + INSTEAD)
        if self.fisheye_crop_radius is not None:
            raise InputError("the cameras have a fisheye_crop_radius: important pixels ignore it; " + INSTEAD)


class EdgeSEPixelSampler(ImportantPixels, PixelSampler):
    """The same sampling as on our own protocol's base; the host contributes its config and its number of rays."""
