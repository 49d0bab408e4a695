"""Marching compiled: a ray is followed cell by cell, skips bricks that hold nothing, and ends where no light passes."""

# pyright: reportCallIssue=false
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

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
        table, neighbors, sampled = (value.numpy() for value in (grid.table, grid.neighbors, grid.sampled))
        return cls(
            table,
            neighbors,
            sampled,
            density.detach().numpy()[:, 0],
            f32(marching.step),
            f32(marching.density_scale),
            f32(marching.density_min),
            f32(marching.weight_min),
            f32(marching.transmittance_min),
        )


@njit(cache=True, error_model="numpy")
def march_chunk(rays, first, last, cells, buffers, slot):
    """Enter the samples of rays first .. last - 1 into a slot; returns how many there are, even if there is no room
    for all."""
    origins, directions, begins, ends, jitters = rays
    table, neighbors, sampled, density, step, density_scale, density_min, weight_min, transmittance_min = cells
    rows, weights, t, tau = buffers.rows[slot], buffers.weights[slot], buffers.t[slot], buffers.tau[slot]
    light, color_index, sample_ends = buffers.passing[slot], buffers.color_index[slot], buffers.ends[slot]
    room, steps_per_cell = len(t) - 1, f32(1) / step
    m, c = 0, 0
    for i in range(first, last):
        ox, oy, oz = origins[i, 0], origins[i, 1], origins[i, 2]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        begin, end, jitter = begins[i], ends[i], jitters[i]
        inverse_x, inverse_y, inverse_z = _invert(dx), _invert(dy), _invert(dz)
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
            k = min(m, room)  # beyond the capacity, samples are only counted
            _set_weights(x - f32(ix), y - f32(iy), z - f32(iz), weights, 8 * k)
            raw = f32(0)
            for corner in range(8):
                row = neighbors[brick, NEIGHBOR[cell, corner]] * 64 + CORNER[cell, corner]
                rows[8 * k + corner] = row
                raw += weights[8 * k + corner] * density[row]
            if raw > density_min:
                t[k], tau[k], light[k], color_index[k] = s, math.exp(raw) * density_scale, passing, -1
                transparency = math.exp(-tau[k])
                if passing * (f32(1) - transparency) > weight_min:
                    color_index[k] = min(c, room)
                    c += 1
                m += 1
                passing *= transparency
                if passing < transmittance_min:
                    break
        sample_ends[i - first] = m
    sample_ends[last - first :] = m
    buffers.num_colored[slot] = c
    return m


@njit(cache=True, inline="always")
def _invert(direction):
    return f32(1) / direction if abs(direction) > f32(1e-6) else f32(1e6)


@njit(cache=True, inline="always")
def _leave(brick, distance, origin, inverse):
    """Where a ray leaves the bricks less than `distance` away from one, along one axis."""
    plane = brick + distance if inverse > 0 else brick - distance + 1
    return (f32(plane * 4) - origin) * inverse


@njit(cache=True, inline="always")
def _set_weights(x, y, z, weights, k):
    """Enter the shares of a cell's corners at a position in it."""
    u, v, w = f32(1) - x, f32(1) - y, f32(1) - z
    uv, uy, xv, xy = u * v, u * y, x * v, x * y
    weights[k], weights[k + 1], weights[k + 2], weights[k + 3] = uv * w, uv * z, uy * w, uy * z
    weights[k + 4], weights[k + 5], weights[k + 6], weights[k + 7] = xv * w, xv * z, xy * w, xy * z


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
