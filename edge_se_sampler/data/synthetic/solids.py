"""The three unit solids: ray intersections and normals in closed form.

Everything here happens in a solid's own frame, reached from the world by an affine map, so lengths are in units of
the solid itself. A ray is o + t d (d of any length, so t is the same number in the world and in the frame):

    sphere   x^2 + y^2 + z^2 <= 1
    box      |x|, |y|, |z| <= 1
    frustum  x^2 + y^2 <= (a + b z)^2, |z| <= 1, with both ends closed; (a, b) is its `taper`, a > |b| >= 0

Under an affine map the sphere becomes an ellipsoid, the frustum a rod, a disc or a cone.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np

from edge_se_sampler.data.synthetic.linear import Array, Index, dot


class Kind(IntEnum):
    SPHERE = 0
    BOX = 1
    FRUSTUM = 2


def hit_distance(kind: int, taper: Array, origin: Any, direction: Any, beyond: float) -> Array:
    """Smallest t > `beyond` at which each ray meets the solid's surface, the far side from inside; inf: never. `origin`
    and `direction` are three arrays each (or arrays (3, ...)) that broadcast together; `taper` (2,)."""
    with np.errstate(divide="ignore", invalid="ignore"):  # parallel rays give inf or nan, which every test rejects
        if kind == Kind.SPHERE:
            return _hit_sphere(origin, direction, beyond)
        if kind == Kind.BOX:
            return _hit_box(origin, direction, beyond)
        return _hit_frustum(taper, origin, direction, beyond)


def _hit_sphere(o: Any, d: Any, beyond: float) -> Array:
    a = dot(d, d)
    b = dot(o, d)
    c = dot(o, o) - 1
    discriminant = b * b - a * c
    root = np.sqrt(discriminant)
    t = (-b - root) / a
    t = np.where(t > beyond, t, (-b + root) / a)
    return np.where((discriminant >= 0) & (t > beyond), t, np.inf)


def _hit_box(o: Any, d: Any, beyond: float) -> Array:
    enter, leave = -np.inf, np.inf
    for k in range(3):
        inverse = 1 / d[k]
        low = (-1 - o[k]) * inverse
        high = (1 - o[k]) * inverse
        # fmax and fmin pass over the nan of a ray that runs inside a face
        enter = np.fmax(enter, np.fmin(low, high))
        leave = np.fmin(leave, np.fmax(low, high))
    t = np.where(enter > beyond, enter, leave)
    return np.where((enter <= leave) & (t > beyond), t, np.inf)


def _hit_frustum(taper: Array, o: Any, d: Any, beyond: float) -> Array:
    radius = taper[0] + taper[1] * o[2]
    slope = taper[1] * d[2]
    a = d[0] * d[0] + d[1] * d[1] - slope * slope
    b = o[0] * d[0] + o[1] * d[1] - radius * slope
    c = o[0] * o[0] + o[1] * o[1] - radius * radius
    root = np.sqrt(b * b - a * c)
    nearest = np.full(np.broadcast(a, b, c).shape, np.inf)
    for t in ((-b - root) / a, (-b + root) / a):
        on_side = (np.abs(o[2] + t * d[2]) <= 1) & (t > beyond) & (t < nearest)
        nearest = np.where(on_side, t, nearest)
    inverse = 1 / d[2]
    for z in (-1.0, 1.0):
        t = (z - o[2]) * inverse
        x = o[0] + t * d[0]
        y = o[1] + t * d[1]
        end = taper[0] + taper[1] * z
        on_cap = (x * x + y * y <= end * end) & (t > beyond) & (t < nearest)
        nearest = np.where(on_cap, t, nearest)
    return nearest


def outward_normals(kind: Index, taper: Array, points: Array) -> Array:
    """Normals (3, n), not of unit length, at surface points (3, n) of solids `kind` (n,) with `taper` (2, n)."""
    normals = points.copy()  # right for a sphere

    box = np.nonzero(kind == Kind.BOX)[0]
    face = np.abs(points[:, box]).argmax(axis=0)
    normals[:, box] = 0
    normals[face, box] = np.sign(points[face, box])

    frustum = np.nonzero(kind == Kind.FRUSTUM)[0]
    a, b = taper[:, frustum]
    z = points[2, frustum]
    cap = np.abs(z) > 1 - 1e-7
    normals[2, frustum] = np.where(cap, np.sign(z), -b * (a + b * z))
    normals[:2, frustum[cap]] = 0
    return normals
