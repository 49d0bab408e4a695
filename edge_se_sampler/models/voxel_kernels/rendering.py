"""Rays rendered by compiled kernels, a chunk of rays at a time: marched, colored and composited while all that belongs
to a sample is in the processor's cache; and the same backward."""

# pyright: reportCallIssue=false
from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from edge_se_sampler.models.voxel_kernels.buffers import CHUNK, FEATURES, HARMONICS, Buffers
from edge_se_sampler.models.voxel_kernels.marching import Cells, Rays, march_chunk
from edge_se_sampler.models.voxel_kernels.rows import interpolate, sum_row_gradients
from edge_se_sampler.models.voxel_kernels.shading import (
    Network,
    add_outer_products,
    add_sums,
    differentiate_features,
    find_colors,
    find_hidden,
    shade_backward,
    start_ray,
)
from edge_se_sampler.models.voxel_kernels.simd import CONTRACT
from edge_se_sampler.models.voxel_ops import Marching, NetworkWeights, RaySpans, Rendered
from edge_se_sampler.occupancy.bricks import BrickGrid

NUM_SUMS = 32
"""Sums of the network's gradients that are kept apart: so many threads can work at them, and any number of threads
comes to the same."""
SAMPLES_PER_RAY = 16
"""Of a chunk, which there is room for at first."""
f32 = np.float32
_spare: list[Buffers] = []
"""Those of the last training step: new memory costs more than what is done in it."""


def render(
    grid: BrickGrid, density: Tensor, features: Tensor, network: NetworkWeights,
    spans: RaySpans, jitter: Tensor | None, marching: Marching,
) -> Rendered:  # fmt: skip
    """As `voxel_ops.render`."""
    settings = grid, spans, jitter, marching, torch.is_grad_enabled()
    return Rendered(*_Render.apply(*settings, density, features, *vars(network).values()))


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, grid: BrickGrid, spans: RaySpans, jitter: Tensor | None, marching: Marching, keep: bool,
        density: Tensor, features: Tensor, *weights: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        rays, cells = Rays.of(spans, jitter), Cells.of(grid, density, marching)
        network = Network.of(NetworkWeights(*weights))
        chunks = -(-len(rays.begin) // CHUNK)
        slots = chunks if keep else min(chunks, 4 * numba.get_num_threads())
        samples = CHUNK * SAMPLES_PER_RAY
        while True:
            buffers = _take(slots, samples, len(network.hidden_bias))
            outputs = [np.empty((len(rays.begin), size), np.float32) for size in (3, 1, 1)]
            found = _render(rays, cells, features.detach().numpy().reshape(-1), network, buffers, *outputs)
            if found < buffers.t.shape[1]:  # beside those found, one that is looked at
                break
            samples = int(1.25 * found)
        seen = _collect_seen(buffers) if keep else (np.empty(0, np.int64), np.empty(0, np.float32))
        ctx.arrays, ctx.num_rows = (outputs[1], network, buffers), len(density)
        ctx.visible_min = f32(marching.visible_min)
        if not keep:
            _spare.append(buffers)
        tensors = tuple(map(torch.from_numpy, (*outputs, *seen)))
        ctx.mark_non_differentiable(*tensors[2:])
        return tensors

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        accumulation, network, buffers = ctx.arrays
        d_rgb, d_accumulation = (gradient.contiguous().numpy() for gradient in gradients[:2])
        of_network = network.zeros(min(len(buffers.ends), NUM_SUMS))
        width = len(network.hidden_bias)
        transposed = network.hidden.reshape(FEATURES, width).T.ravel()
        of_rays = d_rgb, d_accumulation, accumulation
        _render_backward(*of_rays, ctx.visible_min, network, transposed, buffers, of_network)
        of_rows = sum_row_gradients(buffers, ctx.num_rows)
        del ctx.arrays  # the buffers hold gradients now: there is no second backward pass
        _spare.append(buffers)
        shapes = (FEATURES, width), (HARMONICS, width), (width,), (3, width), (3,)
        of_weights = (torch.from_numpy(value.sum(0)).reshape(s) for value, s in zip(of_network, shapes, strict=True))
        return None, None, None, None, None, *of_rows, *of_weights


def _take(slots: int, samples: int, width: int) -> Buffers:
    """Buffers with that many slots, room for at least so many samples, and so many neurons."""
    while _spare:
        buffers = _spare.pop()
        if buffers.of_ray.shape == (slots, width * CHUNK) and buffers.t.shape[1] >= samples:
            return buffers
    return Buffers.allocate(slots, samples, width)


@njit(parallel=True, cache=True, error_model="numpy")
def _render(rays, cells, features, network, buffers, rgb, accumulation, distance):
    """Render all rays; each slot takes every so manieth chunk. Returns the most samples that a chunk has: if there is
    no room for them, nothing else is of use."""
    slots, num_rays = len(buffers.ends), len(rays.begin)
    most = np.zeros(slots, np.int64)
    for slot in prange(slots):
        for first in range(slot * CHUNK, num_rays, slots * CHUNK):
            last = min(first + CHUNK, num_rays)
            most[slot] = max(most[slot], march_chunk(rays, first, last, cells, buffers, slot))
            if most[slot] < buffers.t.shape[1]:
                _shade_chunk(rays, first, features, network, buffers, slot)
                _composite_chunk(first, last, buffers, slot, rgb, accumulation, distance)
    return most.max() if slots else 0


@njit(cache=True, error_model="numpy")
def _shade_chunk(rays, first, features, network, buffers, slot):
    """Colors of the samples that have one: first all features, so that the processor waits for many at once."""
    view, harmonics, hidden = buffers.of_ray[slot], buffers.harmonics[slot], buffers.hidden[slot]
    rows, weights, color_index = buffers.rows[slot], buffers.weights[slot], buffers.color_index[slot]
    ends, color, of_samples = buffers.ends[slot], buffers.color[slot], buffers.features[slot]
    width = len(network.hidden_bias)
    for k in range(ends[-1]):
        if color_index[k] >= 0:
            interpolate(features, rows, weights, 8 * k, of_samples, FEATURES * color_index[k])
    start = 0
    for ray in range(CHUNK):
        end, seen = ends[ray], False
        for k in range(start, end):
            index = color_index[k]
            if index < 0:
                continue
            if not seen:
                i, seen = first + ray, True
                x, y, z = rays.directions[i, 0], rays.directions[i, 1], rays.directions[i, 2]
                start_ray(x, y, z, network, harmonics, view, ray)
            find_hidden(of_samples, network.hidden, width, view, ray, hidden, index)
        start = end
    find_colors(hidden, buffers.num_colored[slot], network.color, network.color_bias, color)


@njit(cache=True, error_model="numpy", fastmath=CONTRACT)
def _composite_chunk(first, last, buffers, slot, rgb, accumulation, distance):
    start = 0
    for i in range(first, last):
        red, green, blue, far, transmittance = f32(0), f32(0), f32(0), f32(0), f32(1)
        for k in range(start, buffers.ends[slot, i - first]):
            index = buffers.color_index[slot, k]
            transmittance = buffers.transmittance[slot, k] * math.exp(-buffers.tau[slot, k])
            weight = buffers.transmittance[slot, k] - transmittance
            far += weight * buffers.t[slot, k]
            if index >= 0:
                red += weight * buffers.color[slot, 3 * index]
                green += weight * buffers.color[slot, 3 * index + 1]
                blue += weight * buffers.color[slot, 3 * index + 2]
                buffers.color_weight[slot, index] = weight
                buffers.color_cell[slot, index] = buffers.rows[slot, 8 * k]
        start = buffers.ends[slot, i - first]
        rgb[i, 0], rgb[i, 1], rgb[i, 2] = red, green, blue
        accumulation[i, 0], distance[i, 0] = f32(1) - transmittance, far


@njit(cache=True)
def _collect_seen(buffers):
    """Cells of all colored samples, and their weights."""
    rows, weights = np.empty(buffers.num_colored.sum(), np.int64), np.empty(buffers.num_colored.sum(), np.float32)
    end = 0
    for slot in range(len(buffers.ends)):
        begin, count = end, buffers.num_colored[slot]
        end += count
        rows[begin:end], weights[begin:end] = buffers.color_cell[slot, :count], buffers.color_weight[slot, :count]
    return rows, weights


@njit(parallel=True, cache=True, error_model="numpy")
def _render_backward(d_rgb, d_accumulation, accumulation, visible_min, network, transposed, buffers, gradient):
    """Gradients of the network, in several sums, and, in the buffers, of raw densities and features of samples."""
    num_sums = len(gradient.color_bias)
    for number in prange(num_sums):
        for slot in range(number, len(buffers.ends), num_sums):
            # functions of their own: numba would drop what is written to a tuple's arrays in a parallel loop
            _composite_chunk_backward(slot, d_rgb, d_accumulation, accumulation, visible_min, buffers)
            _shade_chunk_backward(slot, number, network, transposed, buffers, gradient)


@njit(cache=True, error_model="numpy", fastmath=CONTRACT)
def _composite_chunk_backward(slot, d_rgb, d_accumulation, accumulation, visible_min, buffers):
    start, first = 0, slot * CHUNK
    for i in range(first, min(first + CHUNK, len(d_rgb))):
        end = buffers.ends[slot, i - first]
        # what the light that passes a sample adds to the loss
        behind = -(f32(1) - accumulation[i, 0]) * d_accumulation[i, 0]
        for k in range(end - 1, start - 1, -1):
            tau, before, index = buffers.tau[slot, k], buffers.transmittance[slot, k], buffers.color_index[slot, k]
            after = before * math.exp(-tau)
            d_sample = f32(0)
            if index >= 0:
                for channel in range(3):
                    color, d = buffers.color[slot, 3 * index + channel], d_rgb[i, channel]
                    d_sample += d * color
                    buffers.color[slot, 3 * index + channel] = (before - after) * d * color * (f32(1) - color)
            buffers.tau[slot, k] = (after * d_sample - behind) * tau if before >= visible_min else f32(0)
            behind += (before - after) * d_sample
        start = end


@njit(cache=True, error_model="numpy")
def _shade_chunk_backward(slot, number, network, transposed, buffers, gradient):
    start, color = 0, buffers.color[slot]
    features, harmonics = buffers.features[slot], buffers.harmonics[slot]
    hidden, view, width = buffers.hidden[slot], buffers.of_ray[slot], len(network.hidden_bias)
    rays = 0  # those with a color, without gaps
    for ray in range(CHUNK):
        seen = False
        for k in range(start, buffers.ends[slot, ray]):
            index = buffers.color_index[slot, k]
            if index < 0:
                continue
            if not seen:
                seen = True
                view[width * rays : width * rays + width] = f32(0)
                for h in range(HARMONICS):
                    harmonics[HARMONICS * rays + h] = harmonics[HARMONICS * ray + h]
            red, green, blue = color[3 * index], color[3 * index + 1], color[3 * index + 2]
            gradient.color_bias[number, 0] += red
            gradient.color_bias[number, 1] += green
            gradient.color_bias[number, 2] += blue
            shade_backward(red, green, blue, hidden, view, rays, index, width, network.color, gradient.color[number])
        rays += seen
        start = buffers.ends[slot, ray]
    count = buffers.num_colored[slot]
    add_outer_products(features, hidden, count, gradient.hidden[number])
    add_outer_products(harmonics, view, rays, gradient.harmonics[number])
    add_sums(view, rays, gradient.hidden_bias[number])
    differentiate_features(hidden, transposed, count, features)
