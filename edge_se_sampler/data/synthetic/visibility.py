"""Who sees what: primary visibility, shadows of the key light, and rays that bounce.

t  distance along a ray, in lengths of its direction; inf where it meets nothing
KEY_DIRECTION  unit vector from everywhere toward the key light, which is infinitely far away

Every answer is exact: each solid is intersected in closed form with the rays that could meet it, which cheap bounds
pick. The bounds only ever spare work; they never change an answer.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge_se_sampler.data.synthetic.cameras import Camera
from edge_se_sampler.data.synthetic.linear import Array, Index, apply, compose, cross, dot, unit, vector
from edge_se_sampler.data.synthetic.scene import Scene
from edge_se_sampler.data.synthetic.solids import hit_distance

KEY_DIRECTION = unit([0.45, -0.35, 0.82])
NOTHING = -1  # the index of no solid

_KEY_ASIDE = unit(cross(KEY_DIRECTION, vector([0, 0, 1])))
_KEY_FRAME = np.stack([_KEY_ASIDE, cross(KEY_DIRECTION, _KEY_ASIDE), KEY_DIRECTION])  # rows: u, v, toward the light


def first_hits(scene: Scene, camera: Camera, per_axis: int) -> tuple[Array, Index]:
    """What the camera sees through per_axis x per_axis samples of each pixel. Returns t (rows, columns) along rays of
    unit depth and the solid's index, NOTHING where there is none."""
    x_slopes, y_slopes = camera.sample_slopes(per_axis)
    rotation, eye = camera.to_world[:3, :3], camera.to_world[:3, 3]
    local_eye = apply(scene.to_local[:, :3], eye) + scene.to_local[:, 3]
    local_rotation = compose(scene.to_local[:, :3], rotation)
    depth = np.full((len(y_slopes), len(x_slopes)), np.inf)
    seen = np.full(depth.shape, NOTHING)
    for solid, (left, right, top, bottom) in enumerate(_windows(scene, camera, per_axis)):
        x = x_slopes[None, left:right]
        y = y_slopes[top:bottom, None]
        along_x, along_y, back = local_rotation[..., solid].T
        direction = [along_x[k] * x + (along_y[k] * y - back[k]) for k in range(3)]
        t = hit_distance(scene.kind[solid], scene.taper[:, solid], local_eye[:, solid], direction, 1e-6)
        window = np.s_[top:bottom, left:right]
        nearer = t < depth[window]
        np.copyto(depth[window], t, where=nearer)
        np.copyto(seen[window], solid, where=nearer)
    return depth, seen


def _windows(scene: Scene, camera: Camera, per_axis: int) -> list[list[int]]:
    """Left, right, top and bottom (right and bottom excluded) of samples that could see each solid."""
    eye = camera.to_world[:3, 3]
    x, y, back = apply(camera.to_world[:3, :3].T, scene.corners - eye[:, None, None])
    columns, rows = camera.width * per_axis, camera.height * per_axis
    with np.errstate(divide="ignore", invalid="ignore"):
        u = (camera.principal[0] - x / back * camera.focal) * per_axis
        v = (camera.principal[1] + y / back * camera.focal) * per_axis
    behind = (back > -1e-3).any(axis=0)  # a corner beside or behind the camera has no projection: look everywhere
    bounds = []
    for position, count in ((u, columns), (v, rows)):
        first = np.clip(np.floor(position.min(axis=0)) - 1, 0, count)
        last = np.clip(np.ceil(position.max(axis=0)) + 1, 0, count)
        bounds += [np.where(behind, 0, first), np.where(behind, count, last)]
    return np.stack(bounds, axis=1).astype(int).tolist()


def in_shadow(scene: Scene, points: Array) -> NDArray[np.bool_]:
    """Whether a solid stands between each point (3, n) and the key light."""
    order = np.argsort(dot(points, _KEY_FRAME[0]), kind="stable")
    points = points[:, order]
    u, v, height = apply(_KEY_FRAME, points)
    corner_u, corner_v, corner_height = apply(_KEY_FRAME, scene.corners)  # (8, P) each
    starts = np.searchsorted(u, corner_u.min(axis=0))
    stops = np.searchsorted(u, corner_u.max(axis=0), side="right")
    lowest_v, highest_v, highest = corner_v.min(axis=0), corner_v.max(axis=0), corner_height.max(axis=0)
    blocked = np.zeros(points.shape[1], dtype=bool)
    for solid, (start, stop) in enumerate(zip(starts.tolist(), stops.tolist(), strict=True)):
        near = np.s_[start:stop]
        inside = (v[near] >= lowest_v[solid]) & (v[near] <= highest_v[solid])
        which = start + np.nonzero(inside & (height[near] < highest[solid]) & ~blocked[near])[0]
        if len(which) == 0:
            continue
        blocked[which] = _hit(scene, solid, points[:, which], KEY_DIRECTION) < np.inf
    answer = np.empty_like(blocked)
    answer[order] = blocked
    return answer


def _hit(scene: Scene, solid: int, origins: Array, directions: Array) -> Array:
    """Where rays from other surfaces, (3, n) with directions (3, n) or (3,), meet one solid: t (n,)."""
    linear, translation = scene.to_local[:, :3, solid], scene.to_local[:, 3:, solid]
    origins, directions = apply(linear, origins) + translation, apply(linear, directions)
    # 1e-5: a ray that starts on a surface does not meet it again
    return hit_distance(scene.kind[solid], scene.taper[:, solid], origins, directions, 1e-5)


def nearest_hits(scene: Scene, origins: Array, directions: Array) -> tuple[Array, Index]:
    """What rays (3, n) of unit direction meet first: t (n,) and the solid's index, NOTHING where there is none."""
    nearest = np.full(origins.shape[1], np.inf)
    met = np.full(origins.shape[1], NOTHING)
    centers = scene.to_world[:, 3]
    origin_along = dot(origins, directions)
    origin_square = dot(origins, origins)
    ball = dot(centers, centers) - scene.radius * scene.radius - 1e-9  # 1e-9: room for rounding
    for solid in range(len(scene.kind)):
        center = centers[:, solid]
        b = origin_along - dot(directions, center)
        c = origin_square - 2 * dot(origins, center) + ball[solid]
        which = np.nonzero((b * b >= c) & ((b < 0) | (c < 0)))[0]  # rays that meet the ball around the solid
        if len(which) == 0:
            continue
        t = _hit(scene, solid, origins[:, which], directions[:, which])
        nearer = t < nearest[which]
        nearest[which[nearer]] = t[nearer]
        met[which[nearer]] = solid
    return nearest, met
