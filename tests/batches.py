"""Image batches as hosts hand them to a pixel sampler, and samplers that follow a training run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.engine.plan import Plan
from edge_se_sampler.sampling.pixel_sampler import EdgeSEPixelSampler
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig

SAME = [(9, 14)] * 3
MIXED = [(9, 14), (20, 6), (5, 5)]
NUMBERS = [7, 3, 11]
"""Absolute image numbers, neither 0, 1, 2 nor in order."""


def picture(number: int, size: tuple[int, int], channels: int, dtype: torch.dtype) -> Tensor:
    """An image that depends on its absolute number alone."""
    pixels = np.random.default_rng(number).integers(0, 256, (*size, channels), dtype=np.uint8)
    return torch.from_numpy(pixels) if dtype == torch.uint8 else torch.from_numpy(pixels).to(dtype) / 255


def address(number: int, size: tuple[int, int]) -> Tensor:
    """(H, W, 3): at every pixel its own image number, row and column."""
    row, column = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    return torch.stack((torch.full(size, number), row, column), dim=2)


def batch_of(
    sizes: Sequence[tuple[int, int]] = SAME,
    numbers: Sequence[int] = NUMBERS,
    *,
    channels: int = 3,
    dtype: torch.dtype = torch.uint8,
    masks: Sequence[Tensor] | None = None,
    stacked: bool | None = None,
) -> dict[str, Any]:
    """A host's batch: images, their addresses as another per-pixel key, and masks (H, W) if there are any."""
    both = list(zip(numbers, sizes, strict=True))
    batch: dict[str, Any] = {
        "image": [picture(number, size, channels, dtype) for number, size in both],
        "address": [address(number, size) for number, size in both],
    }
    if masks is not None:
        batch["mask"] = [mask[..., None] for mask in masks]
    if len(set(sizes)) == 1 if stacked is None else stacked:
        batch = {key: torch.stack(value) for key, value in batch.items()}
    return batch | {"image_idx": torch.tensor(numbers)}


def half_masks(sizes: Sequence[tuple[int, int]]) -> list[Tensor]:
    """Masks (H, W) bool that leave about half the pixels of each image, at random."""
    return [torch.from_numpy(np.random.default_rng(k).random(size) < 0.5) for k, size in enumerate(sizes)]


def brightness(candidates: dict[str, Any]) -> Tensor:
    """Stands in for a model's squared errors."""
    return candidates["image"].float().mean(dim=1)


def following(
    step: int = 0,
    *,
    rays: int = 64,
    planned: int = 1000,
    seed: int = 0,
    squared_error: Any = brightness,
    rank: int = 0,
    world: int = 1,
    **settings: Any,
) -> EdgeSEPixelSampler:
    """A sampler bound to a run of `planned` steps, about to train `step`."""
    sampler = EdgeSEPixelSampler(EdgeSEPixelSamplerConfig(**settings), num_rays_per_batch=rays)
    progress = Plan(planned).progress
    sampler.bind(squared_error=squared_error, progress=progress, seed=seed, rank=rank, world=world)
    sampler.set_step(step)
    return sampler


LATE = 500
"""A step well in the late phase of 1000."""
