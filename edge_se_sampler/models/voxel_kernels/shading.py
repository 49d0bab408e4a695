"""The color network compiled: sample by sample, so that its layers stay in the processor's registers and cache."""

# pyright: reportCallIssue=false
from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from edge_se_sampler.models.voxel_kernels.compositing import find_starts
from edge_se_sampler.models.voxel_ops import NetworkWeights

CHUNK = 64
"""Rays whose gradients of the network are added up together."""
FEATURES, HARMONICS, WIDTH = 16, 16, 64
"""Sizes of the network: constants, so that the compiler knows how often its loops run."""
FAST = {"nsz", "arcp", "contract", "afn", "reassoc"}
"""Freedom of rounding in sums of products, which every number of threads uses alike."""
f32 = np.float32


def shade(features: Tensor, directions: Tensor, ray_indices: Tensor, weights: NetworkWeights) -> Tensor:
    """As `voxel_ops.shade`."""
    return _Shade.apply(features, directions, ray_indices, *vars(weights).values())


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, directions: Tensor, ray_indices: Tensor, *weights: Tensor) -> Tensor:
        starts = find_starts(ray_indices, len(directions))
        w1, wv, bv, w2, b2 = (value.detach().numpy() for value in weights)
        x = features.detach().numpy()
        color, hidden, harmonics = _shade(x, directions.numpy(), starts, w1, wv, bv, w2, b2)
        ctx.arrays = color, hidden, harmonics, x, starts, w1, w2
        return torch.from_numpy(color)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        dx, *dw = (torch.from_numpy(value) for value in _shade_backward(gradients[0].contiguous().numpy(), *ctx.arrays))
        return dx, None, None, *(value.sum(dim=0) for value in dw)


@njit(parallel=True, cache=True, error_model="numpy", fastmath=FAST)
def _shade(x, directions, starts, w1, wv, bv, w2, b2):
    """Colors, hidden layers and rays' harmonics; the samples of a ray are x[starts[ray] : starts[ray + 1]]."""
    num_rays = len(directions)
    color, hidden = np.empty((len(x), 3), np.float32), np.empty((len(x), WIDTH), np.float32)
    harmonics = np.empty((num_rays, HARMONICS), np.float32)
    for chunk in prange((num_rays + CHUNK - 1) // CHUNK):
        view = np.empty(WIDTH, np.float32)
        for ray in range(chunk * CHUNK, min(chunk * CHUNK + CHUNK, num_rays)):
            if starts[ray] == starts[ray + 1]:
                continue
            _spherical_harmonics(directions, harmonics, ray)
            for j in range(WIDTH):
                view[j] = bv[j]
            for k in range(HARMONICS):
                value = harmonics[ray, k]
                for j in range(WIDTH):
                    view[j] += value * wv[k, j]
            for i in range(starts[ray], starts[ray + 1]):
                for j in range(WIDTH):
                    hidden[i, j] = view[j]
                for k in range(0, FEATURES, 4):  # four at once: fewer passes over the layer
                    x0, x1, x2, x3 = x[i, k], x[i, k + 1], x[i, k + 2], x[i, k + 3]
                    for j in range(WIDTH):
                        hidden[i, j] += x0 * w1[k, j] + x1 * w1[k + 1, j] + x2 * w1[k + 2, j] + x3 * w1[k + 3, j]
                red, green, blue = b2[0], b2[1], b2[2]
                for j in range(WIDTH):
                    value = max(hidden[i, j], f32(0))
                    hidden[i, j] = value
                    red += value * w2[0, j]
                    green += value * w2[1, j]
                    blue += value * w2[2, j]
                color[i, 0], color[i, 1], color[i, 2] = _sigmoid(red), _sigmoid(green), _sigmoid(blue)
    return color, hidden, harmonics


@njit(cache=True, inline="always", error_model="numpy")
def _spherical_harmonics(directions, harmonics, i):
    x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
    xx, yy, zz = x * x, y * y, z * z
    harmonics[i, 0] = f32(0.28209479)
    harmonics[i, 1] = f32(-0.48860251) * y
    harmonics[i, 2] = f32(0.48860251) * z
    harmonics[i, 3] = f32(-0.48860251) * x
    harmonics[i, 4] = f32(1.09254843) * x * y
    harmonics[i, 5] = f32(-1.09254843) * y * z
    harmonics[i, 6] = f32(0.31539157) * (f32(2) * zz - xx - yy)
    harmonics[i, 7] = f32(-1.09254843) * x * z
    harmonics[i, 8] = f32(0.54627421) * (xx - yy)
    harmonics[i, 9] = f32(-0.59004359) * y * (f32(3) * xx - yy)
    harmonics[i, 10] = f32(2.89061144) * x * y * z
    harmonics[i, 11] = f32(-0.45704579) * y * (f32(4) * zz - xx - yy)
    harmonics[i, 12] = f32(0.37317633) * z * (f32(2) * zz - f32(3) * xx - f32(3) * yy)
    harmonics[i, 13] = f32(-0.45704579) * x * (f32(4) * zz - xx - yy)
    harmonics[i, 14] = f32(1.44530572) * z * (xx - yy)
    harmonics[i, 15] = f32(-0.59004359) * x * (xx - f32(3) * yy)


@njit(cache=True, inline="always", error_model="numpy")
def _sigmoid(x):
    return f32(1) / (f32(1) + math.exp(-x))


@njit(parallel=True, cache=True, error_model="numpy", fastmath=FAST)
def _shade_backward(d_color, color, hidden, harmonics, x, starts, w1, w2):
    """Gradients of x, and of the network for each chunk of rays, to be added up in their order."""
    num_rays = len(starts) - 1
    chunks = (num_rays + CHUNK - 1) // CHUNK
    dx = np.empty_like(x)
    dw1, dwv = np.zeros((chunks, FEATURES, WIDTH), np.float32), np.zeros((chunks, HARMONICS, WIDTH), np.float32)
    dbv, dw2 = np.zeros((chunks, WIDTH), np.float32), np.zeros((chunks, 3, WIDTH), np.float32)
    db2 = np.zeros((chunks, 3), np.float32)
    for chunk in prange(chunks):
        d_hidden, d_view = np.empty(WIDTH, np.float32), np.empty(WIDTH, np.float32)
        for ray in range(chunk * CHUNK, min(chunk * CHUNK + CHUNK, num_rays)):
            if starts[ray] == starts[ray + 1]:
                continue
            for j in range(WIDTH):
                d_view[j] = f32(0)
            for i in range(starts[ray], starts[ray + 1]):
                red = d_color[i, 0] * color[i, 0] * (f32(1) - color[i, 0])
                green = d_color[i, 1] * color[i, 1] * (f32(1) - color[i, 1])
                blue = d_color[i, 2] * color[i, 2] * (f32(1) - color[i, 2])
                db2[chunk, 0] += red
                db2[chunk, 1] += green
                db2[chunk, 2] += blue
                for j in range(WIDTH):
                    value = hidden[i, j]
                    dw2[chunk, 0, j] += red * value
                    dw2[chunk, 1, j] += green * value
                    dw2[chunk, 2, j] += blue * value
                    d = red * w2[0, j] + green * w2[1, j] + blue * w2[2, j]
                    d_hidden[j] = d if value > 0 else f32(0)
                    d_view[j] += d_hidden[j]
                for k in range(FEATURES):
                    value, d = x[i, k], f32(0)
                    for j in range(WIDTH):
                        dw1[chunk, k, j] += value * d_hidden[j]
                        d += d_hidden[j] * w1[k, j]
                    dx[i, k] = d
            for j in range(WIDTH):
                dbv[chunk, j] += d_view[j]
            for k in range(HARMONICS):
                value = harmonics[ray, k]
                for j in range(WIDTH):
                    dwv[chunk, k, j] += value * d_view[j]
    return dx, dw1, dwv, dbv, dw2, db2
