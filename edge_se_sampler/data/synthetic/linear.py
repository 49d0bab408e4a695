"""3-vectors and 3x3 maps, component first, with no BLAS.

A vector is an array (3, ...) and a linear map an array (3 rows, 3 columns, ...); trailing axes broadcast. BLAS
kernels, `np.linalg`, `np.einsum` and numpy's own sin, cos and power choose instructions by the CPU and differ in
their last bits. Sums, products, quotients and square roots of float64 do not: IEEE 754 rounds each of them
correctly. So nothing else touches a pixel.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def vector(values: ArrayLike) -> Array:
    return np.asarray(values, dtype=np.float64)


def dot(a: Any, b: Any) -> Array:
    """Inner product (...) of two vectors (3, ...)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Array, b: Array) -> Array:
    """Vector product (3, ...) of two vectors (3, ...)."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def length(a: Array) -> Array:
    """Euclidean length (...) of a vector (3, ...)."""
    return np.sqrt(dot(a, a))


def around(radius: float, angle: float, z: float = 0.0) -> Array:
    """The point (3,) at an angle (radians) on a horizontal circle around the z axis."""
    return vector([radius * math.cos(angle), radius * math.sin(angle), z])


def ring(radius: float, corners: int, z: float = 0.0) -> list[Array]:
    """A closed horizontal polygon around the z axis: corners + 1 points (3,)."""
    return [around(radius, 2 * math.pi * k / corners, z) for k in range(corners + 1)]


def spaced(first: float, last: float, count: int) -> list[float]:
    return [first + (last - first) * k / (count - 1) for k in range(count)]


def unit(a: ArrayLike) -> Array:
    """The vector (3, ...) scaled to length 1."""
    a = vector(a)
    return a / length(a)


def apply(linear: Array, v: Any) -> Array:
    """The map (3, 3, ...) applied to the vector (3, ...)."""
    return np.stack([dot(linear[0], v), dot(linear[1], v), dot(linear[2], v)])


def compose(a: Array, b: Array) -> Array:
    """The map (3, 3, ...) that does `b` first, then `a`."""
    return np.stack([apply(a, b[:, 0]), apply(a, b[:, 1]), apply(a, b[:, 2])], axis=1)


def affine(linear: Array, translation: Array) -> Array:
    """The affine map (3, 4, ...) x -> linear x + translation."""
    return np.concatenate([linear, translation[:, None]], axis=1)


def invert(m: Array) -> Array:
    """The inverse (3, 4, ...) of an affine map (3, 4, ...), in closed form."""
    x, y, z = m[:, 0], m[:, 1], m[:, 2]
    rows = np.stack([cross(y, z), cross(z, x), cross(x, y)])
    linear = rows / dot(x, rows[0])
    return affine(linear, -apply(linear, m[:, 3]))


def rotation(axis: ArrayLike, degrees: float) -> Array:
    """Right-handed rotation (3, 3) about an axis of any length (Rodrigues)."""
    x, y, z = unit(axis)
    angle = math.radians(degrees)
    k = vector([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * compose(k, k)
