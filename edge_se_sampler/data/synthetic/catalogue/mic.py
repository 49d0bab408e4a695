"""A microphone with a wire cage, on a stand."""

from __future__ import annotations

import math

from numpy.typing import ArrayLike

from edge_se_sampler.data.synthetic.linear import Array, apply, around, ring, rotation, spaced, vector
from edge_se_sampler.data.synthetic.scene import Material, Pattern, SceneBuilder

STEEL = Material((0.62, 0.62, 0.64), roughness=0.22, metalness=1.0)
DARK = Material((0.035, 0.035, 0.04))
FOAM = Material((0.10, 0.10, 0.11), (0.05, 0.05, 0.05), Pattern.BLOTCHES, 30.0, roughness=1.0)
LAMP = Material((0.1, 0.5, 0.9), roughness=0.3)

HEAD = vector([0.42, 0, 0.62])  # center of the cage; the handle leads from it along -z of TILT
TILT = rotation((0, 1, 0), -52)
CAGE = 0.27  # radius
FLOOR = -1.08


def _to_world(point: ArrayLike) -> Array:
    return apply(TILT, vector(point)) + HEAD


def mic(scene: SceneBuilder) -> None:
    # cage
    circle = [2 * math.pi * k / 24 for k in range(25)]
    for k in range(9):
        azimuth = math.pi * k / 9
        meridian = [around(CAGE * math.cos(t), azimuth, CAGE * math.sin(t)) for t in circle]
        scene.polyline([_to_world(p) for p in meridian], 0.007, STEEL, joints=False)
    for degrees in (-66, -50, -34, -17, 0, 17, 34, 50, 66):
        latitude = math.radians(degrees)
        parallel = ring(CAGE * math.cos(latitude), 28, CAGE * math.sin(latitude))
        scene.polyline([_to_world(p) for p in parallel], 0.007, STEEL, joints=False)
    scene.tube(_to_world((0, 0, -0.025)), _to_world((0, 0, 0.025)), 0.283, STEEL)
    scene.sphere(HEAD, 0.17, FOAM)
    # handle
    scene.tube(_to_world((0, 0, -0.9)), _to_world((0, 0, -0.24)), 0.085, DARK, end_radius=0.15)
    scene.tube(_to_world((0, 0, -0.27)), _to_world((0, 0, -0.22)), 0.165, STEEL)
    scene.tube(_to_world((0, 0, -0.95)), _to_world((0, 0, -0.9)), 0.07, STEEL)
    scene.box(_to_world((0.115, 0, -0.5)), (0.02, 0.03, 0.07), LAMP, TILT)
    cable = [
        _to_world((0, 0, -0.95)) + vector([-0.28 * t, 0.22 * math.sin(4 * t), -0.8 * t - 0.25 * t * t])
        for t in spaced(0, 1, 14)
    ]
    scene.polyline(cable, 0.016, DARK)
    # stand
    scene.tube(_to_world((0, 0, -0.68)), _to_world((0, 0, -0.56)), 0.125, STEEL)
    clamp = _to_world((0, 0, -0.62))
    x, _, z = clamp.tolist()
    scene.tube(clamp, (x, 0, -1.05), 0.022, STEEL)
    scene.sphere((x, 0, z - 0.15), 0.05, DARK)
    scene.tube((x, 0, FLOOR), (x, 0, -1.03), 0.36, DARK)
    scene.tube((x, 0, -1.03), (x, 0, -0.98), 0.2, DARK, end_radius=0.05)
