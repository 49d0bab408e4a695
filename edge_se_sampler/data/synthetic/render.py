"""From a scene and a camera to a picture: sampling, averaging, tone.

A pixel averages SAMPLES_PER_AXIS^2 rays on a regular grid. Alpha is the fraction of them that hits the scene; color
is the mean radiance of those alone (straight alpha), clipped, sRGB-encoded. Float64 throughout, then 8 bits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge_se_sampler.data.synthetic.cameras import Camera
from edge_se_sampler.data.synthetic.linear import apply, unit
from edge_se_sampler.data.synthetic.scene import Scene
from edge_se_sampler.data.synthetic.shading import radiance
from edge_se_sampler.data.synthetic.visibility import NOTHING, first_hits

SAMPLES_PER_AXIS = 4
_BATCH = 1 << 16  # points shaded together: bounds the memory

_ENCODED = [(code - 0.5) / 255 for code in range(1, 256)]
# Linear values (255,) at which the 8-bit sRGB code rises by one; rounded, they are the same on every platform's pow
_SRGB_STEPS = np.round([e / 12.92 if e <= 0.04045 else ((e + 0.055) / 1.055) ** 2.4 for e in _ENCODED], 14)


def render(scene: Scene, camera: Camera) -> NDArray[np.uint8]:
    """(height, width, 4) RGBA, 8 bits, straight alpha, sRGB-encoded; the same bytes on every machine."""
    depth, seen = first_hits(scene, camera, SAMPLES_PER_AXIS)
    rows, columns = np.nonzero(seen != NOTHING)
    pixels = rows // SAMPLES_PER_AXIS * camera.width + columns // SAMPLES_PER_AXIS
    count = camera.width * camera.height
    total = np.zeros((3, count))
    x_slopes, y_slopes = camera.sample_slopes(SAMPLES_PER_AXIS)
    for start in range(0, len(rows), _BATCH):
        batch = np.s_[start : start + _BATCH]
        row, column = rows[batch], columns[batch]
        slopes = np.stack([x_slopes[column], y_slopes[row], np.full(len(row), -1.0)])
        rays = apply(camera.to_world[:3, :3], slopes)
        points = camera.to_world[:3, 3:4] + depth[row, column] * rays
        light = np.minimum(radiance(scene, seen[row, column], points, unit(rays)), 4)  # no glint bleaches its pixel
        for channel in range(3):
            total[channel] += np.bincount(pixels[batch], weights=light[channel], minlength=count)

    hits = np.bincount(pixels, minlength=count)
    picture = np.zeros((count, 4), dtype=np.uint8)
    picture[:, :3] = np.searchsorted(_SRGB_STEPS, (total / np.maximum(hits, 1)).T, side="right")
    samples = SAMPLES_PER_AXIS * SAMPLES_PER_AXIS
    picture[:, 3] = (2 * 255 * hits + samples) // (2 * samples)  # rounds to nearest
    return picture.reshape(camera.height, camera.width, 4)
