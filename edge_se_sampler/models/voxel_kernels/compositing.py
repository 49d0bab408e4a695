"""Compositing compiled, ray by ray."""

# pyright: reportCallIssue=false
from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from edge_se_sampler.models.voxel_ops import Samples

f32 = np.float32


def composite(tau: Tensor, color: Tensor, samples: Samples, num_rays: int) -> tuple[Tensor, Tensor, Tensor]:
    """As `voxel_ops.composite`."""
    return _Composite.apply(tau, color, samples.ray_indices, samples.colored, num_rays)


def find_starts(ray_indices: Tensor, num_rays: int) -> np.ndarray:
    """(n + 1,): the first sample of each ray, and the end, of samples on rays (m,), ascending."""
    return np.concatenate(([0], np.bincount(ray_indices.numpy(), minlength=num_rays).cumsum()))


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, tau: Tensor, color: Tensor, ray_indices: Tensor, colored: Tensor, num_rays: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        arrays = [value.detach().numpy() for value in (tau, color, ray_indices, colored)]
        starts = find_starts(ray_indices, num_rays)
        color_starts = np.searchsorted(arrays[3], starts)
        rgb, accumulation, weights, passing = _composite(*arrays, starts, color_starts)
        ctx.arrays = *arrays, starts, color_starts, passing
        outputs = torch.from_numpy(rgb), torch.from_numpy(accumulation)[:, None], torch.from_numpy(weights)
        ctx.mark_non_differentiable(outputs[2])
        return outputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None, None, None]:
        rgb, accumulation = (gradient.contiguous().numpy() for gradient in gradients[:2])
        tau, color = _composite_backward(*ctx.arrays, rgb, accumulation[:, 0])
        return torch.from_numpy(tau), torch.from_numpy(color), None, None, None


@njit(parallel=True, cache=True, error_model="numpy")
def _composite(tau, color, ray_indices, colored, starts, color_starts):
    num_rays = len(starts) - 1
    rgb, accumulation = np.zeros((num_rays, 3), np.float32), np.empty(num_rays, np.float32)
    weights, passing = np.empty(len(colored), np.float32), np.empty_like(tau)
    for ray in prange(num_rays):
        transmittance, c = f32(1), color_starts[ray]
        for i in range(starts[ray], starts[ray + 1]):
            passing[i] = transmittance
            transmittance *= math.exp(-tau[i])
            if c < color_starts[ray + 1] and colored[c] == i:
                weights[c] = passing[i] - transmittance
                for k in range(3):
                    rgb[ray, k] += weights[c] * color[c, k]
                c += 1
        accumulation[ray] = f32(1) - transmittance
    return rgb, accumulation, weights, passing


@njit(parallel=True, cache=True, error_model="numpy")
def _composite_backward(tau, color, ray_indices, colored, starts, color_starts, passing, d_rgb, d_accumulation):
    d_tau, d_color = np.empty_like(tau), np.empty_like(color)
    for ray in prange(len(starts) - 1):
        c = color_starts[ray + 1] - 1
        behind = f32(0)  # what the light that passes a sample adds to the loss
        for i in range(starts[ray + 1] - 1, starts[ray] - 1, -1):
            after = passing[i] * math.exp(-tau[i])
            if i == starts[ray + 1] - 1:
                behind = -after * d_accumulation[ray]
            d_sample = f32(0)
            if c >= color_starts[ray] and colored[c] == i:
                for k in range(3):
                    d_sample += d_rgb[ray, k] * color[c, k]
                    d_color[c, k] = (passing[i] - after) * d_rgb[ray, k]
                c -= 1
            d_tau[i] = after * d_sample - behind
            behind += (passing[i] - after) * d_sample
    return d_tau, d_color
