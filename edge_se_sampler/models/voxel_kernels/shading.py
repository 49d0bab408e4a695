"""The color network compiled: sample by sample, so that its layers stay in the processor's registers and cache.

width  neurons of the hidden layer, a multiple of 64: four registers of sixteen are worked at together
"""

# pyright: reportCallIssue=false
from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from edge_se_sampler.models.voxel_kernels.buffers import FEATURES, HARMONICS
from edge_se_sampler.models.voxel_kernels.simd import LANES, load, sigmoid, splat, store, total, where_positive
from edge_se_sampler.models.voxel_ops import NetworkWeights

f32 = np.float32


class Network(NamedTuple):
    """`NetworkWeights` or their gradients, flat; a gradient may have a row for each of several sums."""

    hidden: np.ndarray
    harmonics: np.ndarray
    hidden_bias: np.ndarray
    color: np.ndarray
    color_bias: np.ndarray

    @classmethod
    def of(cls, weights: NetworkWeights) -> Network:
        return cls(*(value.detach().contiguous().numpy().reshape(-1) for value in vars(weights).values()))

    def zeros(self, count: int) -> Network:
        """That many gradients, 0."""
        return Network(*(np.zeros((count, value.size), np.float32) for value in self))


@njit(cache=True, error_model="numpy")
def start_ray(x, y, z, network, harmonics, view, ray):
    """Harmonics of a ray's direction, and the part of the hidden layer that comes from them."""
    spherical_harmonics(x, y, z, harmonics, HARMONICS * ray)
    width = len(network.hidden_bias)
    for j in range(0, width, LANES):
        hidden = load(network.hidden_bias, j)
        for k in range(HARMONICS):
            hidden += splat(harmonics[HARMONICS * ray + k]) * load(network.harmonics, width * k + j)
        store(view, width * ray + j, hidden)


@njit(cache=True, inline="always", error_model="numpy")
def spherical_harmonics(x, y, z, out, i):
    xx, yy, zz = x * x, y * y, z * z
    out[i] = f32(0.28209479)
    out[i + 1] = f32(-0.48860251) * y
    out[i + 2] = f32(0.48860251) * z
    out[i + 3] = f32(-0.48860251) * x
    out[i + 4] = f32(1.09254843) * x * y
    out[i + 5] = f32(-1.09254843) * y * z
    out[i + 6] = f32(0.31539157) * (f32(2) * zz - xx - yy)
    out[i + 7] = f32(-1.09254843) * x * z
    out[i + 8] = f32(0.54627421) * (xx - yy)
    out[i + 9] = f32(-0.59004359) * y * (f32(3) * xx - yy)
    out[i + 10] = f32(2.89061144) * x * y * z
    out[i + 11] = f32(-0.45704579) * y * (f32(4) * zz - xx - yy)
    out[i + 12] = f32(0.37317633) * z * (f32(2) * zz - f32(3) * xx - f32(3) * yy)
    out[i + 13] = f32(-0.45704579) * x * (f32(4) * zz - xx - yy)
    out[i + 14] = f32(1.44530572) * z * (xx - yy)
    out[i + 15] = f32(-0.59004359) * x * (xx - f32(3) * yy)


@njit(cache=True, error_model="numpy")
def find_hidden(features, weights, width, view, ray, hidden, i):
    """The hidden layer of a sample, of its features and its ray's direction."""
    for j in range(0, width, 4 * LANES):
        v, h = width * ray + j, width * i + j
        h0, h1, h2, h3 = load(view, v), load(view, v + 16), load(view, v + 32), load(view, v + 48)
        for k in range(FEATURES):
            x, w = splat(features[FEATURES * i + k]), width * k + j
            h0 += x * load(weights, w)
            h1 += x * load(weights, w + 16)
            h2 += x * load(weights, w + 32)
            h3 += x * load(weights, w + 48)
        store(hidden, h, where_positive(h0, h0))
        store(hidden, h + 16, where_positive(h1, h1))
        store(hidden, h + 32, where_positive(h2, h2))
        store(hidden, h + 48, where_positive(h3, h3))


@njit(cache=True, error_model="numpy")
def find_colors(hidden, count, weights, bias, color):
    """The colors of `count` samples, of their hidden layers; up to fifteen numbers after them are written to."""
    width = len(weights) // 3
    for i in range(count):
        red = green = blue = splat(f32(0))
        for j in range(0, width, LANES):
            h = load(hidden, width * i + j)
            red += h * load(weights, j)
            green += h * load(weights, width + j)
            blue += h * load(weights, 2 * width + j)
        color[3 * i] = total(red) + bias[0]
        color[3 * i + 1] = total(green) + bias[1]
        color[3 * i + 2] = total(blue) + bias[2]
    for j in range(0, 3 * count, LANES):
        store(color, j, sigmoid(load(color, j)))


@njit(cache=True, error_model="numpy")
def shade_backward(red, green, blue, hidden, view, ray, i, width, w2, dw2):
    """By the gradient of a sample's color before the sigmoid: its hidden layer becomes its gradient; that of the ray's
    view part, and that of the last layer's weights, grow."""
    first = width * i
    r, g, b = splat(red), splat(green), splat(blue)
    for j in range(0, width, LANES):
        h = load(hidden, first + j)
        store(dw2, j, load(dw2, j) + r * h)
        store(dw2, width + j, load(dw2, width + j) + g * h)
        store(dw2, 2 * width + j, load(dw2, 2 * width + j) + b * h)
        d = where_positive(h, r * load(w2, j) + g * load(w2, width + j) + b * load(w2, 2 * width + j))
        store(hidden, first + j, d)
        store(view, width * ray + j, load(view, width * ray + j) + d)


@njit(cache=True, error_model="numpy")
def differentiate_features(hidden, transposed, count, features):
    """Gradients of the features of `count` samples, by those of their hidden layers."""
    width = len(transposed) // FEATURES
    for i in range(count):
        x0 = x1 = x2 = x3 = splat(f32(0))
        for j in range(0, width, 4):
            h, row = width * i + j, FEATURES * j
            x0 += splat(hidden[h]) * load(transposed, row)
            x1 += splat(hidden[h + 1]) * load(transposed, row + FEATURES)
            x2 += splat(hidden[h + 2]) * load(transposed, row + 2 * FEATURES)
            x3 += splat(hidden[h + 3]) * load(transposed, row + 3 * FEATURES)
        store(features, FEATURES * i, (x0 + x1) + (x2 + x3))


@njit(cache=True, error_model="numpy")
def add_outer_products(inputs, outputs, count, gradient):
    """Add, to the gradient of a layer of 16 x width weights, the products of `count` inputs (16,) and gradients of its
    outputs (width,)."""
    width = len(gradient) // 16
    for k in range(0, 16, 2):
        for j in range(0, width, 32):
            at, below = width * k + j, width * k + j + width
            a0, a1 = load(gradient, at), load(gradient, at + 16)
            b0, b1 = load(gradient, below), load(gradient, below + 16)
            for i in range(count):
                a, b = splat(inputs[16 * i + k]), splat(inputs[16 * i + k + 1])
                d0, d1 = load(outputs, width * i + j), load(outputs, width * i + j + 16)
                a0 += a * d0
                a1 += a * d1
                b0 += b * d0
                b1 += b * d1
            store(gradient, at, a0)
            store(gradient, at + 16, a1)
            store(gradient, below, b0)
            store(gradient, below + 16, b1)


@njit(cache=True, error_model="numpy")
def add_sums(outputs, count, gradient):
    """Add the sum of `count` gradients of a layer's outputs (width,) to the gradient of its bias."""
    width = len(gradient)
    for j in range(0, width, LANES):
        sums = load(gradient, j)
        for i in range(count):
            sums += load(outputs, width * i + j)
        store(gradient, j, sums)
