"""Marching compiled: a ray is followed cell by cell, skips bricks that hold nothing, and ends where no light passes."""

# pyright: reportCallIssue=false
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from edge_se_sampler.models.voxel_kernels.buffers import Buffers
from edge_se_sampler.models.voxel_ops import Marching, RaySpans
from edge_se_sampler.occupancy.bricks import CORNERS, BrickGrid

NEIGHBOR, CORNER = (np.ascontiguousarray(CORNERS[:, :, i].numpy().astype(np.int32)) for i in range(2))
f32 = np.float32


class Rays(NamedTuple):
    """`RaySpans` with the jitter."""

    origins: np.ndarray
    directions: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    jitter: np.ndarray

    @classmethod
    def of(cls, spans: RaySpans, jitter: Tensor | None) -> Rays:
        jitter = torch.full_like(spans.begin, 0.5) if jitter is None else jitter
        return cls(*(value.contiguous().numpy() for value in (*vars(spans).values(), jitter)))


class Cells(NamedTuple):
    """What marching needs of a `BrickGrid` and its density, and of `Marching`."""

    table: np.ndarray
    neighbors: np.ndarray
    sampled: np.ndarray
    density: np.ndarray
    step: np.float32
    density_scale: np.float32
    density_min: np.float32
    weight_min: np.float32
    transmittance_min: np.float32

    @classmethod
    def of(cls, grid: BrickGrid, density: Tensor, marching: Marching) -> Cells:
        arrays = (value.detach().numpy() for value in (grid.table, grid.neighbors, grid.sampled, density[:, 0]))
        names = ("step", "density_scale", "density_min", "weight_min", "transmittance_min")
        return cls(*arrays, *(f32(getattr(marching, name)) for name in names))


@njit(cache=True, error_model="numpy")
def march_ray(rays, i, cells, buffers, slot, m, c):
    """Enter the samples of ray i as the m-th, m+1-th, ... of a slot, of which c have a color; returns both numbers
    after it."""
    ox, oy, oz = rays.origins[i, 0], rays.origins[i, 1], rays.origins[i, 2]
    dx, dy, dz = rays.directions[i, 0], rays.directions[i, 1], rays.directions[i, 2]
    begin, end, jitter, step = rays.begin[i], rays.end[i], rays.jitter[i], cells.step
    inverse_x, inverse_y, inverse_z = _invert(dx), _invert(dy), _invert(dz)
    steps_per_cell = f32(1) / step
    last = buffers.t.shape[1] - 1
    passing, j = f32(1), 0
    while True:
        s = begin + (f32(j) + jitter) * step
        if not s < end:
            break
        x, y, z = ox + s * dx, oy + s * dy, oz + s * dz
        ix, iy, iz = int(x), int(y), int(z)
        j += 1
        brick = cells.table[ix >> 2, iy >> 2, iz >> 2]
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
        if not (cells.sampled[brick] >> cell) & 1:
            continue
        k = min(m, last)  # beyond the capacity, samples are only counted
        raw = _interpolate_density(x - f32(ix), y - f32(iy), z - f32(iz), brick, cell, cells, buffers, slot, k)
        if raw > cells.density_min:
            tau = math.exp(raw) * cells.density_scale
            transparency = math.exp(-tau)
            buffers.t[slot, k], buffers.tau[slot, k], buffers.passing[slot, k] = s, tau, passing
            buffers.color_index[slot, k] = -1
            if passing * (f32(1) - transparency) > cells.weight_min:
                buffers.color_index[slot, k] = min(c, last)
                c += 1
            m += 1
            passing *= transparency
            if passing < cells.transmittance_min:
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
def _interpolate_density(x, y, z, brick, cell, cells, buffers, slot, k):
    rows, weights = buffers.rows, buffers.weights
    u, v, w, k = f32(1) - x, f32(1) - y, f32(1) - z, 8 * k
    uv, uy, xv, xy = u * v, u * y, x * v, x * y
    weights[slot, k], weights[slot, k + 1], weights[slot, k + 2] = uv * w, uv * z, uy * w
    weights[slot, k + 3], weights[slot, k + 4], weights[slot, k + 5] = uy * z, xv * w, xv * z
    weights[slot, k + 6], weights[slot, k + 7] = xy * w, xy * z
    raw = f32(0)
    for corner in range(8):
        row = cells.neighbors[brick, NEIGHBOR[cell, corner]] * 64 + CORNER[cell, corner]
        rows[slot, k + corner] = row
        raw += weights[slot, k + corner] * cells.density[row]
    return raw


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
