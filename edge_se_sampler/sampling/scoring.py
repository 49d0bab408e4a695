"""Squared errors of a model, of any host, at candidate pixels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from edge_se_sampler.sampling.pixel_sampler import ImportantPixels, SquaredError

RayErrors = Callable[[Any, Any, dict[str, Tensor]], Tensor]
"""Model, ray bundle (n rays), batch -> (n,) squared errors of the model's fine colours on the batch's pixels."""


def build_scorer(
    sampler: ImportantPixels, pipeline: Any, ray_generator: Callable[[Tensor], Any], ray_errors: RayErrors
) -> SquaredError:
    """A function that renders a sampler's candidates and returns their squared errors, for `ImportantPixels.bind`.

    Args:
        sampler: its number of rays, which hosts may change at any time, is how many are rendered at once, so that it
            takes no more memory than training.
        pipeline: whose `model` is rendered. It must not be an attribute of a data manager: nerfstudio's is a module,
            and would count the model's weights as its own.
        ray_generator: (n, 3) indices -> ray bundle.
    """

    @torch.no_grad()
    def squared_error(candidates: dict[str, Tensor]) -> Tensor:
        errors = []
        for start in range(0, len(candidates["indices"]), sampler.num_rays_per_batch):
            rows = slice(start, start + sampler.num_rays_per_batch)
            batch = {key: candidates[key][rows] for key in ("indices", "image")}
            errors.append(ray_errors(pipeline.model, ray_generator(batch["indices"]), batch))
        return torch.cat(errors)

    return squared_error
