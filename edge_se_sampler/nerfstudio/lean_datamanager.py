"""The data manager of lean-nerf: what the model derives the scene's cells from, and pixels whose rays meet one."""
# pyright: reportMissingImports=false
# nerfstudio's pins rule out the environment that is linted; here its classes count as unknown

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.nerfstudio.datamanager import EdgeSEDataManager, EdgeSEDataManagerConfig
from edge_se_sampler.nerfstudio.pixel_sampler import EdgeSEPixelSamplerConfig
from edge_se_sampler.nerfstudio.training_images import TrainingImages
from edge_se_sampler.sampling.settings import SamplingSettings


class LeanDataManager(EdgeSEDataManager):
    """Trains on `TrainingImages`, which it passes on to the model; evaluation has nerfstudio's own."""

    def create_train_dataset(self) -> TrainingImages:
        """As nerfstudio's; the model finds in its metadata what `LeanNerfModel` needs."""
        outputs = self.train_dataparser_outputs
        dataset = TrainingImages(outputs, self.config.camera_res_scale_factor)
        dataset.metadata |= {
            # a model that only renders has its cells from a checkpoint, and no images need be there
            "read_views": None if self.test_mode == "inference" else dataset.read_views,
            "alpha_color": outputs.alpha_color,
            "train_num_rays_per_batch": self.config.train_num_rays_per_batch,
        }
        return dataset

    def setup_train(self) -> None:
        """As nerfstudio's, with the images' alpha, which it composites where they are only looked at."""
        self.train_dataset.keep_alpha()
        super().setup_train()

    def get_training_callbacks(self, training_callback_attributes: Any) -> list[Any]:
        """As EdgeSEDataManager, once the model's cells tell which pixels see any."""
        model = training_callback_attributes.pipeline.model
        hit_pixels, model.hit_pixels = model.hit_pixels, None
        if hit_pixels is not None:
            settings = self.config.pixel_sampler.resolve_auto(has_masks=True)
            self.train_pixel_sampler = settings.setup(num_rays_per_batch=self.config.train_num_rays_per_batch)
            if self.train_image_dataloader.cache_all_images:
                _add_masks(self.train_image_dataloader.cached_collated_batch, hit_pixels)
            else:
                self.train_dataset.hit_pixels = hit_pixels
        return super().get_training_callbacks(training_callback_attributes)


def _add_masks(batch: dict[str, Any], hit_pixels: list[np.ndarray]) -> None:
    """Train, of the images of a batch, only on pixels (H, W) bool, by the image's number."""
    masks = [torch.from_numpy(hit_pixels[i])[..., None] for i in batch["image_idx"].tolist()]
    if "mask" in batch:
        masks = [mask & own.bool().cpu() for mask, own in zip(masks, batch["mask"], strict=True)]
    batch["mask"] = torch.stack(masks) if isinstance(batch["image"], Tensor) else masks


@dataclass
class LeanPixelSamplerConfig(EdgeSEPixelSamplerConfig):
    """The pixel sampler of lean-nerf, whose loss takes weights."""

    loss_takes_weights: ClassVar[bool] = True
    soft_mining_alpha: float = SamplingSettings.soft_mining_alpha
    """Soft Mining weights the loss by this power of 1 / error; 0: not at all."""


@dataclass
class LeanDataManagerConfig(EdgeSEDataManagerConfig):
    """The data manager of lean-nerf."""

    _target: type = field(default_factory=lambda: LeanDataManager)
    pixel_sampler: LeanPixelSamplerConfig = field(  # pyright: ignore[reportIncompatibleVariableOverride]
        default_factory=LeanPixelSamplerConfig
    )
    """Which pixels are trained on."""
