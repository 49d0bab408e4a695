"""Two hot dogs, one with mustard and one with ketchup, on a plate."""

from __future__ import annotations

import math

from edge_se_sampler.data.synthetic.linear import Array, apply, compose, ring, rotation, spaced, vector
from edge_se_sampler.data.synthetic.scene import Material, Pattern, SceneBuilder

PLATE = Material((0.50, 0.50, 0.53), (0.40, 0.41, 0.45), Pattern.BLOTCHES, 8.0, reflectance=0.05, roughness=0.25)
RIM = Material((0.10, 0.22, 0.5), roughness=0.2)
BUN = Material((0.72, 0.42, 0.15), (0.86, 0.62, 0.30), Pattern.BLOTCHES, 6.0, roughness=0.75)
CRUMB = Material((0.92, 0.82, 0.60), (0.85, 0.72, 0.48), Pattern.BLOTCHES, 18.0, roughness=0.9)
SAUSAGE = Material((0.52, 0.13, 0.05), (0.34, 0.07, 0.03), Pattern.BLOTCHES, 11.0, reflectance=0.05, roughness=0.3)
MUSTARD = Material((0.95, 0.66, 0.04), roughness=0.3)
KETCHUP = Material((0.62, 0.03, 0.02), roughness=0.25)


def hotdog(scene: SceneBuilder) -> None:
    scene.tube((0, 0, -0.30), (0, 0, -0.26), 0.8, PLATE, end_radius=1.0)
    scene.tube((0, 0, -0.26), (0, 0, -0.24), 1.0, PLATE, end_radius=1.18)
    scene.polyline(ring(1.17, 40, z=-0.24), 0.02, RIM, joints=False)
    _hotdog(scene, -0.36, rotation((0, 0, 1), -5), MUSTARD, waves=12.0)
    _hotdog(scene, 0.36, rotation((0, 0, 1), 6), KETCHUP, waves=14.4)


def _hotdog(scene: SceneBuilder, y: float, axes: Array, sauce: Material, waves: float) -> None:
    def to_world(*point: float) -> Array:
        return apply(axes, vector(point)) + vector([0, y, 0])

    for side in (-1, 1):
        leaning = compose(axes, rotation((1, 0, 0), 12 * side))
        scene.sphere(to_world(0, 0.17 * side, -0.08), (0.80, 0.17, 0.17), BUN, leaning)
    scene.sphere(to_world(0, 0, -0.12), (0.76, 0.2, 0.12), CRUMB, axes)
    sausage = [to_world(x, 0.02 * math.sin(3 * x), 0.045 + 0.03 * x * x) for x in spaced(-0.88, 0.88, 9)]
    scene.polyline(sausage, 0.105, SAUSAGE)
    for end in (sausage[0], sausage[-1]):
        scene.sphere(end, 0.105, SAUSAGE)
    line = [to_world(x, 0.075 * math.sin(waves * x), 0.16 + 0.03 * x * x) for x in spaced(-0.78, 0.78, 36)]
    scene.polyline(line, 0.024, sauce)
