"""Images in memory -> the rays and pixels of a training step, with nerfstudio's names."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler import ranks
from edge_se_sampler.data.cameras import Cameras, RayBundle
from edge_se_sampler.data.config import VanillaDataManagerConfig
from edge_se_sampler.data.views import Views
from edge_se_sampler.errors import InputError
from edge_se_sampler.protocol import (
    PixelSampler,
    TrainingCallback,
    TrainingCallbackAttributes,
    TrainingCallbackLocation,
)
from edge_se_sampler.sampling.image_batch import unit_interval
from edge_se_sampler.sampling.pixel_sampler import ImportantPixels, build_scorer
from edge_se_sampler.sampling.settings import SamplingSettings


class VanillaDataManager:
    """Holds the training images, on the CPU as uint8, and asks a pixel sampler which of their pixels to train on.
    `config` has train_num_rays_per_batch resolved; `background_color` (RGB) is for samplers that look at colors."""

    def __init__(
        self,
        config: VanillaDataManagerConfig,
        *,
        views: Views,
        device: torch.device | str = "cpu",
        background_color: tuple[float, float, float] = (1.0, 1.0, 1.0),
    ) -> None:
        self.config, self.device, self.image_batch = config, device, image_batch(views)
        self.cameras = views.cameras.to(device, torch.float32)
        # a host's sampler may write into its config
        self.train_pixel_sampler = copy.copy(config.pixel_sampler).setup(
            num_rays_per_batch=config.train_num_rays_per_batch, background_color=background_color
        )
        if isinstance(self.train_pixel_sampler, ImportantPixels):
            self.train_pixel_sampler.check_images(self.image_batch)

    def next_train(self, step: int) -> tuple[RayBundle, dict[str, Tensor]]:
        """The rays of a training step and their pixels: "image" (N, 3|4) in [0, 1], "indices" (N, 3), ..."""
        batch = self.train_pixel_sampler.sample(self.image_batch)
        batch["image"] = unit_interval(batch["image"])
        batch |= {key: value.to(self.device) for key, value in batch.items() if key != "full_image"}
        return self.cameras.pixel_rays(batch["indices"]), batch

    def observe(self, squared_error: Tensor) -> None:
        """Tell the sampler the (N,) squared errors that training found on the last batch, 0 for other ranks' rays."""
        sampler = self.train_pixel_sampler
        if isinstance(sampler, ImportantPixels) and sampler.pending_batch is not None:
            sampler.observe(ranks.add_up(squared_error))

    def state_dict(self) -> dict[str, Any]:
        """The pixel sampler's state, for a checkpoint; nothing for a host's sampler that has none."""
        sampler = self.train_pixel_sampler
        return sampler.state_dict() if isinstance(sampler, (PixelSampler, ImportantPixels)) else {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        if state:
            self.train_pixel_sampler.load_state_dict(state)

    def probe_rays(self, n: int, rng: np.random.Generator) -> RayBundle:
        """n rays, uniform in the training images."""
        return random_rays(self.cameras, rng.integers(len(self.cameras), size=n), rng)

    def unseen_rays(self, n: int, rng: np.random.Generator) -> RayBundle:
        """n rays, uniform in the image of a camera somewhere between two training cameras."""
        first, second = rng.choice(len(self.cameras), size=2, replace=len(self.cameras) < 2).tolist()
        camera = self.cameras.interpolate(first, second, rng.random())
        return random_rays(camera, np.zeros(n, dtype=np.int64), rng)

    def get_training_callbacks(self, training_callback_attributes: TrainingCallbackAttributes) -> list[Any]:
        """Bind the pixel sampler to the run; the callback sets its step."""
        sampler, trainer = self.train_pixel_sampler, training_callback_attributes.trainer
        if not isinstance(sampler, ImportantPixels):
            return []
        pipeline = training_callback_attributes.pipeline
        scorer = build_scorer(sampler, pipeline, self.cameras.pixel_rays, self.ray_errors)
        sampler.bind(squared_error=scorer, progress=trainer.first_progress, seed=trainer.config.machine.seed)
        return [TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], sampler.set_step)]

    def ray_errors(self, model: Any, ray_bundle: RayBundle, batch: dict[str, Tensor]) -> Tensor:
        """(n,) squared errors of the model's fine colors, or of its coarse ones if so configured, in training mode."""
        image = unit_interval(batch["image"]).to(self.device)
        settings = self.train_pixel_sampler.config
        coarse = isinstance(settings, SamplingSettings) and settings.error_source == "coarse"
        errors = torch.zeros(len(ray_bundle), dtype=model.dtype, device=self.device)
        for rows in model.own_chunks(len(ray_bundle)):
            rays, pixels = ray_bundle[rows], image[rows]
            errors[rows] = (
                model.coarse_squared_error(rays, pixels) if coarse else model.squared_error(model(rays), pixels)
            )
        return ranks.add_up(errors)


def random_rays(cameras: Cameras, camera_indices: np.ndarray, rng: np.random.Generator) -> RayBundle:
    """A ray through a pixel drawn uniformly from the image of each of (n,) cameras."""
    size = torch.cat((cameras.height, cameras.width), dim=1).cpu().numpy()[camera_indices]
    pixels = (rng.random((len(camera_indices), 2)) * size).astype(np.int64)
    return cameras.pixel_rays(torch.from_numpy(np.concatenate((camera_indices[:, None], pixels), axis=1)))


def image_batch(views: Views) -> dict[str, Any]:
    """All views in nerfstudio's format; InputError if there are none: "image" (n, H, W, 3|4) uint8, "mask" (n, H, W, 1)
    bool if there are any, "image_idx" (n,) int64; lists of n images and masks where sizes differ. Among RGBA images
    RGB ones get opaque alpha."""
    if not views.images:
        raise InputError("there are no training views; transforms_train.json must list at least one frame")
    channels = max(image.shape[2] for image in views.images)
    images = [torch.from_numpy(image) for image in views.images]
    if any(image.shape[2] < channels for image in images):
        images = [torch.nn.functional.pad(image, (0, channels - image.shape[2]), value=255) for image in images]
    batch: dict[str, Any] = {"image": images}
    if views.masks is not None:
        batch["mask"] = [torch.from_numpy(mask)[..., None] for mask in views.masks]
    if len({image.shape for image in images}) == 1:
        batch = {key: torch.stack(value) for key, value in batch.items()}
    return batch | {"image_idx": torch.arange(len(images))}
