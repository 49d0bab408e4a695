"""Surface patterns: how much of a material's second color shows at a point, 0 to 1.

q  point times the pattern's frequency, so that a period is 1; in the world for most patterns, in the solid's own
   frame for rings
"""

from __future__ import annotations

from itertools import product

import numpy as np

from edge_se_sampler.data.synthetic.linear import Array, Index
from edge_se_sampler.data.synthetic.scene import Pattern


def second_color_weight(pattern: int, world: Array, local: Array, frequency: Array) -> Array:
    """Weight (n,), 0 to 1, of the second color at points (3, n), given in the world and in their solids' frames."""
    q = world * frequency
    if pattern == Pattern.CHECKER:
        i, j, k = np.floor(q + 1e-4)  # 1e-4: a face that lies in a lattice plane does not flicker
        return np.mod(i + j + k, 2)
    if pattern == Pattern.STRIPES:
        return ((q[0] + q[1]) % 1 < 0.35).astype(np.float64)
    if pattern == Pattern.BLOTCHES:
        return np.clip(1.6 * (0.65 * value_noise(q) + 0.35 * value_noise(2.03 * q)) - 0.3, 0, 1)
    if pattern == Pattern.RINGS:
        x, y = local[:2] * frequency
        return (np.sqrt(x * x + y * y) % 1 < 0.3).astype(np.float64)
    if pattern == Pattern.WOOD:
        years = np.sqrt(q[0] * q[0] + q[1] * q[1])
        waver = value_noise(np.stack([q[0], q[1], 0.3 * q[2]]))
        return smooth_step(np.abs(2 * ((1.43 * years + 0.8 * waver - 0.25) % 1) - 1))
    return np.zeros(world.shape[1])


def smooth_step(x: Array) -> Array:
    """A smooth rise from 0 to 1 over 0 <= x <= 1."""
    return x * x * (3 - 2 * x)


def value_noise(q: Array) -> Array:
    """Smooth noise (n,) in 0..1 at points (3, n): fixed random values on whole numbers, blended between them."""
    base = np.floor(q)
    upper = smooth_step(q - base)
    weights = (1 - upper, upper)
    lattice = base.astype(np.int64)
    total = np.zeros(q.shape[1])
    for i, j, k in product((0, 1), repeat=3):
        value = _lattice_value(lattice[0] + i, lattice[1] + j, lattice[2] + k)
        total = total + weights[i][0] * weights[j][1] * weights[k][2] * value
    return total


def _lattice_value(i: Index, j: Index, k: Index) -> Array:
    """A fixed random number in 0..1 for each triple of whole numbers (an integer hash)."""
    h = (i * 374761393 + j * 668265263 + k * 2147483647) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFF) / 65535
