"""Point lists that several scenes draw. Python's own sin and cos: numpy's differ by CPU in the last bits."""

from __future__ import annotations

import math

from edge_se_sampler.data.synthetic.linear import Array, vector


def around(radius: float, angle: float, z: float = 0.0) -> Array:
    """The point (3,) at an angle (radians) on a horizontal circle around the z axis."""
    return vector([radius * math.cos(angle), radius * math.sin(angle), z])


def ring(radius: float, corners: int, z: float = 0.0) -> list[Array]:
    """A closed horizontal polygon around the z axis: corners + 1 points (3,)."""
    return [around(radius, 2 * math.pi * k / corners, z) for k in range(corners + 1)]


def spaced(first: float, last: float, count: int) -> list[float]:
    """`count` numbers from first to last, evenly."""
    return [first + (last - first) * k / (count - 1) for k in range(count)]
