"""A potted tree: three braided trunks, branches, some hundreds of leaves."""

from __future__ import annotations

import numpy as np

from edge_se_sampler.data.synthetic.linear import Array, around, cross, dot, spaced, unit, vector
from edge_se_sampler.data.synthetic.scene import Material, Pattern, SceneBuilder

POT = Material((0.45, 0.20, 0.12), (0.60, 0.32, 0.2), Pattern.BLOTCHES, 9.0, roughness=0.7)
SOIL = Material((0.09, 0.06, 0.04), (0.16, 0.11, 0.07), Pattern.BLOTCHES, 30.0, roughness=1.0)
BARK = Material((0.30, 0.21, 0.13), (0.16, 0.1, 0.06), Pattern.BLOTCHES, 25.0, roughness=0.8)
LEAVES = (
    Material((0.05, 0.26, 0.05), (0.09, 0.36, 0.07), Pattern.BLOTCHES, 20.0, roughness=0.35),
    Material((0.09, 0.36, 0.08), (0.16, 0.44, 0.10), Pattern.BLOTCHES, 20.0, roughness=0.35),
    Material((0.03, 0.17, 0.04), (0.06, 0.28, 0.06), Pattern.BLOTCHES, 20.0, roughness=0.35),
)


def ficus(scene: SceneBuilder) -> None:
    scene.tube((0, 0, -1.1), (0, 0, -0.7), 0.22, POT, end_radius=0.32)
    scene.tube((0, 0, -0.72), (0, 0, -0.66), 0.35, POT)
    scene.tube((0, 0, -0.66), (0, 0, -0.655), 0.31, SOIL)
    tree = _Tree(scene, np.random.RandomState(7))  # RandomState: its stream is frozen, a Generator's is not
    for angle in (0, 2.1, 4.2):
        foot = around(0.06, angle, -0.68)
        trunk = [foot + around(0.05, angle + 2.2 * t, 0.75 * t) for t in spaced(0, 1, 7)]
        scene.polyline(trunk, 0.028, BARK)
        tree.grow(trunk[-1], around(0.5, angle + 2.2, 0.85), 0.5, 0.018, generations=2)


class _Tree:
    def __init__(self, scene: SceneBuilder, random: np.random.RandomState) -> None:
        self.scene = scene
        self.random = random

    def grow(self, start: Array, direction: Array, size: float, radius: float, generations: int) -> None:
        """A branch of three pieces; then leaves on it, or `generations` of thinner branches."""
        points = [start]
        for _ in range(3):
            direction = unit(direction + 0.22 * self.random.randn(3) + vector([0, 0, 0.08]))
            points.append(points[-1] + direction * size / 3)
        self.scene.polyline(points, radius, BARK)
        if generations == 0:
            for point in np.repeat(points[1:], 3, axis=0):
                aside = unit(self.random.randn(3) * vector([1, 1, 0.6]))
                self._leaf(point, unit(aside + 0.4 * direction))
            return
        for k in range(3 if generations > 1 else 2 + self.random.randint(2)):
            aside = self.random.randn(3)
            aside = unit(aside - dot(aside, direction) * direction)
            outward = 0.75 * direction + 0.8 * aside
            self.grow(points[-1 - k % 2], outward, 0.62 * size, 0.6 * radius, generations - 1)

    def _leaf(self, stem: Array, along: Array) -> None:
        face = vector([0, 0, 1]) + 0.7 * self.random.randn(3)
        face = unit(face - dot(face, along) * along)
        half = 0.075 + 0.05 * self.random.rand()
        rotation = np.stack([along, cross(face, along), face], axis=1)
        material = LEAVES[self.random.randint(3)]
        self.scene.sphere(stem + (half + 0.03) * along, (half, 0.42 * half, 0.006), material, rotation)
        self.scene.tube(stem, stem + 0.05 * along, 0.004, BARK)
