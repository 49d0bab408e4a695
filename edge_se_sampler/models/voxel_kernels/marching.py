"""Marching compiled: a ray is followed cell by cell, skips bricks that hold nothing, and ends where no light passes."""

# pyright: reportCallIssue=false
from __future__ import annotations

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from edge_se_sampler.models.voxel_ops import Marching, RaySpans, Samples
from edge_se_sampler.occupancy.bricks import CORNERS, BrickGrid

CHUNK = 64
"""Rays that are marched together."""
SAMPLES_PER_RAY = 64
"""Of a chunk, which there is room for at first."""
NEIGHBOR, CORNER = (np.ascontiguousarray(CORNERS[:, :, i].numpy().astype(np.int32)) for i in range(2))
f32 = np.float32


def march(grid: BrickGrid, density: Tensor, spans: RaySpans, jitter: Tensor | None, marching: Marching) -> Samples:
    """As `voxel_ops.march`."""
    jitter = torch.full_like(spans.begin, 0.5) if jitter is None else jitter
    rays = [value.numpy() for value in (spans.origins, spans.directions, spans.begin, spans.end, jitter)]
    cells = [value.numpy() for value in (grid.table, grid.neighbors, grid.sampled)]
    numbers = tuple(map(f32, vars(marching).values()))
    capacity = CHUNK * SAMPLES_PER_RAY
    while True:
        counts, *found = _march(*rays, *cells, density.detach().numpy()[:, 0], numbers, capacity)
        if counts[:, 0].max(initial=0) < capacity:
            return Samples(*(torch.from_numpy(values) for values in _pack(counts, *found)))
        capacity = int(counts[:, 0].max()) + 1  # beside those found, one that is looked at


@njit(parallel=True, cache=True, error_model="numpy")
def _march(origins, directions, begin, end, jitter, table, neighbors, sampled, density, marching, capacity):
    """Samples of chunks of rays, less than `capacity` of each, and how many there would be, with how many colored."""
    num_rays = len(begin)
    chunks = (num_rays + CHUNK - 1) // CHUNK
    counts = np.zeros((chunks, 2), np.int64)
    t = np.empty((chunks, capacity), np.float32)
    ray = np.empty((chunks, capacity), np.int64)
    rows = np.empty((chunks, capacity, 8), np.int32)
    weights = np.empty((chunks, capacity, 8), np.float32)
    colored = np.empty((chunks, capacity), np.int64)
    for chunk in prange(chunks):
        m, c = 0, 0
        for i in range(chunk * CHUNK, min(chunk * CHUNK + CHUNK, num_rays)):
            m, c = _march_ray(
                i, origins, directions, begin[i], end[i], jitter[i], table, neighbors, sampled, density, marching,
                chunk, m, c, t, ray, rows, weights, colored,
            )  # fmt: skip
        counts[chunk, 0], counts[chunk, 1] = m, c
    return counts, t, ray, rows, weights, colored


@njit(cache=True, error_model="numpy")
def _march_ray(
    i, origins, directions, begin, end, jitter, table, neighbors, sampled, density, marching,
    chunk, m, c, t, ray, rows, weights, colored,
):  # fmt: skip
    step, scale, alpha_min, weight_min, transmittance_min = marching
    ox, oy, oz = origins[i, 0], origins[i, 1], origins[i, 2]
    dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
    last, last_c = t.shape[1] - 1, colored.shape[1] - 1
    inverse_x, inverse_y, inverse_z = _invert(dx), _invert(dy), _invert(dz)
    steps_per_cell = f32(1) / step
    passing, j = f32(1), 0
    while True:
        s = begin + (f32(j) + jitter) * step
        if not s < end:
            break
        x, y, z = ox + s * dx, oy + s * dy, oz + s * dz
        ix, iy, iz = int(x), int(y), int(z)
        j += 1
        brick = table[ix >> 2, iy >> 2, iz >> 2]
        if brick < 0:
            leave = min(
                _leave(ix >> 2, -brick, ox, inverse_x),
                _leave(iy >> 2, -brick, oy, inverse_y),
                _leave(iz >> 2, -brick, oz, inverse_z),
            )
            # rounded down, and one less: rounding must not skip a cell
            j = max(j, int((leave - begin) * steps_per_cell - jitter))
            continue
        cell = ((ix & 3) << 4) | ((iy & 3) << 2) | (iz & 3)
        if not (sampled[brick] >> cell) & 1:
            continue
        k = min(m, last)  # beyond the capacity, samples are only counted
        raw = _interpolate_density(
            x - f32(ix), y - f32(iy), z - f32(iz), brick, cell, neighbors, density, chunk, k, rows, weights
        )
        transparency = math.exp(-(math.exp(raw) * scale))
        alpha = f32(1) - transparency
        if alpha > alpha_min:
            t[chunk, k], ray[chunk, k] = s, i
            if passing * alpha > weight_min:
                colored[chunk, min(c, last_c)] = m
                c += 1
            m += 1
            passing *= transparency
            if passing < transmittance_min:
                break
    return m, c


@njit(cache=True, inline="always")
def _invert(direction):
    return f32(1) / direction if abs(direction) > f32(1e-6) else f32(1e6)


@njit(cache=True, inline="always")
def _leave(brick, distance, origin, inverse):
    """Where a ray leaves the bricks less than `distance` away from one, along one axis."""
    plane = brick + distance if inverse > 0 else brick - distance + 1
    return (f32(plane * 4) - origin) * inverse


@njit(cache=True, inline="always")
def _interpolate_density(x, y, z, brick, cell, neighbors, density, chunk, k, rows, weights):
    u, v, w = f32(1) - x, f32(1) - y, f32(1) - z
    uv, uy, xv, xy = u * v, u * y, x * v, x * y
    weights[chunk, k, 0], weights[chunk, k, 1], weights[chunk, k, 2] = uv * w, uv * z, uy * w
    weights[chunk, k, 3], weights[chunk, k, 4], weights[chunk, k, 5] = uy * z, xv * w, xv * z
    weights[chunk, k, 6], weights[chunk, k, 7] = xy * w, xy * z
    raw = f32(0)
    for c in range(8):
        row = neighbors[brick, NEIGHBOR[cell, c]] * 64 + CORNER[cell, c]
        rows[chunk, k, c] = row
        raw += weights[chunk, k, c] * density[row]
    return raw


@njit(parallel=True, cache=True, error_model="numpy")
def _pack(counts, t, ray, rows, weights, colored):
    """Chunks of samples, one after the other."""
    ends = np.zeros((len(counts) + 1, 2), np.int64)
    for chunk in range(len(counts)):
        ends[chunk + 1] = ends[chunk] + counts[chunk]
    m, c = ends[-1, 0], ends[-1, 1]
    packed_t, packed_ray, packed_colored = np.empty(m, np.float32), np.empty(m, np.int64), np.empty(c, np.int64)
    packed_rows, packed_weights = np.empty((m, 8), np.int32), np.empty((m, 8), np.float32)
    for chunk in prange(len(counts)):
        first, end, count = ends[chunk, 0], ends[chunk + 1, 0], counts[chunk, 0]
        packed_t[first:end], packed_ray[first:end] = t[chunk, :count], ray[chunk, :count]
        packed_rows[first:end], packed_weights[first:end] = rows[chunk, :count], weights[chunk, :count]
        packed_colored[ends[chunk, 1] : ends[chunk + 1, 1]] = colored[chunk, : counts[chunk, 1]] + first
    return packed_t, packed_ray, packed_rows, packed_weights, packed_colored


def find_dense_cells(grid: BrickGrid, density: Tensor, least: float) -> Tensor:
    """As `voxel_ops.find_dense_cells`."""
    arrays = grid.occupied.numpy(), grid.neighbors.numpy(), density.detach().numpy()[:, 0]
    return torch.from_numpy(_find_dense_cells(*arrays, f32(least)))


@njit(parallel=True, cache=True, error_model="numpy")
def _find_dense_cells(occupied, neighbors, density, least):
    dense = np.zeros(len(occupied), np.int64)
    for brick in prange(len(occupied)):
        for cell in range(64):
            if not occupied[brick, cell]:
                continue
            for c in range(8):
                if density[neighbors[brick, NEIGHBOR[cell, c]] * 64 + CORNER[cell, c]] > least:
                    dense[brick] |= np.int64(1) << cell
                    break
    return dense
