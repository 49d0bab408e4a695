"""A bulldozer of toy bricks on a studded plate, in place of NeRF's Lego."""

from __future__ import annotations

import math
from itertools import product

from edge_se_sampler.data.synthetic.linear import rotation, spaced, vector
from edge_se_sampler.data.synthetic.scene import Material, Pattern, SceneBuilder

YELLOW = Material((0.85, 0.52, 0.03), reflectance=0.05, roughness=0.25)
DARK = Material((0.10, 0.10, 0.11), roughness=0.35)
GRAY = Material((0.42, 0.43, 0.45), roughness=0.3)
RED = Material((0.6, 0.04, 0.03), roughness=0.25)
GREEN = Material((0.18, 0.42, 0.16), roughness=0.35)
GLASS = Material((0.75, 0.8, 0.85), reflectance=0.08, roughness=0.1)
WARNING = Material((0.85, 0.52, 0.03), (0.04, 0.04, 0.04), Pattern.STRIPES, 5.0, roughness=0.3)

STUD = 0.1  # distance between studs

Point = tuple[float, float, float]


def bricks(scene: SceneBuilder) -> None:
    _brick(scene, (0, 0, -0.62), (18, 12, 0.02), GREEN)
    for y in (-0.36, 0.36):
        # a track
        for x in (-0.5, -0.25, 0, 0.25):
            scene.tube((x, y - 0.1, -0.45), (x, y + 0.1, -0.45), 0.11, GRAY)
            scene.tube((x, y - 0.12, -0.45), (x, y + 0.12, -0.45), 0.04, RED)
        for k in range(11):
            for z in (-0.57, -0.33):
                scene.box((-0.55 + 0.085 * k, y, z), (0.037, 0.13, 0.018), DARK)
        for degrees in spaced(-75, 75, 5):
            out, up = 0.12 * math.cos(math.radians(degrees)), 0.12 * math.sin(math.radians(degrees))
            for side, x in ((1, 0.28), (-1, -0.53)):
                tilt = rotation((0, 1, 0), -side * degrees)
                scene.box((x + side * out, y, -0.45 + up), (0.018, 0.13, 0.035), DARK, tilt)
    # body
    _brick(scene, (-0.1, 0, -0.26), (8, 5, 0.05), YELLOW, studs=False)
    _brick(scene, (-0.3, 0, -0.16), (5, 5, 0.05), GRAY)
    _brick(scene, (0.2, 0, -0.14), (4, 4, 0.07), YELLOW)
    _brick(scene, (-0.35, 0, 0.02), (4, 5, 0.05), YELLOW, studs=False)
    _brick(scene, (-0.72, 0, -0.2), (2, 3, 0.08), DARK)
    for y in (-0.12, 0.12):
        scene.tube((0.2, y, -0.05), (0.2, y, 0.2), 0.035, DARK)
    # cab
    for x in (-0.52, -0.18):
        for y in (-0.22, 0.22):
            scene.tube((x, y, 0.06), (x, y, 0.42), 0.02, DARK)
    scene.box((-0.35, 0, 0.22), (0.16, 0.2, 0.13), GLASS)
    _brick(scene, (-0.35, 0, 0.46), (5, 6, 0.04), YELLOW)
    scene.tube((-0.5, -0.15, 0.5), (-0.5, -0.15, 0.68), 0.025, RED)
    scene.sphere((-0.5, -0.15, 0.7), 0.035, GLASS)
    # blade
    for y in (-0.3, 0.3):
        scene.box((0.42, y, -0.33), (0.32, 0.025, 0.035), GRAY, rotation((0, 1, 0), -8))
        scene.tube((0.15, y, -0.12), (0.68, y, -0.26), 0.022, RED)
    for degrees in (-28, -10, 10, 28):
        angle = math.radians(degrees)
        center = (0.86 - 0.12 * math.cos(angle), 0, -0.36 + 0.33 * math.sin(angle))
        scene.box(center, (0.025, 0.52, 0.085), WARNING, rotation((0, 1, 0), -degrees))


def _brick(
    scene: SceneBuilder, center: Point, size: tuple[int, int, float], material: Material, studs: bool = True
) -> None:
    """A brick of so many studs across and deep, and of a half height, with a hair's gap to its neighbours."""
    across, deep, half_height = size
    scene.box(center, (across * STUD / 2 - 0.002, deep * STUD / 2 - 0.002, half_height), material)
    for i, j in product(range(across), range(deep)) if studs else ():
        foot = vector(center) + vector([(i - (across - 1) / 2) * STUD, (j - (deep - 1) / 2) * STUD, half_height])
        scene.tube(foot, foot + vector([0, 0, 0.028]), 0.031, material)
