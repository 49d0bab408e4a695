"""A wooden armchair with a striped cushion."""

from __future__ import annotations

from edge_se_sampler.data.synthetic.linear import rotation
from edge_se_sampler.data.synthetic.scene import Material, Pattern, SceneBuilder

WOOD = Material((0.33, 0.17, 0.07), (0.20, 0.09, 0.035), Pattern.WOOD, 3.0, roughness=0.4)
GOLD = Material((0.85, 0.6, 0.2), roughness=0.3, metalness=1.0)
CLOTH = Material((0.12, 0.32, 0.24), (0.75, 0.66, 0.40), Pattern.STRIPES, 7.0, roughness=0.9)
TUFT = Material((0.8, 0.7, 0.4), roughness=0.6)


def chair(scene: SceneBuilder) -> None:
    # seat and legs
    scene.box((0, 0, -0.12), (0.55, 0.52, 0.05), WOOD)
    scene.sphere((0, 0, -0.04), (0.52, 0.49, 0.13), CLOTH)
    for x in (-0.5, 0.5):
        for y in (-0.46, 0.46):
            scene.tube((x, y, -0.17), (1.12 * x, 1.12 * y, -0.95), 0.06, WOOD, end_radius=0.035)
            scene.sphere((1.12 * x, 1.12 * y, -0.96), 0.045, GOLD)
    # posts and arms
    for x in (-0.5, 0.5):
        post = [(x, 0.47, -0.12), (x, 0.55, 0.4), (0.95 * x, 0.66, 0.95)]
        scene.polyline(post, 0.045, WOOD)
        scene.sphere((0.95 * x, 0.66, 1.0), 0.06, GOLD)
        arm = [(x, -0.42, -0.1), (1.08 * x, -0.44, 0.22), (1.08 * x, 0, 0.28), (x, 0.53, 0.3)]
        scene.polyline(arm, 0.035, WOOD)
        scene.sphere((1.08 * x, -0.46, 0.23), 0.06, WOOD)
    # back
    for y, z in ((0.54, 0.25), (0.65, 0.9)):
        scene.tube((-0.5, y, z), (0.5, y, z), 0.035, WOOD)
    for k in range(9):
        x = -0.4 + 0.1 * k
        scene.tube((x, 0.54, 0.25), (0.95 * x, 0.65, 0.9), 0.012, WOOD)
    scene.sphere((0, 0.6, 0.57), (0.36, 0.06, 0.28), CLOTH, rotation((1, 0, 0), -10))
    for x in (-0.15, 0, 0.15):
        for z in (0.45, 0.57, 0.69):
            scene.sphere((x, 0.535 + 0.16 * (z - 0.57), z), 0.022, TUFT)
