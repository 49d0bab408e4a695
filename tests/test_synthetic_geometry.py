"""Synthetic scenes: rays meet the solids where they are."""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_se_sampler.data.synthetic.cameras import DISTANCE, Camera, framing, poses
from edge_se_sampler.data.synthetic.catalogue import SCENE_NAMES, synthetic_scene
from edge_se_sampler.data.synthetic.linear import invert, rotation, unit
from edge_se_sampler.data.synthetic.render import SAMPLES_PER_AXIS, render
from edge_se_sampler.data.synthetic.scene import BALL_RADIUS, Material, Scene, SceneBuilder
from edge_se_sampler.data.synthetic.solids import Kind, hit_distance, outward_normals
from edge_se_sampler.data.synthetic.visibility import KEY_DIRECTION, first_hits, in_shadow, nearest_hits

OFFSET = (0.2, -0.15)


def inside(kind: Kind, taper: np.ndarray, p: np.ndarray) -> np.ndarray:
    """The solids' definitions, as inequalities."""
    if kind == Kind.SPHERE:
        return (p**2).sum(axis=0) <= 1
    if kind == Kind.BOX:
        return np.abs(p).max(axis=0) <= 1
    return (np.hypot(p[0], p[1]) <= taper[0] + taper[1] * p[2]) & (np.abs(p[2]) <= 1)


SOLIDS = [
    pytest.param(Kind.SPHERE, (1.0, 0.0), id="sphere"),
    pytest.param(Kind.BOX, (1.0, 0.0), id="box"),
    pytest.param(Kind.FRUSTUM, (1.0, 0.0), id="cylinder"),
    pytest.param(Kind.FRUSTUM, (0.65, 0.35), id="cone widening"),
    pytest.param(Kind.FRUSTUM, (0.6, -0.4), id="cone narrowing"),
]


@pytest.mark.parametrize("start", ["outside", "inside"])
@pytest.mark.parametrize(("kind", "taper"), SOLIDS)
def test_hits_are_where_marching_finds_them(kind: Kind, taper: tuple[float, float], start: str) -> None:
    taper_array = np.array(taper)
    random = np.random.RandomState(1)
    rays = 400
    aim = random.uniform(-1.3, 1.3, (3, rays))
    origins = 3 * unit(random.randn(3, rays)) if start == "outside" else random.uniform(-0.1, 0.1, (3, rays))
    directions = aim - origins  # not of unit length: t is in lengths of the direction
    t = hit_distance(kind, taper_array, origins, directions, 1e-6)

    step = 2e-3
    steps = np.arange(1e-3, 4 if start == "outside" else 40, step if start == "outside" else 10 * step)
    within = inside(kind, taper_array, origins[:, :, None] + directions[:, :, None] * steps)
    crossed = within if start == "outside" else ~within
    marched = np.where(crossed.any(axis=1), steps[crossed.argmax(axis=1)], np.inf)

    met = np.isfinite(marched)
    assert met.sum() > 50
    assert np.isfinite(t[met]).all()
    slack = 1e-9
    assert (t[met] <= marched[met] + slack).all()
    late = met & (t < marched - (steps[1] - steps[0]) - slack)  # met earlier than marching noticed: a grazed edge
    for k in np.nonzero(late | (~met & np.isfinite(t)))[0]:
        chord = origins[:, [k]] + directions[:, [k]] * (t[k] + np.array([-1e-7, step]))
        assert not inside(kind, taper_array, chord).any() or start == "inside"
    assert late.sum() <= 4
    on = origins[:, np.isfinite(t)] + directions[:, np.isfinite(t)] * t[np.isfinite(t)]
    assert (inside(kind, taper_array, on * (1 - 1e-9)) & ~inside(kind, taper_array, on * (1 + 1e-9))).all()


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(("kind", "taper"), SOLIDS)
def test_rays_along_an_axis_hit(kind: Kind, taper: tuple[float, float], axis: int) -> None:
    origin = np.full(3, 0.1)
    origin[axis] = 5.0
    direction = np.zeros(3)
    direction[axis] = -2.0
    t = float(hit_distance(kind, np.array(taper), origin, direction, 1e-6))
    point = origin + t * direction
    assert inside(kind, np.array(taper), (point + 1e-9 * direction)[:, None]).all()
    assert not inside(kind, np.array(taper), (point - 1e-9 * direction)[:, None]).any()
    missing = np.full(3, 1.7)
    missing[axis] = 5.0
    assert np.isinf(hit_distance(kind, np.array(taper), missing, direction, 1e-6))


@pytest.mark.parametrize(("kind", "taper"), SOLIDS)
def test_normals_are_perpendicular_to_the_surface(kind: Kind, taper: tuple[float, float]) -> None:
    """Three neighbouring rays hit a small triangle; its normal is the surface's, but where it spans an edge."""
    random = np.random.RandomState(2)
    taper_array = np.array(taper)
    origins = 3 * unit(random.randn(3, 500))
    aim = random.uniform(-0.5, 0.5, (3, 500))
    corners = []
    for nudge in ((0, 0, 0), (1e-5, 0, 2e-5), (0, 1e-5, -1e-5)):
        directions = aim + np.array(nudge)[:, None] - origins
        corners.append(origins + hit_distance(kind, taper_array, origins, directions, 1e-6) * directions)
    hit = np.isfinite(corners[0] + corners[1] + corners[2]).all(axis=0)
    points = corners[0][:, hit]
    triangle = np.cross(corners[1][:, hit] - points, corners[2][:, hit] - points, axis=0)
    many = np.full(points.shape[1], int(kind))
    normals = unit(outward_normals(many, np.tile(taper_array[:, None], len(many)), points))
    alignment = np.abs((normals * unit(triangle)).sum(axis=0))
    assert hit.sum() > 300
    assert (alignment > 1 - 1e-4).mean() > 0.99
    assert (
        inside(kind, taper_array, points - 1e-6 * normals) & ~inside(kind, taper_array, points + 1e-6 * normals)
    ).all()


def brute_force(
    scene: Scene, origins: np.ndarray, directions: np.ndarray, beyond: float
) -> tuple[np.ndarray, np.ndarray]:
    """Every solid against every ray, without bounds."""
    nearest = np.full(origins.shape[1], np.inf)
    met = np.full(origins.shape[1], -1)
    for solid in range(len(scene.kind)):
        m = scene.to_local[..., solid]
        local_origins, local_directions = m[:, :3] @ origins + m[:, 3:], m[:, :3] @ directions
        t = hit_distance(scene.kind[solid], scene.taper[:, solid], local_origins, local_directions, beyond)
        met[t < nearest] = solid
        nearest = np.minimum(nearest, t)
    return nearest, met


def assert_first_hits_are_brute_force(scene: Scene, camera: Camera) -> np.ndarray:
    """Returns points (3, n) a hair before those seen."""
    depth, seen = first_hits(scene, camera, 1)
    x, y = np.meshgrid(*camera.sample_slopes(1))
    rays = camera.to_world[:3, :3] @ np.stack([x.ravel(), y.ravel(), -np.ones(x.size)])
    eyes = np.repeat(camera.to_world[:3, 3:4], x.size, axis=1)
    t, met = brute_force(scene, eyes, rays, 1e-6)
    np.testing.assert_array_equal(seen.ravel(), met)
    np.testing.assert_allclose(depth.ravel(), t, rtol=1e-9)
    hit = np.nonzero(met >= 0)[0]
    return eyes[:, hit] + (t[hit] - 1e-3) * rays[:, hit]


@pytest.mark.parametrize("name", SCENE_NAMES)
def test_bounding_boxes_change_no_result(name: str) -> None:
    scene = synthetic_scene(name)
    camera = framing(40, "rotated", OFFSET).camera(poses("train", 5)[4])
    points = assert_first_hits_are_brute_force(scene, camera)[:, :200]
    toward_light = np.repeat(KEY_DIRECTION[:, None], points.shape[1], axis=1)
    dark = np.isfinite(brute_force(scene, points, toward_light, 1e-5)[0])
    np.testing.assert_array_equal(in_shadow(scene, points), dark)
    assert 0 < dark.sum() < points.shape[1]

    bounced = unit(np.random.RandomState(3).randn(3, points.shape[1]))
    t, met = brute_force(scene, points, bounced, 1e-5)
    nearest, solid = nearest_hits(scene, points, bounced)
    np.testing.assert_array_equal(solid, met)
    np.testing.assert_allclose(nearest, t, rtol=1e-9)


@pytest.mark.parametrize("name", SCENE_NAMES)
def test_the_whole_scene_is_in_the_ball(name: str) -> None:
    scene = synthetic_scene(name)
    angle = np.linspace(0, 2 * np.pi, 33)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    height = np.linspace(-1, 1, 17)
    globe = np.stack([np.outer(np.sqrt(1 - height**2), circle[k]).ravel() for k in (0, 1)] + [np.repeat(height, 33)])
    cube = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8)
    farthest = 0.0
    for solid, kind in enumerate(scene.kind):
        a, b = scene.taper[:, solid]
        rims = np.concatenate([np.vstack([(a + z * b) * circle, np.full(33, z)]) for z in (-1, 1)], axis=1)
        local = {Kind.SPHERE: globe, Kind.BOX: cube, Kind.FRUSTUM: rims}[Kind(kind)]
        m = scene.to_world[..., solid]
        farthest = max(farthest, np.linalg.norm(m[:, :3] @ local + m[:, 3:], axis=0).max())
    assert 0.97 * BALL_RADIUS < farthest <= BALL_RADIUS <= 1.3


def test_alpha_of_a_ball_is_its_silhouette() -> None:
    builder = SceneBuilder()
    builder.sphere((3.0, -2.0, 5.0), 0.7, Material((0.5, 0.5, 0.5)))  # built anywhere, moved to the origin
    scene = builder.build()
    camera = framing(64, "shifted", (0.1, 0.05)).camera(poses("val", 3)[2])
    picture = render(scene, camera)
    alpha = picture[..., 3]

    spread = (np.arange(SAMPLES_PER_AXIS) + 0.5) / SAMPLES_PER_AXIS
    samples = (np.arange(64)[:, None] + spread).ravel()
    from_center = np.hypot(*np.meshgrid(samples - camera.principal[0], samples - camera.principal[1]))
    cone = math.tan(math.asin(BALL_RADIUS / DISTANCE))  # the camera looks at the ball's center: a circle
    seen = from_center / camera.focal < cone
    covered = seen.reshape(64, SAMPLES_PER_AXIS, 64, SAMPLES_PER_AXIS).mean(axis=(1, 3))
    np.testing.assert_array_equal(alpha, np.rint(255 * covered))
    assert alpha.sum() / 255 == pytest.approx(math.pi * (camera.focal * cone) ** 2, rel=0.01)
    faint = (alpha > 0) & (alpha < 64)  # straight alpha: a pixel barely touched is as bright as its neighbours
    assert faint.sum() > 5
    assert picture[faint, :3].min() >= 0.75 * picture[alpha == 255, :3].min()


def test_invert_inverts_affine_maps() -> None:
    m = np.random.RandomState(4).randn(3, 4, 20)
    square = np.zeros((20, 4, 4))
    square[:, 3, 3] = 1
    square[:, :3] = np.moveaxis(m, -1, 0)
    np.testing.assert_allclose(np.moveaxis(invert(m), -1, 0), np.linalg.inv(square)[:, :3], rtol=1e-9)


def test_rotation_is_right_handed() -> None:
    np.testing.assert_allclose(rotation((0, 0, 5), 90) @ (1, 0, 0), (0, 1, 0), atol=1e-15)
    matrix = rotation((1, -2, 0.5), 73)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(matrix) == pytest.approx(1)
    assert np.trace(matrix) == pytest.approx(1 + 2 * math.cos(math.radians(73)))


def test_a_solid_behind_the_camera_is_not_seen() -> None:
    pose = poses("train", 1)[0].copy()
    pose[:3, :3] = pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])  # looks the other way
    assert not render(synthetic_scene("hotdog"), Camera(pose, 40.0, (16.0, 16.0), 32, 32)).any()


def test_a_camera_amid_the_scene_sees_what_is_around_it() -> None:
    scene = synthetic_scene("hotdog")
    pose = poses("train", 1)[0].copy()
    pose[:3, 3] = (0.0, 0.1, 0.3)
    camera = Camera(pose, 12.0, (16.0, 16.0), 32, 32)
    assert_first_hits_are_brute_force(scene, camera)
