"""The surface at which a density passes a threshold: marching cubes (Lorensen & Cline 1987; Lewiner et al. 2003) in
blocks of the box that overlap by a corner, so that no grid of the whole box is in memory."""

from __future__ import annotations

import itertools

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.export.density import DensityGrid
from edge_se_sampler.occupancy.bricks import BRICK

BLOCK = 16
"""Bricks along a block."""
MAX_DIFFERENCE, LEAST_DIFFERENCE = 5.0, 0.02
"""From the threshold, of logarithms of density. Where nothing is occupied the density is the maximum below it: so the
surface ends less than half a cell beyond. The least one keeps vertices away from corners: so all triangles have an
area, and each vertex is on one edge of a cell."""


def find_surface(density: DensityGrid, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) float64, world units, and triangles (f, 3) int64 of the closed surface at which the optical depth
    across a cell passes a threshold; their normals point out of what is dense. Both are empty where nothing is."""
    from skimage.measure import marching_cubes

    differences = (density.log_depth.cpu() - np.log(threshold)).clamp(-MAX_DIFFERENCE, MAX_DIFFERENCE)
    least = torch.where(differences < 0, -LEAST_DIFFERENCE, LEAST_DIFFERENCE)
    differences = torch.where(differences.abs() < LEAST_DIFFERENCE, least, differences)
    # a brick of nothing around the box
    numbers = F.pad(density.grid.numbers.cpu(), (1, 1) * 3, value=-1)
    blocks = list(itertools.product(*(range(0, size, BLOCK) for size in numbers.shape)))
    vertices, triangles, count = [np.empty((0, 3))], [np.empty((0, 3), dtype=np.int64)], 0
    with Progress(len(blocks), "finding the surface") as progress:
        for i, start in enumerate(blocks):
            x, y, z = (slice(begin, begin + BLOCK + 1) for begin in start)
            values = _corners_of_block(numbers[x, y, z], differences)
            if values is not None:
                found, faces, _, _ = marching_cubes(values.numpy(), 0.0, gradient_direction="ascent")
                vertices.append(found + BRICK * np.array(start, dtype=np.float64))
                triangles.append(faces + count)
                count += len(found)
            progress.update(i + 1)
    corners, faces = _weld(np.concatenate(vertices), np.concatenate(triangles))
    grid = density.grid
    return grid.aabb_min.cpu().numpy() + (corners - BRICK) * float(grid.cell_size), faces


def _corners_of_block(numbers: Tensor, differences: Tensor) -> Tensor | None:
    """Values at the corners of a block's cells, by the numbers of its bricks and of those that follow along each axis;
    None if no surface passes through it."""
    stored = numbers >= 0
    bricks = differences.reshape(-1, BRICK, BRICK, BRICK)[numbers[stored].long()]
    if not (bricks > 0).any():
        return None
    values = torch.full((*numbers.shape, BRICK, BRICK, BRICK), -MAX_DIFFERENCE)
    values[stored] = bricks
    values = values.permute(0, 3, 1, 4, 2, 5).reshape([BRICK * size for size in numbers.shape])
    x, y, z = (slice(BRICK * BLOCK + 1),) * 3
    values = values[x, y, z].contiguous()
    return values if (values > 0).any() and (values < 0).any() else None


def _weld(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3), in cells, and triangles without the second of two vertices on the same edge of a cell, which
    neighboring blocks share; a vertex that is on no edge is within a cell."""
    doubled = np.floor(vertices + 1e-3) + np.ceil(vertices - 1e-3)  # even along axes on which it is at a corner
    key = np.ravel_multi_index(doubled.astype(np.int64).T, doubled.max(axis=0, initial=0).astype(np.int64) + 1)
    _, first, number = np.unique(key, return_index=True, return_inverse=True)
    return vertices[first], number.reshape(-1)[triangles]


def keep_largest(vertices: np.ndarray, triangles: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The vertices and triangles of the connected parts with the most triangles; 0: of all."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not count:
        return vertices, triangles
    a, b, c = triangles.T
    edges = np.concatenate((a, b)), np.concatenate((b, c))
    graph = coo_array((np.ones(len(edges[0]), dtype=np.int8), edges), shape=(len(vertices),) * 2)
    _, part = connected_components(graph, directed=False)
    largest = np.argsort(-np.bincount(part[a]), kind="stable")[:count]
    kept = np.isin(part, largest)
    return vertices[kept], (np.cumsum(kept) - 1)[triangles[kept[a]]]
