"""Gives a sampler the step and the model's squared errors: a mixin over any host's VanillaDataManager."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor

from edge_se_sampler.pixel_sampler import ImportantPixels


class SamplerHooks:
    """Mixin: binds the training sampler to the pipeline's model when training begins.

    A host's subclass says how a rendered ray is compared (`ray_errors`) and what a callback before an iteration
    is there (`before_iteration`). The pipeline itself is not kept here: nerfstudio's data manager is a module,
    and would count the model's weights as its own.
    """

    train_pixel_sampler: Any
    train_ray_generator: Any

    def ray_errors(self, model: Any, ray_bundle: Any, batch: dict[str, Tensor]) -> Tensor:
        """(n,) squared errors of the model's fine colours on the batch's pixels."""
        raise NotImplementedError

    def before_iteration(self, func: Any) -> Any:
        """The host's callback that calls func(step=...) before every training iteration."""
        raise NotImplementedError

    def plan(self, trainer: Any) -> dict[str, int]:
        """`planned_steps` and `seed` of the run, as ImportantPixels.bind takes them."""
        return {"planned_steps": trainer.config.max_num_iterations, "seed": trainer.config.machine.seed}

    def get_training_callbacks(self, training_callback_attributes: Any) -> list[Any]:
        """The host's callbacks, and the one that tells the sampler the step."""
        callbacks = super().get_training_callbacks(training_callback_attributes)  # type: ignore[misc]
        sampler = self.train_pixel_sampler
        if isinstance(sampler, ImportantPixels):
            squared_error = partial(self.squared_error, training_callback_attributes.pipeline)
            sampler.bind(squared_error=squared_error, **self.plan(training_callback_attributes.trainer))
            callbacks.append(self.before_iteration(sampler.set_step))
        return callbacks

    @torch.no_grad()
    def squared_error(self, pipeline: Any, candidates: dict[str, Tensor]) -> Tensor:
        """(m,) squared errors of candidate pixels, a training batch at a time: no more memory than training."""
        count = len(candidates["indices"])
        errors = []
        for start in range(0, count, self.train_pixel_sampler.num_rays_per_batch):
            rows = slice(start, start + self.train_pixel_sampler.num_rays_per_batch)
            batch = {key: candidates[key][rows] for key in ("indices", "image")}
            errors.append(self.ray_errors(pipeline.model, self.train_ray_generator(batch["indices"]), batch))
        return torch.cat(errors)
