"""Values at corners compiled: sums of their gradients, steps of Adam, finer corners. Only rows that a step touches are
written to."""

# pyright: reportCallIssue=false
from __future__ import annotations

import math

import numba
import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from edge_se_sampler.models import voxel_ops
from edge_se_sampler.models.voxel_kernels.buffers import FEATURES, Buffers
from edge_se_sampler.models.voxel_kernels.simd import load, minimum, prefetch, splat, store, total

AHEAD, CORNERS_AHEAD = 8, 48
"""Rows, and corners of samples, that are fetched into the cache before they are needed."""
f32 = np.float32


@njit(cache=True, error_model="numpy")
def interpolate(values, rows, weights, i, out, j):
    """Features of 16 numbers, out[j:], at the corners rows[i:] with weights[i:]."""
    result = splat(weights[i]) * load(values, FEATURES * np.int64(rows[i]))
    for corner in range(i + 1, i + 8):
        result += splat(weights[corner]) * load(values, FEATURES * np.int64(rows[corner]))
    store(out, j, result)


def sum_row_gradients(buffers: Buffers, num_rows: int) -> tuple[Tensor, Tensor]:
    """Sparse gradients of densities (num_rows, 1) and features, of what the backward pass left in the buffers: all rows
    that samples touch, ascending."""
    threads = numba.get_num_threads()
    touched, firsts = _number_rows(buffers.ends, buffers.rows, num_rows // 64, threads)
    rows, *sums = _scatter(buffers, touched, firsts, threads)
    indices = torch.from_numpy(rows)[None]

    def sparse(values: Tensor) -> Tensor:
        shape = num_rows, values.shape[1]
        return torch.sparse_coo_tensor(indices, values, shape, check_invariants=False, is_coalesced=True)

    density, features = (sparse(torch.from_numpy(values)) for values in sums)
    return density, features


@njit(parallel=True, cache=True, error_model="numpy")
def _number_rows(ends, rows, num_bricks, threads):
    """Which rows of each brick occur, as bits, and how many do in the bricks before."""
    seen = np.zeros((threads, num_bricks), np.int64)
    for thread in prange(threads):
        for slot in range(thread, len(ends), threads):
            for i in range(8 * ends[slot, -1]):
                row = rows[slot, i]
                seen[thread, row >> 6] |= np.int64(1) << (row & 63)
    firsts = np.zeros(num_bricks + 1, np.int64)
    for brick in range(num_bricks):
        for thread in range(1, threads):
            seen[0, brick] |= seen[thread, brick]
        firsts[brick + 1] = firsts[brick] + _count_bits(seen[0, brick])
    return seen[0], firsts


@njit(cache=True, inline="always")
def _count_bits(bits):
    """How many bits of 64 are set: sums of ever more of them, which compilers replace by one instruction."""
    x = np.uint64(bits)
    x -= (x >> np.uint64(1)) & np.uint64(0x5555555555555555)
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(parallel=True, cache=True, error_model="numpy")
def _scatter(buffers, touched, firsts, threads):
    """Rows that samples touch, ascending, and the sums of their gradients; in the buffers, rows become their places in
    these. Each thread goes through all samples, in their order, and adds up what belongs to its share of the rows: the
    sums are the same for any number of threads."""
    count = firsts[-1]
    indices = np.empty(count, np.int64)
    density, features = np.empty((count, 1), np.float32), np.empty(count * FEATURES, np.float32)
    for slot in prange(len(buffers.ends)):
        _find_places(buffers.rows[slot], 8 * buffers.ends[slot, -1], touched, firsts, indices)
    for thread in prange(threads):
        first, last = thread * count // threads, (thread + 1) * count // threads
        density[first:last] = f32(0)
        features[FEATURES * first : FEATURES * last] = f32(0)
        for slot in range(len(buffers.ends)):
            _scatter_chunk(buffers, slot, first, last, density, features)
    return indices, density, features.reshape(-1, FEATURES)


@njit(cache=True, error_model="numpy")
def _find_places(rows, count, touched, firsts, indices):
    for c in range(count):
        row = rows[c]
        brick, bit = row >> 6, np.int64(1) << (row & 63)
        rows[c] = firsts[brick] + _count_bits(touched[brick] & (bit - 1))
        indices[rows[c]] = row  # several threads may write it, all the same


@njit(cache=True, error_model="numpy")
def _scatter_chunk(buffers, slot, first, last, density, features):
    gradients, places, weights = buffers.features[slot], buffers.rows[slot], buffers.weights[slot]
    end = 8 * buffers.ends[slot, -1]
    for i in range(buffers.ends[slot, -1]):
        index = buffers.color_index[slot, i]
        gradient = load(gradients, FEATURES * max(index, 0))
        for c in range(8 * i, 8 * i + 8):
            later, place = np.int64(places[min(c + CORNERS_AHEAD, end - 1)]), np.int64(places[c])
            if first <= later < last:
                prefetch(features, FEATURES * later)
            if first <= place < last:
                density[place, 0] += weights[c] * buffers.tau[slot, i]
                if index >= 0:
                    at = FEATURES * place
                    store(features, at, load(features, at) + splat(weights[c]) * gradient)


def adam_rows(
    values: Tensor, mean: Tensor, square: Tensor, gradient: Tensor,
    *, lr: float, betas: tuple[float, float], eps: float, maximum: float, total_variation: float,
) -> None:  # fmt: skip
    """As `voxel_ops.adam_rows`, which steps rows of other widths than lean-nerf's."""
    if values.shape[1] != FEATURES and (values.shape[1] != 1 or total_variation):
        options = {"lr": lr, "betas": betas, "eps": eps, "maximum": maximum, "total_variation": total_variation}
        voxel_ops.adam_rows(values, mean, square, gradient, **options)
        return
    arrays = [value.detach().numpy() for value in (values, mean, square)]
    rows = gradient._indices()[0]
    if _ascend(rows.numpy()):  # of one backward pass, which autograd does not remember
        gradient._coalesced_(True)
    gradient = gradient.coalesce()
    rows, sums = gradient.indices()[0].numpy(), gradient.values().numpy()
    numbers = map(f32, (lr, *betas, eps, maximum))
    if values.shape[1] == 1:
        _adam_density(*(array.reshape(-1) for array in (*arrays, rows, sums)), *numbers)
        return
    flat = [array.reshape(-1) for array in arrays]
    if total_variation:
        _add_total_variation(flat[0], rows, sums.reshape(-1), f32(total_variation))
    _adam_features(*flat, rows, sums.reshape(-1), *numbers)


@njit(cache=True)
def _ascend(rows):
    """Whether each row is greater than the one before."""
    ascend = True
    for i in range(1, len(rows)):
        ascend &= rows[i] > rows[i - 1]
    return ascend


@njit(parallel=True, cache=True, error_model="numpy")
def _adam_density(values, mean, square, rows, gradient, lr, beta1, beta2, eps, maximum):
    for i in prange(len(rows)):
        row, g = rows[i], gradient[i]
        mean[row] = g + beta1 * (mean[row] - g)
        square[row] = g * g + beta2 * (square[row] - g * g)
        values[row] = min(values[row] - lr * mean[row] / (math.sqrt(square[row]) + eps), maximum)


@njit(parallel=True, cache=True, error_model="numpy")
def _adam_features(values, mean, square, rows, gradient, lr, beta1, beta2, eps, maximum):
    beta1, maximum, last = splat(beta1), splat(maximum), len(rows) - 1
    for i in prange(len(rows)):
        later = FEATURES * rows[min(i + AHEAD, last)]
        prefetch(values, later)
        prefetch(mean, later)
        row, g = FEATURES * rows[i], load(gradient, FEATURES * i)
        m = g + beta1 * (load(mean, row) - g)
        s = total(g * g) * f32(1 / FEATURES)
        s = s + beta2 * (square[rows[i]] - s)
        store(mean, row, m)
        square[rows[i]] = s
        store(values, row, minimum(load(values, row) - splat(lr / (math.sqrt(s) + eps)) * m, maximum))


@njit(parallel=True, cache=True, error_model="numpy")
def _add_total_variation(values, rows, gradient, weight):
    weight = splat(weight)
    for i in prange(len(rows)):
        row, value = rows[i], load(values, FEATURES * rows[i])
        differences = splat(f32(0))
        for shift in range(0, 6, 2):
            position, stride = (row >> shift) & 3, 1 << shift
            if position < 3:
                differences += value - load(values, FEATURES * (row + stride))
            if position > 0:
                differences += value - load(values, FEATURES * (row - stride))
        store(gradient, FEATURES * i, load(gradient, FEATURES * i) + weight * differences)


def resample(bricks: Tensor, ratio: float, parents: Tensor, values: Tensor) -> Tensor:
    """As `voxel_ops.resample`."""
    fine = torch.zeros((64 * len(bricks), values.shape[1]))
    _resample(bricks.numpy(), ratio, parents.numpy(), values.detach().numpy(), fine.numpy())
    return fine


@njit(parallel=True, cache=True, error_model="numpy")
def _resample(bricks, ratio, parents, values, fine):
    for brick in prange(len(bricks)):
        for cell in range(64):
            x = (4 * bricks[brick, 0] + (cell >> 4)) * ratio
            y = (4 * bricks[brick, 1] + ((cell >> 2) & 3)) * ratio
            z = (4 * bricks[brick, 2] + (cell & 3)) * ratio
            row, total_share = 64 * brick + cell, f32(0)
            for corner in range(8):
                dx, dy, dz = corner >> 2, (corner >> 1) & 1, corner & 1
                share = _share(x, dx) * _share(y, dy) * _share(z, dz)
                i, j, k = int(x) + dx, int(y) + dy, int(z) + dz
                parent = parents[i >> 2, j >> 2, k >> 2]
                if parent >= 0:
                    total_share += share
                    coarse = 64 * parent + ((i & 3) << 4 | (j & 3) << 2 | (k & 3))
                    for f in range(values.shape[1]):
                        fine[row, f] += share * values[coarse, f]
            for f in range(values.shape[1]):
                fine[row, f] /= max(total_share, f32(1e-6))


@njit(cache=True, inline="always")
def _share(position, upper):
    """Share of the lower or the upper of the two whole numbers around a position."""
    fraction = position - int(position)
    return f32(fraction if upper else 1 - fraction)
