"""Values at corners compiled: their interpolation, its gradient, steps of Adam, finer corners. Only rows that a step
touches are written to."""

# pyright: reportCallIssue=false
from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

f32 = np.float32


def interpolate(values: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """As `voxel_ops.interpolate`."""
    return _Interpolate.apply(values, rows, weights)


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(rows, weights)
        ctx.shape = values.shape
        return torch.from_numpy(_gather(values.detach().numpy(), rows.numpy(), weights.numpy()))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        rows, weights = (value.numpy() for value in ctx.saved_tensors)
        threads = numba.get_num_threads()
        touched, firsts = _number_rows(rows, ctx.shape[0] // 64, threads)
        indices, sums = _scatter(rows, weights, gradients[0].numpy(), touched, firsts, 1 << (threads - 1).bit_length())
        sparse = torch.sparse_coo_tensor(
            torch.from_numpy(indices)[None],
            torch.from_numpy(sums),
            ctx.shape,
            check_invariants=False,
            is_coalesced=True,
        )
        return sparse, None, None


@njit(parallel=True, cache=True, error_model="numpy")
def _gather(values, rows, weights):
    out = np.zeros((len(rows), values.shape[1]), np.float32)
    for i in prange(len(rows)):
        for c in range(8):
            row, weight = rows[i, c], weights[i, c]
            for k in range(values.shape[1]):
                out[i, k] += weight * values[row, k]
    return out


@njit(parallel=True, cache=True, error_model="numpy")
def _number_rows(rows, num_bricks, threads):
    """Which rows of each brick occur, as bits, and how many do in the bricks before."""
    share = (len(rows) + threads - 1) // threads
    seen = np.zeros((threads, num_bricks), np.int64)
    for thread in prange(threads):
        for i in range(thread * share, min((thread + 1) * share, len(rows))):
            for c in range(8):
                row = rows[i, c]
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
def _scatter(rows, weights, gradient, touched, firsts, parts):
    """Rows that samples touch, ascending, and the sums of their gradients. Each thread goes through all samples, in
    their order, and adds up those of its own bricks: the sums are the same for any number of threads. `parts` is a
    power of two."""
    indices = np.empty(firsts[-1], np.int64)
    sums = np.zeros((firsts[-1], gradient.shape[1]), np.float32)
    for part in prange(parts):
        for i in range(len(rows)):
            for c in range(8):
                row, weight = rows[i, c], weights[i, c]
                brick, bit = row >> 6, np.int64(1) << (row & 63)
                if (brick >> 6) & (parts - 1) == part:
                    slot = firsts[brick] + _count_bits(touched[brick] & (bit - 1))
                    indices[slot] = row
                    for k in range(gradient.shape[1]):
                        sums[slot, k] += weight * gradient[i, k]
    return indices, sums


def adam_rows(
    values: Tensor, mean: Tensor, square: Tensor, gradient: Tensor,
    *, lr: float, betas: tuple[float, float], eps: float, maximum: float, total_variation: float,
) -> None:  # fmt: skip
    """As `voxel_ops.adam_rows`."""
    arrays = [value.detach().numpy() for value in (values, mean, square)]
    rows = gradient._indices()[0]
    if (rows[1:] > rows[:-1]).all():  # of one backward pass, which autograd does not remember
        gradient._coalesced_(True)
    gradient = gradient.coalesce()
    rows, sums = gradient.indices()[0].numpy(), gradient.values().numpy()
    if total_variation:
        _add_total_variation(arrays[0], rows, sums, f32(total_variation))
    _adam_rows(*arrays, rows, sums, *map(f32, (lr, *betas, eps, maximum)))


@njit(parallel=True, cache=True, error_model="numpy")
def _adam_rows(values, mean, square, rows, gradient, lr, beta1, beta2, eps, maximum):
    for i in prange(len(rows)):
        row = rows[i]
        for k in range(values.shape[1]):
            g = gradient[i, k]
            mean[row, k] = g + beta1 * (mean[row, k] - g)
            square[row, k] = g * g + beta2 * (square[row, k] - g * g)
            values[row, k] = min(values[row, k] - lr * mean[row, k] / (math.sqrt(square[row, k]) + eps), maximum)


@njit(parallel=True, cache=True, error_model="numpy")
def _add_total_variation(values, rows, gradient, weight):
    for i in prange(len(rows)):
        row = rows[i]
        for shift in range(0, 6, 2):
            position, stride = (row >> shift) & 3, 1 << shift
            for k in range(values.shape[1]):
                if position < 3:
                    gradient[i, k] += weight * (values[row, k] - values[row + stride, k])
                if position > 0:
                    gradient[i, k] += weight * (values[row, k] - values[row - stride, k])


def resample(bricks: Tensor, parents: Tensor, values: Tensor) -> Tensor:
    """As `voxel_ops.resample`."""
    return torch.from_numpy(_resample(*(value.detach().numpy() for value in (bricks, parents, values))))


@njit(parallel=True, cache=True, error_model="numpy")
def _resample(bricks, parents, values):
    """Values (64 K, F) at corners, of those at the corners of cells twice as large that surround them."""
    fine = np.zeros((64 * len(bricks), values.shape[1]), np.float32)
    for brick in prange(len(bricks)):
        for cell in range(64):
            x = 4 * bricks[brick, 0] + (cell >> 4)
            y = 4 * bricks[brick, 1] + ((cell >> 2) & 3)
            z = 4 * bricks[brick, 2] + (cell & 3)
            found = 0
            row = 64 * brick + cell
            for i in range(x >> 1, (x + 1 >> 1) + 1):
                for j in range(y >> 1, (y + 1 >> 1) + 1):
                    for k in range(z >> 1, (z + 1 >> 1) + 1):
                        parent = parents[i >> 2, j >> 2, k >> 2]
                        if parent >= 0:
                            found += 1
                            coarse = 64 * parent + ((i & 3) << 4 | (j & 3) << 2 | (k & 3))
                            for f in range(values.shape[1]):
                                fine[row, f] += values[coarse, f]
            for f in range(values.shape[1]):
                fine[row, f] /= f32(max(found, 1))
    return fine
