"""The surface at which a density passes a threshold: marching cubes (Lorensen & Cline 1987; Lewiner et al. 2003) in
blocks of the box that overlap by a corner, so that no grid of the whole box is in memory."""

from __future__ import annotations

import itertools

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.occupancy.bricks import BRICK, BrickGrid

BLOCK = 16
"""Bricks along a block."""
MAX_DIFFERENCE, LEAST_DIFFERENCE = 5.0, 0.02
"""Of logarithms of density from the threshold's. Where nothing is occupied the density is the maximum below: a surface
ends less than half a cell beyond. The least keeps vertices off corners: each is on one edge, triangles have area."""


def find_surface(grid: BrickGrid, difference: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) float64, world units, and triangles (f, 3) of the closed surface at which a difference passes 0,
    by its values (64 K,) at the corners of cells; its normals point to where that is negative. Both are empty where
    nothing is positive."""
    from skimage.measure import marching_cubes

    difference = difference.float().cpu()
    away = difference.abs().clamp(LEAST_DIFFERENCE, MAX_DIFFERENCE)
    difference = torch.where(difference < 0, -away, away)
    numbers = F.pad(grid.numbers.cpu(), (1, 1) * 3, value=-1)  # bricks of nothing around the box
    blocks = list(itertools.product(*(range(0, size, BLOCK) for size in numbers.shape)))
    vertices, triangles, count = [np.empty((0, 3))], [np.empty((0, 3), dtype=np.int64)], 0
    with Progress(len(blocks), "finding the surface") as progress:
        for i, start in enumerate(blocks):
            x, y, z = (slice(begin, begin + BLOCK + 1) for begin in start)
            values = _corners_of_block(numbers[x, y, z], difference)
            if (values > 0).any():
                found, faces, _, _ = marching_cubes(values.numpy(), 0.0, gradient_direction="ascent")
                vertices.append(found + BRICK * np.array(start, dtype=np.float64))
                triangles.append(faces + count)
                count += len(found)
            progress.update(i + 1)
    corners, faces = _weld(np.concatenate(vertices), np.concatenate(triangles))
    return grid.aabb_min.cpu().numpy() + (corners - BRICK) * float(grid.cell_size), faces


def _corners_of_block(numbers: Tensor, difference: Tensor) -> Tensor:
    """Values at the corners of a block's cells, by the numbers of its bricks and of the next along each axis; empty if
    no surface passes through it."""
    stored = numbers >= 0
    bricks = difference.reshape(-1, BRICK, BRICK, BRICK)[numbers[stored].long()]
    if not (bricks > 0).any():
        return torch.empty(0)
    values = torch.full((*numbers.shape, BRICK, BRICK, BRICK), -MAX_DIFFERENCE)
    values[stored] = bricks
    values = values.permute(0, 3, 1, 4, 2, 5).reshape([BRICK * size for size in numbers.shape])
    values = values[: BRICK * BLOCK + 1, : BRICK * BLOCK + 1, : BRICK * BLOCK + 1]
    return values if (values < 0).any() else torch.empty(0)


def _weld(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3), in cells, and triangles, with one of the vertices that blocks share on each edge of a cell."""
    doubled = np.floor(vertices + 1e-3) + np.ceil(vertices - 1e-3)  # even along the axes on which it is at a corner
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
    _, part = connected_components(coo_array((np.ones(len(edges[0])), edges), shape=(len(vertices),) * 2), False)
    kept = np.isin(part, np.argsort(-np.bincount(part[a]), kind="stable")[:count])
    return vertices[kept], (np.cumsum(kept) - 1)[triangles[kept[a]]]


def simplify(vertices: np.ndarray, triangles: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """The vertices and triangles of a closed surface with fewer of both, nowhere farther than that from the first one,
    and as closed; none if all of it is smaller."""
    from manifold3d import Manifold, Mesh64

    mesh = Manifold(Mesh64(vertices, triangles.astype(np.uint64))).simplify(tolerance).to_mesh64()
    return mesh.vert_properties[:, :3], mesh.tri_verts.astype(np.int64)
