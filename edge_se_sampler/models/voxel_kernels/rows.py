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
        rows, weights = ctx.saved_tensors
        parts = 1 << (numba.get_num_threads() - 1).bit_length()
        touched, sums = _scatter(rows.numpy(), weights.numpy(), gradients[0].numpy(), _slots(ctx.shape[0]), parts)
        indices, values = torch.from_numpy(touched)[None], torch.from_numpy(sums)
        return (
            torch.sparse_coo_tensor(indices, values, ctx.shape, check_invariants=False),
            None,
            None,
        )


_WORKSPACE: dict[int, np.ndarray] = {}


def _slots(num_rows: int) -> np.ndarray:
    """(num_rows,) int32, all -1, to number rows in; kept, since filling it takes longer than using it."""
    if num_rows not in _WORKSPACE:
        _WORKSPACE.clear()
        _WORKSPACE[num_rows] = np.full(num_rows, -1, np.int32)
    return _WORKSPACE[num_rows]


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
def _scatter(rows, weights, gradient, slots, parts):
    """Rows that samples touch, and the sums of their gradients. Each thread goes through all samples, in their order,
    and adds up those of its own rows: the sums are the same for any number of threads. `parts` is a power of two."""
    m = len(rows)
    counts = np.zeros(parts + 1, np.int64)
    touched = np.empty((parts, min(8 * m, len(slots))), np.int64)
    numbers = np.empty((m, 8), np.int32)  # a row's number in its part; minus that, and one less, where it is new
    for part in prange(parts):
        count = 0
        for i in range(m):
            for c in range(8):
                row = rows[i, c]
                if (row >> 12) & (parts - 1) == part:
                    numbers[i, c] = slots[row]
                    if slots[row] < 0:
                        slots[row], numbers[i, c], touched[part, count] = count, -1 - count, row
                        count += 1
        for i in range(count):
            slots[touched[part, i]] = -1
        counts[part + 1] = count
    firsts = np.cumsum(counts)
    packed, sums = np.empty(firsts[-1], np.int64), np.empty((firsts[-1], gradient.shape[1]), np.float32)
    for part in prange(parts):
        for i in range(m):
            for c in range(8):
                row, number, weight = rows[i, c], numbers[i, c], weights[i, c]
                if (row >> 12) & (parts - 1) == part:
                    if number < 0:
                        slot = firsts[part] - 1 - number
                        packed[slot] = row
                        for k in range(gradient.shape[1]):
                            sums[slot, k] = weight * gradient[i, k]
                    else:
                        slot = firsts[part] + number
                        for k in range(gradient.shape[1]):
                            sums[slot, k] += weight * gradient[i, k]
    return packed, sums


def adam_rows(
    values: Tensor, mean: Tensor, square: Tensor, gradient: Tensor,
    *, lr: float, betas: tuple[float, float], eps: float, maximum: float, total_variation: float,
) -> None:  # fmt: skip
    """As `voxel_ops.adam_rows`."""
    arrays = [value.detach().numpy() for value in (values, mean, square)]
    rows, sums = gradient._indices()[0].numpy(), gradient._values().numpy()
    count = _sum_duplicates(rows, sums, _slots(len(arrays[0])))
    rows, sums = rows[:count], sums[:count]
    if total_variation:
        _add_total_variation(arrays[0], rows, sums, f32(total_variation))
    _adam_rows(*arrays, rows, sums, *map(f32, (lr, *betas, eps, maximum)))


@njit(cache=True, error_model="numpy")
def _sum_duplicates(rows, sums, slots):
    """Add up, in place, the values of rows that occur more than once, and return how many rows there are then."""
    count = 0
    for i in range(len(rows)):
        slot = slots[rows[i]]
        if slot < 0:
            slots[rows[i]] = count
            if count < i:
                rows[count], sums[count] = rows[i], sums[i]
            count += 1
        else:
            sums[slot] += sums[i]
    for i in range(count):
        slots[rows[i]] = -1
    return count


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
