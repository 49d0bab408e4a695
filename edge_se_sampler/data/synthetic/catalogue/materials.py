"""Twelve balls of different materials on small stands."""

from __future__ import annotations

from edge_se_sampler.data.synthetic.scene import Material, Pattern, SceneBuilder

STAND = Material((0.30, 0.29, 0.28), (0.42, 0.41, 0.40), Pattern.CHECKER, 4.0, roughness=0.8)
BALLS = (
    Material((0.95, 0.93, 0.88), roughness=0.06, metalness=1.0),
    Material((0.95, 0.64, 0.54), roughness=0.15, metalness=1.0),
    Material((1.0, 0.78, 0.34), roughness=0.35, metalness=1.0),
    Material((0.05, 0.15, 0.6), reflectance=0.06, roughness=0.05),
    Material((0.7, 0.04, 0.04), roughness=0.1),
    Material((0.05, 0.4, 0.1), roughness=0.6),
    Material((0.8, 0.8, 0.8), (0.05, 0.05, 0.05), Pattern.CHECKER, 9.0, roughness=0.12),
    Material((0.5, 0.25, 0.1), (0.2, 0.08, 0.03), Pattern.WOOD, 5.0, roughness=0.2),
    Material((0.85, 0.85, 0.88), (0.3, 0.3, 0.5), Pattern.BLOTCHES, 12.0, roughness=0.4),
    Material((0.03, 0.03, 0.03), reflectance=0.08, roughness=0.08),
    Material((0.9, 0.5, 0.05), (0.7, 0.1, 0.1), Pattern.STRIPES, 6.0, roughness=0.3),
    Material((0.4, 0.4, 0.45), roughness=0.5, metalness=1.0),
)


def materials(scene: SceneBuilder) -> None:
    for k, material in enumerate(BALLS):
        x, y = 0.56 * (k % 4 - 1.5), 0.56 * (k // 4 - 1)
        scene.sphere((x, y, 0), 0.235, material)
        scene.tube((x, y, -0.30), (x, y, -0.2), 0.17, STAND, end_radius=0.12)
