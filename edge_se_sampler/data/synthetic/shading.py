"""Light: what radiance leaves a surface point toward the eye.

Linear RGB, arrays (3, n). V unit ray from the eye, N unit normal facing it, L the key light's direction, R mirror
direction. One distant key light casts shadows; a hemisphere of ambient light and a sky (seen in reflections) do not.
Smooth materials mirror the scene itself, one bounce deep. Powers are spelled out as products: see linear.
"""

from __future__ import annotations

import math

import numpy as np

from edge_se_sampler.data.synthetic.linear import Array, Index, apply, dot, unit, vector
from edge_se_sampler.data.synthetic.patterns import second_color_weight, smooth_step
from edge_se_sampler.data.synthetic.scene import Scene
from edge_se_sampler.data.synthetic.solids import outward_normals
from edge_se_sampler.data.synthetic.visibility import KEY_DIRECTION, NOTHING, in_shadow, nearest_hits

_KEY_COLOR = vector([2.3, 2.2, 2.05])[:, None]
_AMBIENT_ABOVE = vector([0.52, 0.56, 0.62])[:, None]
_AMBIENT_BELOW = vector([0.20, 0.18, 0.17])[:, None]
_GROUND = vector([0.24, 0.21, 0.19])[:, None]
_HORIZON = vector([0.62, 0.68, 0.76])[:, None]
_TOWARD_ZENITH = vector([0.03, 0.12, 0.30])[:, None]
_SOFT_BOXES = (  # direction, color, cosine of the angle at which it ends
    (unit([-0.6, -0.5, 0.62]), vector([2.6, 2.5, 2.4])[:, None], 0.90),
    (unit([0.1, 0.85, 0.5]), vector([1.5, 1.6, 1.9])[:, None], 0.95),
)


def radiance(scene: Scene, solid: Index, points: Array, rays: Array, *, bounces: int = 1) -> Array:
    """Radiance (3, n) toward the eye from points (3, n) on solids (n,), seen along unit rays (3, n). With `bounces` 0,
    as things look in a mirror, shadows and further mirrors are left out."""
    local, normals, cos_eye = _surface(scene, solid, points, rays)
    material = {name: column[..., scene.material[solid]] for name, column in scene.materials.items()}
    roughness, metalness = material["roughness"], material["metalness"]
    albedo = _albedo(material, local, points)

    above = points + 1e-4 * normals  # where secondary rays start
    cos_key = np.maximum(dot(normals, KEY_DIRECTION), 0)
    lit = cos_key > 0
    up = 0.5 + 0.5 * normals[2]
    ambient = up * _AMBIENT_ABOVE + (1 - up) * _AMBIENT_BELOW
    if bounces > 0:
        facing = np.nonzero(lit)[0]
        lit[facing] = ~in_shadow(scene, above[:, facing])
    else:
        ambient = ambient + 0.3 * cos_key * _KEY_COLOR
    key = cos_key * lit * _KEY_COLOR

    mirrored = rays + 2 * cos_eye * normals
    surroundings = _sky(mirrored, roughness)
    if bounces > 0:
        smooth = np.nonzero(roughness < 0.19)[0]  # these mirror the scene, not the sky alone
        _mirror(scene, surroundings, smooth, above, mirrored)

    straight_on = (1 - metalness) * material["reflectance"] + metalness * albedo
    away = 1 - cos_eye
    grazing = np.maximum(1 - roughness, straight_on) - straight_on
    fresnel = straight_on + grazing * (away * away * away * away * away)  # Schlick
    diffuse = (1 - metalness) * albedo * (1.2 / math.pi * key + ambient)
    return diffuse + fresnel * surroundings + fresnel * _highlight(normals, rays, roughness) * key


def _surface(scene: Scene, solid: Index, points: Array, rays: Array) -> tuple[Array, Array, Array]:
    """Points in their solids' frames (3, n), unit normals toward the eye (3, n), cosines to the eye (n,)."""
    to_local = scene.to_local[..., solid]
    local = apply(to_local[:, :3], points) + to_local[:, 3]
    normals = outward_normals(scene.kind[solid], scene.taper[:, solid], local)
    normals = unit(apply(np.swapaxes(to_local[:, :3], 0, 1), normals))  # normals go by the inverse transpose
    cos_eye = -dot(rays, normals)
    return local, np.where(cos_eye < 0, -normals, normals), np.abs(cos_eye)


def _mirror(scene: Scene, surroundings: Array, which: Index, origins: Array, directions: Array) -> None:
    origins, directions = origins[:, which], directions[:, which]
    t, met = nearest_hits(scene, origins, directions)
    hit = np.nonzero(met != NOTHING)[0]
    points = origins[:, hit] + t[hit] * directions[:, hit]
    surroundings[:, which[hit]] = radiance(scene, met[hit], points, directions[:, hit], bounces=0)


def _albedo(material: dict[str, Array], local: Array, world: Array) -> Array:
    """Base color (3, n) with its pattern."""
    weight = np.zeros(world.shape[1])
    for pattern in np.unique(material["pattern"]).tolist():
        which = np.nonzero(material["pattern"] == pattern)[0]
        frequency = material["frequency"][which]
        weight[which] = second_color_weight(pattern, world[:, which], local[:, which], frequency)
    return (1 - weight) * material["color"] + weight * material["second_color"]


def _highlight(normals: Array, rays: Array, roughness: Array) -> Array:
    """The key light's glint (n,): a GGX lobe around the half vector, without masking."""
    halfway = unit(KEY_DIRECTION[:, None] - rays)
    width = np.clip(roughness, 0.05, 1)
    alpha_square = width * width * width * width
    cosine = np.clip(dot(normals, halfway), 0, 1)
    spread = cosine * cosine * (alpha_square - 1) + 1
    return 0.25 * np.minimum(alpha_square / (math.pi * spread * spread), 60)


def _sky(directions: Array, blur: Array) -> Array:
    """Surroundings (3, n) in unit directions (3, n): ground, horizon, sky, two soft boxes; blur 0 to 1 (n,)."""
    height = directions[2]
    above = smooth_step(np.clip(0.5 + height / (0.12 + blur), 0, 1))
    color = (1 - above) * _GROUND + above * (_HORIZON + np.clip(height, 0, 1) * _TOWARD_ZENITH)
    edge = 0.02 + 0.35 * blur
    for toward, box_color, end in _SOFT_BOXES:
        inside = np.clip((dot(directions, toward) - end + edge) / edge, 0, 1) / (1 + 4 * blur)
        color = color + smooth_step(inside) * box_color
    return color
