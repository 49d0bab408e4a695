"""A drum kit: five drums, four cymbals on stands, a stool, two sticks."""

from __future__ import annotations

import math

from numpy.typing import ArrayLike

from edge_se_sampler.data.synthetic.linear import Array, apply, around, ring, rotation, vector
from edge_se_sampler.data.synthetic.scene import Material, Pattern, SceneBuilder

SHELL = Material((0.5, 0.03, 0.04), reflectance=0.06, roughness=0.15)
HEAD = Material((0.82, 0.80, 0.74), (0.6, 0.58, 0.52), Pattern.RINGS, 6.0, roughness=0.6)
CHROME = Material((0.8, 0.8, 0.82), roughness=0.2, metalness=1.0)
BRASS = Material((0.9, 0.68, 0.28), (0.62, 0.42, 0.12), Pattern.RINGS, 14.0, roughness=0.2, metalness=1.0)
BLACK = Material((0.03, 0.03, 0.03))
STICK = Material((0.6, 0.4, 0.2))

FLOOR = -0.8


def drums(scene: SceneBuilder) -> None:
    _drum(scene, (0, 0.1, -0.35), 0.42, 0.26, rotation((1, 0, 0), 90), lugs=10)
    _drum(scene, (-0.25, 0.05, 0.28), 0.2, 0.13, rotation((1, 0.2, 0), 18))
    _drum(scene, (0.25, 0.05, 0.28), 0.21, 0.13, rotation((1, -0.2, 0), 18))
    _drum(scene, (-0.72, -0.35, -0.12), 0.24, 0.1, rotation((1, 0, 0), 6))
    _drum(scene, (0.74, -0.3, -0.25), 0.3, 0.26, rotation((0, 0, 1), 0))
    for x in (-0.9, -0.74, -0.56):
        scene.tube((x, -0.35 + 0.1 * (x + 0.7), -0.22), (1.05 * x, -0.4, FLOOR), 0.012, CHROME)
    for x, y in ((0.55, -0.45), (0.95, -0.3), (0.7, -0.05)):
        scene.tube((x, y, -0.4), (x, y, FLOOR), 0.014, CHROME)

    _cymbal(scene, (-0.75, 0.4, 0.72), 0.34, 16, (-0.7, 0.4, FLOOR))
    _cymbal(scene, (0.75, 0.4, 0.82), 0.38, -14, (0.7, 0.4, FLOOR))
    _cymbal(scene, (-1.0, -0.1, 0.25), 0.24, 4, (-1.0, -0.1, FLOOR))
    scene.tube((-1.0, -0.1, 0.28), (-1.0, -0.1, 0.31), 0.24, BRASS, end_radius=0.06)

    # stool and sticks
    scene.tube((0, -0.75, -0.3), (0, -0.75, -0.2), 0.2, BLACK)
    scene.tube((0, -0.75, -0.3), (0, -0.75, FLOOR), 0.02, CHROME)
    for k in range(3):
        foot = vector([0, -0.75, 0]) + around(0.22, 2.1 * k, FLOOR)
        scene.tube((0, -0.75, -0.6), foot, 0.014, CHROME)
    scene.tube((-0.8, -0.5, 0), (-0.45, -0.25, 0.04), 0.009, STICK)
    scene.tube((-0.6, -0.52, 0), (-0.7, -0.2, 0.04), 0.009, STICK)


def _drum(
    scene: SceneBuilder, center: ArrayLike, radius: float, half_height: float, axes: Array, lugs: int = 8
) -> None:
    center = vector(center)
    up = half_height * axes[:, 2]
    scene.tube(center - up, center + up, radius, SHELL)
    scene.tube(center + up, center + up + 0.012 * axes[:, 2], 0.97 * radius, HEAD)
    for end in (-1, 1):
        hoop = [center + end * up + apply(axes, point) for point in ring(1.02 * radius, 20)]
        scene.polyline(hoop, 0.014, CHROME, joints=False)
    for k in range(lugs):
        lug = center + apply(axes, around(1.05 * radius, 2 * math.pi * k / lugs))
        scene.tube(lug - up, lug + up, 0.009, CHROME)
        scene.sphere(lug, 0.025, CHROME)


def _cymbal(
    scene: SceneBuilder, center: ArrayLike, radius: float, tilt: float, foot: tuple[float, float, float]
) -> None:
    center = vector(center)
    axes = rotation((1, 0.4, 0), tilt)
    up = axes[:, 2]
    scene.tube(center - 0.025 * up, center + 0.015 * up, radius, BRASS, end_radius=0.25 * radius)
    scene.sphere(center + 0.01 * up, (0.08, 0.08, 0.045), BRASS, axes)
    scene.tube(foot, center + 0.07 * up, 0.012, CHROME)
    for k in range(3):
        leg = vector(foot) + around(0.2, 2.1 * k + 0.3)
        scene.tube((foot[0], foot[1], foot[2] + 0.25), leg, 0.01, CHROME)
