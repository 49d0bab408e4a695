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
    rows, weights, t, tau = buffers.rows[slot], buffers.weights[slot], buffers.t[slot], buffers.tau[slot]
    before, color_index, sample_ends = buffers.transmittance[slot], buffers.color_index[slot], buffers.ends[slot]
    next_sample, inverse = buffers.next_sample[slot], buffers.inverse[slot]
    room = len(t) - 1
    m, c = 0, 0
    _find_first_samples(rays, first, last, cells, next_sample, inverse)
    for i in range(first, last):
        ray = i - first
        transmittance, j = f32(1), next_sample[ray]
        while j >= 0:
            s, x, y, z, brick, cell, following = _find_cell(rays, i, cells, inverse, 3 * ray, j)
            j = following
            if cell < 0:
                continue
            k = min(m, room)  # beyond the capacity, samples are only counted
            _set_weights(x, y, z, weights, 8 * k)
            raw = f32(0)
            for corner in range(8):
                row = cells.neighbors[brick, NEIGHBOR[cell, corner]] * 64 + CORNER[cell, corner]
                rows[8 * k + corner] = row
                raw += weights[8 * k + corner] * cells.density[row]
            if raw > cells.density_min:
                t[k], tau[k], before[k], color_index[k] = s, math.exp(raw) * cells.density_scale, transmittance, -1
                transparency = math.exp(-tau[k])
                if transmittance * (f32(1) - transparency) > cells.weight_min:
                    color_index[k] = min(c, room)
                    c += 1
                m += 1
                transmittance *= transparency
                if transmittance < cells.transmittance_min:
                    break
        sample_ends[ray] = m
    sample_ends[last - first :] = m
    buffers.num_colored[slot] = c
    return m


@njit(cache=True, error_model="numpy")
def _find_first_samples(rays, first, last, cells, next_sample, inverse):
    """The number of each ray's first sample in a cell that is sampled; -1: it has none. Rays take turns, so that the
    processor follows several of them at once: on one, each step waits for what is found at the step before."""
    num_active, active = last - first, np.arange(last - first)
    for ray in range(num_active):
        next_sample[ray] = 0
        for axis in range(3):
            inverse[3 * ray + axis] = _invert(rays.directions[first + ray, axis])
    while num_active > 0:
        kept = 0
        for number in range(num_active):
            ray = active[number]
            cell, following = _find_cell(rays, first + ray, cells, inverse, 3 * ray, next_sample[ray])[-2:]
            if cell < 0:
                next_sample[ray] = following
                active[kept] = ray
                kept += following >= 0
        num_active = kept


@njit(cache=True, inline="always", error_model="numpy")
def _find_cell(rays, i, cells, inverse, k, j):
    """Where sample j of ray i, of direction 1 / inverse[k:], is: its distance on the ray, its position in its cell,
    number of the brick and of the cell, -1 if it is not sampled; and which sample is next, -1 beyond the end."""
    steps_per_cell = f32(1) / cells.step
    ox, oy, oz = rays.origins[i, 0], rays.origins[i, 1], rays.origins[i, 2]
    s = rays.begin[i] + (f32(j) + rays.jitter[i]) * cells.step
    if not s < rays.end[i]:
        return s, f32(0), f32(0), f32(0), -1, -1, -1
    x = ox + s * rays.directions[i, 0]
    y = oy + s * rays.directions[i, 1]
    z = oz + s * rays.directions[i, 2]
    ix, iy, iz = int(x), int(y), int(z)
    brick = int(cells.table[ix >> 2, iy >> 2, iz >> 2])
    cell = ((ix & 3) << 4) | ((iy & 3) << 2) | (iz & 3)
    j += 1
    if brick < 0:
        leave = min(
            _leave(ix >> 2, -brick, ox, inverse[k]),
            _leave(iy >> 2, -brick, oy, inverse[k + 1]),
            _leave(iz >> 2, -brick, oz, inverse[k + 2]),
        )
        cell = -1
        # rounded down, and one less: rounding must not skip a cell
        j = max(j, int((leave - rays.begin[i]) * steps_per_cell - rays.jitter[i]))
    elif not (cells.sampled[brick] >> cell) & 1:
        cell = -1
    return s, x - f32(ix), y - f32(iy), z - f32(iz), brick, cell, j


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
