"""A scene: solids under affine maps, each of one material, fitted into a ball around the world's origin.

World units are NeRF's: z points up, the cameras look at the origin from a distance of about 4, and every solid lies
within BALL_RADIUS of it, so that no view clips one. P is the number of solids, M of materials.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from itertools import pairwise, product

import numpy as np
from numpy.typing import ArrayLike

from edge_se_sampler.data.synthetic.linear import Array, Index, affine, apply, cross, dot, invert, length, unit, vector
from edge_se_sampler.data.synthetic.solids import Kind

# World units. Small enough that the default offset keeps the ball's image whole when the cameras are rotated instead
# of shifted, which stretches what is off the axis; the centered frame would hold a ball of 1.36.
BALL_RADIUS = 1.15

_UPRIGHT = np.eye(3)
_CUBE = vector(list(product((-1, 1), repeat=3))).T  # corners (3, 8) of the unit box, which holds every unit solid

Color = tuple[float, float, float]  # linear RGB, 0 to 1


class Pattern(IntEnum):
    PLAIN = 0
    CHECKER = 1
    STRIPES = 2
    BLOTCHES = 3
    RINGS = 4
    WOOD = 5


@dataclass(frozen=True)
class Material:
    """What a solid looks like: two linear RGB colors, a pattern of them, and how it reflects."""

    color: Color
    second_color: Color | None = None  # None: the same as `color`
    pattern: Pattern = Pattern.PLAIN
    frequency: float = 1.0  # periods of the pattern per world unit
    reflectance: float = 0.04  # fraction of light mirrored at normal incidence by a non-metal
    roughness: float = 0.5  # 0 mirror to 1 matt
    metalness: float = 0.0  # 0 or 1


@dataclass(frozen=True)
class Scene:
    """What the renderer reads. Arrays run over P solids in their last axis."""

    kind: Index  # (P,) Kind
    taper: Array  # (2, P), see solids
    to_world: Array  # (3, 4, P) the solid's frame -> world
    to_local: Array  # (3, 4, P) its inverse
    corners: Array  # (3, 8, P) of each solid's box, world
    radius: Array  # (P,) of a ball around the solid's center that holds it
    material: Index  # (P,) index into `materials`
    materials: dict[str, Array]  # by the names of Material's fields: colors (3, M), all else (M,)


@dataclass(frozen=True)
class _Solid:
    kind: Kind
    linear: Array  # (3, 3); its columns are orthogonal
    center: Array  # (3,)
    material: Material
    taper: tuple[float, float] = (1.0, 0.0)

    def reach(self, point: Array) -> float:
        """No point of the solid is farther from `point` than this (exact for boxes, frusta and round spheres)."""
        away = self.center - point
        half_axes = length(self.linear)
        farthest_corner = float(length(away[:, None] + apply(self.linear, _CUBE)).max())
        if self.kind == Kind.BOX:
            return farthest_corner
        if self.kind == Kind.SPHERE:
            return min(farthest_corner, float(length(away) + half_axes.max()))
        reaches = []
        for end in (-1.0, 1.0):  # over the caps' rims
            rim = half_axes[0] * (self.taper[0] + end * self.taper[1])
            to_cap = away + end * self.linear[:, 2]
            along = dot(to_cap, self.linear[:, 2]) / half_axes[2]
            across = np.sqrt(np.maximum(dot(to_cap, to_cap) - along * along, 0)) + rim
            reaches.append(float(np.sqrt(along * along + across * across)))
        return max(reaches)


class SceneBuilder:
    """Collects solids in any unit and position; `build` fits them into the ball."""

    def __init__(self) -> None:
        self._solids: list[_Solid] = []

    def sphere(self, center: ArrayLike, radii: ArrayLike, material: Material, rotation: Array = _UPRIGHT) -> None:
        """An ellipsoid with half axes `radii` (one number or three) along the columns of `rotation`."""
        linear = rotation * np.broadcast_to(vector(radii), 3)
        self._solids.append(_Solid(Kind.SPHERE, linear, vector(center), material))

    def box(self, center: ArrayLike, half_sizes: ArrayLike, material: Material, rotation: Array = _UPRIGHT) -> None:
        """A box with half sizes (3) along the columns of `rotation`."""
        self._solids.append(_Solid(Kind.BOX, rotation * vector(half_sizes), vector(center), material))

    def tube(
        self, start: ArrayLike, end: ArrayLike, radius: float, material: Material, end_radius: float | None = None
    ) -> None:
        """A closed round rod between two points; `end_radius` (default: `radius`) makes it a cone's frustum."""
        start, end = vector(start), vector(end)
        end_radius = radius if end_radius is None else end_radius
        half = (end - start) / 2
        along = unit(half)
        aside = unit(cross(along, vector([1, 0, 0] if abs(along[0]) < 0.9 else [0, 1, 0])))
        wide = max(radius, end_radius)
        linear = np.stack([wide * aside, wide * cross(along, aside), half], axis=1)
        taper = ((end_radius + radius) / (2 * wide), (end_radius - radius) / (2 * wide))
        self._solids.append(_Solid(Kind.FRUSTUM, linear, (start + end) / 2, material, taper))

    def polyline(self, points: Sequence[ArrayLike], radius: float, material: Material, joints: bool = True) -> None:
        """A rod along points (3,), its inner corners rounded by spheres where `joints`."""
        for start, end in pairwise(points):
            self.tube(start, end, radius, material)
        if joints:
            for point in points[1:-1]:
                self.sphere(point, radius, material)

    def build(self) -> Scene:
        """The scene, moved to the origin and scaled until it just fits into the ball of BALL_RADIUS."""
        solids = self._solids
        linear = np.stack([solid.linear for solid in solids], axis=-1)
        center = np.stack([solid.center for solid in solids], axis=-1)
        half_extent = np.abs(linear[:, 0]) + np.abs(linear[:, 1]) + np.abs(linear[:, 2])
        middle = ((center - half_extent).min(axis=1) + (center + half_extent).max(axis=1)) / 2
        scale = (BALL_RADIUS - 1e-9) / max(solid.reach(middle) for solid in solids)  # 1e-9: room for the rounding
        # 12 decimals: without the last bits, in which one platform's sin differs from another's
        to_world = np.round(affine(scale * linear, scale * (center - middle[:, None])), 12)

        kind = np.array([solid.kind for solid in solids])
        half_diagonals = apply(to_world[:, :3, None], _CUBE[..., None])  # (3, 8, P)
        half_axes = length(to_world[:, :3])
        materials = list(dict.fromkeys(solid.material for solid in solids))
        two_colored = [replace(m, second_color=m.second_color or m.color) for m in materials]
        return Scene(
            kind=kind,
            taper=np.array([solid.taper for solid in solids]).T,
            to_world=to_world,
            to_local=invert(to_world),
            corners=half_diagonals + to_world[:, 3][:, None],
            radius=np.where(kind == Kind.SPHERE, half_axes.max(axis=0), length(half_diagonals).max(axis=0)),
            material=np.array([materials.index(solid.material) for solid in solids]),
            materials={f.name: np.array([getattr(m, f.name) for m in two_colored]).T for f in fields(Material)},
        )
