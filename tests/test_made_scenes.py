"""Made scenes: the same pixels everywhere, exact geometry, honest folders, nothing left behind."""

from __future__ import annotations

import hashlib
import importlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest

from edge_se_sampler.data.made import ANALOG_OF, SCENE_NAMES, make_scenes, render_view
from edge_se_sampler.data.made.cameras import DISTANCE, FIELD_OF_VIEW, Camera, Placement, Split, framing, poses
from edge_se_sampler.data.made.catalogue import made_scene
from edge_se_sampler.data.made.linear import inverse_affine, rotation, unit
from edge_se_sampler.data.made.render import SAMPLES_PER_AXIS, render
from edge_se_sampler.data.made.scene import BALL_RADIUS, Material, Scene, SceneBuilder
from edge_se_sampler.data.made.shading import radiance
from edge_se_sampler.data.made.solids import Kind, hit_distance, outward_normals
from edge_se_sampler.data.made.visibility import KEY_DIRECTION, first_hits, in_shadow, nearest_hits
from edge_se_sampler.errors import InputError

SPLITS: tuple[Split, ...] = ("train", "val", "test")
OFFSET = (0.2, -0.15)

# sha256 of the pixels of one 32 x 32 view. A change here changes every made picture that anyone has.
PIXELS = {
    "chair": "058f25527133d9a9ea63d6b54c17df324fa094bdbeb5f6845821e6aff463569c",
    "drums": "12828348bfba12172c76484d6895f4eba8d55954431ec4607f68f10bb5609266",
    "ficus": "4027c89f2c08b21fc9ffcb5b6ee78e8bdc206fd20d707c2ac8be4d568997c40b",
    "hotdog": "c6865cb543faad8d90a672f414c0a6fa2a427688d63ac1ce7f34ca4279169542",
    "bricks": "ad826fcf3a00a2a50ee8afb627fed9fe738759e87ec9268e224f70da1460154e",
    "materials": "3939db3f5dd28672dfb44809fe1d536f360cba8ff6ec6ffcdae7b8d497136b68",
    "mic": "80534b94aac43544718fd541f39d6bebcd7c30638cce24ad6cc639010a8f41af",
}


def digest(*arrays: np.ndarray) -> str:
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()


def small_picture(name: str) -> np.ndarray:
    return render(made_scene(name), framing(32).camera(poses("train", 1)[0]))


def float_digest(name: str) -> str:
    """Of every float64 on the way to the pixels: an eighth bit hides most differences, these bits hide none."""
    scene = made_scene(name)
    camera = framing(48).camera(poses("val", 2)[1])
    depth, seen = first_hits(scene, camera, 1)
    rows, columns = np.nonzero(seen >= 0)
    x, y = camera.sample_slopes(1)
    turn = camera.to_world[:3, :3]
    rays = turn[:, 0, None] * x[columns] + turn[:, 1, None] * y[rows] - turn[:, 2, None]
    points = camera.to_world[:3, 3:4] + depth[rows, columns] * rays
    light = radiance(scene, seen[rows, columns], points, unit(rays))
    return digest(camera.to_world, scene.to_world, scene.to_local, depth, seen, light)


def everything_below(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*"))
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b"" for path in files}


# ---------------------------------------------------------------------------------------------- the same pixels


@pytest.mark.parametrize("name", SCENE_NAMES)
def test_pixels_are_the_committed_ones(name: str) -> None:
    assert digest(small_picture(name)) == PIXELS[name]


def test_pixels_do_not_depend_on_the_cpu() -> None:
    core = importlib.import_module("numpy._core" if hasattr(np, "_core") else "numpy.core")
    umath = core._multiarray_umath
    extras = [feature for feature in umath.__cpu_dispatch__ if umath.__cpu_features__[feature]]
    if not extras:
        pytest.skip("this CPU has nothing to switch off")
    report = (
        "import sys, json, tests.test_made_scenes as t\n"
        "umath = t.importlib.import_module(sys.argv[1])._multiarray_umath\n"
        "on = [f for f in umath.__cpu_dispatch__ if umath.__cpu_features__[f]]\n"
        "print(json.dumps([on, {n: [t.digest(t.small_picture(n)), t.float_digest(n)] for n in t.SCENE_NAMES}]))\n"
    )
    environment = {**os.environ, "NPY_DISABLE_CPU_FEATURES": " ".join(extras)}
    command = [sys.executable, "-W", "ignore", "-c", report, core.__name__]
    root = Path(__file__).parent.parent
    done = subprocess.run(command, env=environment, cwd=root, capture_output=True, text=True, check=True)
    still_on, without = json.loads(done.stdout)
    assert still_on == []
    assert without == {name: [PIXELS[name], float_digest(name)] for name in SCENE_NAMES}


def test_importing_needs_no_torch() -> None:
    code = "import sys, edge_se_sampler.data.made; print({'torch', 'cv2', 'matplotlib'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


# ---------------------------------------------------------------------------------------------- geometry


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
def test_normals_are_square_to_the_surface(kind: Kind, taper: tuple[float, float]) -> None:
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
def test_bounds_change_no_answer(name: str) -> None:
    scene = made_scene(name)
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
    scene = made_scene(name)
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
    builder.sphere((3.0, -2.0, 5.0), 0.7, Material((0.5, 0.5, 0.5)))  # built in any place, moved to the origin
    scene = builder.build()
    camera = framing(64, "shifted", (0.1, 0.05)).camera(poses("val", 3)[2])
    picture = render(scene, camera)
    alpha = picture[..., 3]

    spread = (np.arange(SAMPLES_PER_AXIS) + 0.5) / SAMPLES_PER_AXIS
    samples = (np.arange(64)[:, None] + spread).ravel()
    from_center = np.hypot(*np.meshgrid(samples - camera.principal[0], samples - camera.principal[1]))
    cone = math.tan(math.asin(BALL_RADIUS / DISTANCE))  # the camera looks at the ball's centre: a circle
    seen = from_center / camera.focal < cone
    share = seen.reshape(64, SAMPLES_PER_AXIS, 64, SAMPLES_PER_AXIS).mean(axis=(1, 3))
    np.testing.assert_array_equal(alpha, np.rint(255 * share))
    assert alpha.sum() / 255 == pytest.approx(math.pi * (camera.focal * cone) ** 2, rel=0.01)
    faint = (alpha > 0) & (alpha < 64)  # straight alpha: a pixel barely touched is as bright as its neighbours
    assert faint.sum() > 5
    assert picture[faint, :3].min() >= 0.75 * picture[alpha == 255, :3].min()


def test_inverse_affine_inverts() -> None:
    m = np.random.RandomState(4).randn(3, 4, 20)
    square = np.zeros((20, 4, 4))
    square[:, 3, 3] = 1
    square[:, :3] = np.moveaxis(m, -1, 0)
    np.testing.assert_allclose(np.moveaxis(inverse_affine(m), -1, 0), np.linalg.inv(square)[:, :3], rtol=1e-9)


def test_rotation_is_right_handed() -> None:
    np.testing.assert_allclose(rotation((0, 0, 5), 90) @ (1, 0, 0), (0, 1, 0), atol=1e-15)
    turn = rotation((1, -2, 0.5), 73)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(turn) == pytest.approx(1)
    assert np.trace(turn) == pytest.approx(1 + 2 * math.cos(math.radians(73)))


# ---------------------------------------------------------------------------------------------- cameras


@pytest.mark.parametrize("split", SPLITS)
def test_view_i_does_not_depend_on_how_many(split: Split) -> None:
    many = poses(split, 23, seed=5)
    for count in (0, 1, 4, 22):
        np.testing.assert_array_equal(poses(split, count, seed=5), many[:count])


def test_seed_moves_train_and_val_but_not_test() -> None:
    for split in ("train", "val"):
        assert not np.array_equal(poses(split, 3, seed=0), poses(split, 3, seed=1))
    np.testing.assert_array_equal(poses("test", 3, seed=0), poses("test", 3, seed=1))
    views = [pose.tobytes() for split in SPLITS for seed in (0, 1, 2**31 - 1) for pose in poses(split, 5, seed)]
    assert len(set(views)) == 5 * (3 + 3 + 1)


@pytest.mark.parametrize("split", SPLITS)
def test_cameras_look_at_the_origin_from_the_upper_hemisphere(split: Split) -> None:
    for pose in poses(split, 40):
        turn, eye = pose[:3, :3], pose[:3, 3]
        assert np.linalg.norm(eye) == pytest.approx(DISTANCE, abs=1e-9)
        np.testing.assert_allclose(turn[:, 2], eye / DISTANCE, atol=1e-9)  # back; the camera looks along -z
        np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-9)
        assert np.linalg.det(turn) == pytest.approx(1)
        assert turn[2, 0] == 0  # the horizon is level
        assert turn[2, 1] > 0  # and the right way up
        assert eye[2] > 0


def test_train_cameras_are_uniform_in_area() -> None:
    eyes = np.array(poses("train", 4000))[:, :3, 3] / DISTANCE
    height = np.sort((eyes[:, 2] - 0.02) / 0.96)
    azimuth = np.sort(np.arctan2(eyes[:, 1], eyes[:, 0]) / (2 * np.pi) % 1)
    ideal = (np.arange(4000) + 0.5) / 4000
    for values in (height, azimuth):  # Kolmogorov's distance; 2.7 / sqrt(n) is exceeded once in a million
        assert np.abs(values - ideal).max() < 2.7 / math.sqrt(4000)


def test_test_cameras_are_spread() -> None:
    for count in (5, 10, 33):
        eyes = np.array(poses("test", count))[:, :3, 3]
        azimuth = np.sort(np.arctan2(eyes[:, 1], eyes[:, 0])) / (2 * np.pi)
        gaps = np.diff(np.append(azimuth, azimuth[0] + 1))
        assert gaps.max() < 2 / count + 1e-9
        elevation = np.degrees(np.arcsin(eyes[:, 2] / DISTANCE))
        assert elevation.min() >= 15
        assert elevation.max() <= 45
        assert np.ptp(elevation) > 10


@pytest.mark.parametrize("name", SCENE_NAMES)
def test_shifted_is_the_centred_picture_pasted(name: str) -> None:
    scene = made_scene(name)
    pose = poses("train", 2)[1]
    size, dx, dy, frame = 40, 8, -6, 24
    pasted = np.zeros((size, size, 4), dtype=np.uint8)
    top, left = (size - frame) // 2 + dy, (size - frame) // 2 + dx
    pasted[top : top + frame, left : left + frame] = render(scene, framing(frame).camera(pose))
    shifted = render(scene, framing(size, "shifted", OFFSET).camera(pose))
    np.testing.assert_array_equal(shifted, pasted)
    assert (shifted[..., 3] > 0).any()


@pytest.mark.parametrize("size", [40, 41, 100])
def test_rotated_shows_the_origin_where_shifted_does(size: int) -> None:
    shifted, rotated = framing(size, "shifted", OFFSET), framing(size, "rotated", OFFSET)
    assert shifted.focal == rotated.focal
    assert rotated.principal == (size / 2, size / 2)
    assert shifted.principal == (size / 2 + round(0.2 * size), size / 2 + round(-0.15 * size))
    for pose in poses("train", 8):
        camera = rotated.camera(pose)
        x, y, z = np.linalg.inv(camera.to_world)[:3, 3]  # the origin, in the camera's frame
        seen_at = (size / 2 - camera.focal * x / z, size / 2 + camera.focal * y / z)
        assert seen_at == pytest.approx(shifted.principal, abs=1e-8)
        np.testing.assert_array_equal(camera.to_world[:3, 3], pose[:3, 3])
        turn = camera.to_world[:3, :3]
        np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-11)
        assert np.linalg.det(turn) == pytest.approx(1)
        angle = math.acos((np.trace(turn.T @ pose[:3, :3]) - 1) / 2)  # no more than the tilt: no roll
        assert angle == pytest.approx(math.acos(-z / DISTANCE), abs=1e-6)


@pytest.mark.parametrize("name", SCENE_NAMES)
def test_default_offset_clips_nothing_when_rotated(name: str) -> None:
    frame = framing(100, "rotated", (0.2, 0.15))
    for pose in (*poses("train", 2), poses("test", 1)[0]):
        alpha = render(made_scene(name), frame.camera(pose))[..., 3]
        border = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
        assert alpha.any()
        assert not border.any()


def test_default_offset_holds_the_whole_ball_when_rotated() -> None:
    frame = framing(100, "rotated", (0.2, 0.15))
    camera = frame.camera(poses("train", 1)[0])
    builder = SceneBuilder()
    builder.sphere((0, 0, 0), 1, Material((0.5, 0.5, 0.5)))
    alpha = render(builder.build(), camera)[..., 3]
    assert not np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]]).any()


def test_a_solid_behind_the_camera_is_not_seen() -> None:
    pose = poses("train", 1)[0].copy()
    pose[:3, :3] = pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])  # turned about
    assert not render_view("hotdog", pose, 40.0, (16.0, 16.0), 32, 32).any()


def test_a_camera_amid_the_scene_sees_what_is_around_it() -> None:
    scene = made_scene("hotdog")
    pose = poses("train", 1)[0].copy()
    pose[:3, 3] = (0.0, 0.1, 0.3)
    camera = Camera(pose, 12.0, (16.0, 16.0), 32, 32)
    assert_first_hits_are_brute_force(scene, camera)


# ---------------------------------------------------------------------------------------------- folders


@pytest.mark.parametrize("placement", ["centered", "shifted", "rotated"])
def test_folder_tells_the_truth(placement: Placement, tmp_path: Path) -> None:
    """Every picture is what its json says, read as any loader of Blender scenes reads it."""
    size = 24
    made = make_scenes(
        tmp_path, ["bricks"], size=size, num_train=2, num_val=0, num_test=1, placement=placement, offset=OFFSET, seed=3
    )
    assert made == [tmp_path / "bricks"]
    assert sorted(everything_below(tmp_path)) == [
        "bricks",
        "bricks/test",
        "bricks/test/r_0.png",
        "bricks/train",
        "bricks/train/r_0.png",
        "bricks/train/r_1.png",
        *(f"bricks/transforms_{split}.json" for split in ("test", "train", "val")),
        "bricks/val",
    ]
    for split, count in (("train", 2), ("val", 0), ("test", 1)):
        document = json.loads((tmp_path / "bricks" / f"transforms_{split}.json").read_text())
        assert document["analog_of"] == "lego"
        assert document["made_by"] == "edge_se_sampler"
        assert ("cx" in document, "cy" in document) == (placement == "shifted",) * 2
        assert (document["camera_angle_x"] == FIELD_OF_VIEW) == (placement == "centered")
        assert [frame["file_path"] for frame in document["frames"]] == [f"./{split}/r_{i}" for i in range(count)]
        for frame in document["frames"]:
            picture = imageio.imread(tmp_path / "bricks" / f"{frame['file_path']}.png")
            pose = np.array(frame["transform_matrix"])
            assert isinstance(frame["rotation"], float)
            assert pose.shape == (4, 4)
            assert (picture.shape, picture.dtype) == ((size, size, 4), np.uint8)
            focal = 0.5 * size / math.tan(0.5 * document["camera_angle_x"])
            principal = (document.get("cx", size / 2), document.get("cy", size / 2))
            np.testing.assert_array_equal(picture, render_view("bricks", pose, focal, principal, size, size))
            assert picture[..., 3].max() == 255
            assert not picture[picture[..., 3] == 0].any()


def test_processes_make_the_same_pictures(tmp_path: Path) -> None:
    """Six views and more go to other processes."""
    heard: list[tuple[int, int]] = []
    make_scenes(
        tmp_path / "new" / "out",
        ["mic", "chair"],
        size=16,
        num_train=3,
        num_val=1,
        num_test=2,
        progress=lambda done, total: heard.append((done, total)),
    )
    assert sorted(path.name for path in (tmp_path / "new" / "out").iterdir()) == ["chair", "mic"]
    assert heard[-1] == (12, 12)
    assert [done for done, _ in heard] == sorted({done for done, _ in heard})
    assert len(heard) < 12
    for name in ("mic", "chair"):
        assert (
            json.loads((tmp_path / f"new/out/{name}/transforms_val.json").read_text())["analog_of"] == ANALOG_OF[name]
        )
        for split, count in zip(SPLITS, (3, 1, 2), strict=True):
            for index, pose in enumerate(poses(split, count)):
                picture = imageio.imread(tmp_path / f"new/out/{name}/{split}/r_{index}.png")
                np.testing.assert_array_equal(picture, render(made_scene(name), framing(16).camera(pose)))


BAD_ARGUMENTS = [
    pytest.param({"names": ["lego"]}, "'lego'.*mean 'bricks'", id="NeRF's name"),
    pytest.param({"names": ["mic", "chiar"]}, "'chiar'.*mean 'chair'", id="typo"),
    pytest.param({"names": []}, "names is empty", id="no name"),
    pytest.param({"names": ["mic", "mic"]}, "names.*twice", id="twice"),
    pytest.param({"size": 7}, "size is 7.*at least 8", id="size"),
    pytest.param({"num_train": 0}, "num_train is 0.*at least 1", id="no train"),
    pytest.param({"num_val": -1}, "num_val is -1.*at least 0", id="negative val"),
    pytest.param({"num_test": -2}, "num_test is -2.*at least 0", id="negative test"),
    pytest.param({"seed": -1}, "seed is -1", id="negative seed"),
    pytest.param({"seed": 2**31}, "seed is 2147483648", id="large seed"),
    pytest.param({"placement": "centred"}, "placement is 'centred'.*centered", id="placement"),
    pytest.param({"placement": "shifted", "offset": (0.4, 0)}, "offset.*4 pixels.*8", id="offset"),
    pytest.param({"placement": "rotated", "offset": (0, -0.6)}, "offset.*0 pixels.*8", id="offset off the image"),
    pytest.param({"placement": "shifted", "offset": (math.nan, 0)}, "offset.*finite", id="offset nan"),
    pytest.param(
        {"names": ["hotdog"], "placement": "rotated", "offset": (0.3, 0.3)},
        "offset turns hotdog out.*train/r_0",
        id="clipped",
    ),
]


@pytest.mark.parametrize(("arguments", "message"), BAD_ARGUMENTS)
def test_refusals_leave_nothing_behind(arguments: dict, message: str, tmp_path: Path) -> None:
    good = {"names": ["mic"], "size": 20, "num_train": 1, "num_val": 0, "num_test": 0}
    with pytest.raises(InputError, match=message) as refusal:
        make_scenes(tmp_path / "deep" / "out", **{**good, **arguments})
    assert "\n" not in str(refusal.value)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_scene_is_never_touched(tmp_path: Path) -> None:
    (tmp_path / "mic").mkdir()
    (tmp_path / "mic" / "mine.txt").write_text("mine")
    before = everything_below(tmp_path)
    with pytest.raises(InputError, match="mic is there already"):
        make_scenes(tmp_path, ["chair", "mic"], size=8, num_train=1, num_val=0, num_test=0)
    assert everything_below(tmp_path) == before
    make_scenes(tmp_path, ["chair"], size=8, num_train=1, num_val=0, num_test=0)
    assert before.items() < everything_below(tmp_path).items()


def test_an_empty_folder_is_filled(tmp_path: Path) -> None:
    (tmp_path / "mic").mkdir()
    make_scenes(tmp_path, ["mic"], size=8, num_train=1, num_val=0, num_test=0)
    assert (tmp_path / "mic" / "train" / "r_0.png").is_file()


def test_a_folder_filled_meanwhile_is_never_touched(tmp_path: Path) -> None:
    (tmp_path / "mic").mkdir()

    def intrude(done: int, total: int) -> None:
        (tmp_path / "mic" / "mine.txt").write_text("mine")

    with pytest.raises(OSError):
        make_scenes(tmp_path, ["mic"], size=8, num_train=1, num_val=0, num_test=0, progress=intrude)
    assert everything_below(tmp_path) == {"mic": b"", "mic/mine.txt": b"mine"}


@pytest.mark.parametrize("out", ["file", "file/below"])
def test_out_that_is_a_file(out: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match=r"out is .*file.* not a folder"):
        make_scenes(tmp_path / out, ["mic"], size=8, num_train=1, num_val=0, num_test=0)
    assert everything_below(tmp_path) == {"file": b"mine"}


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="everything is writable to root")
def test_out_that_is_not_writable(tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    with pytest.raises(InputError, match="not writable"):
        make_scenes(tmp_path / "locked" / "out", ["mic"], size=8, num_train=1, num_val=0, num_test=0)


@pytest.mark.parametrize(
    ("num_train", "error"),
    [pytest.param(2, RuntimeError, id="here"), pytest.param(12, KeyboardInterrupt, id="in processes")],
)
def test_a_failure_leaves_nothing_behind(num_train: int, error: type[BaseException], tmp_path: Path) -> None:
    def fail(done: int, total: int) -> None:
        assert list((tmp_path / "deep" / "out").glob(".making-*/mic/train/*.png"))  # work was under way
        raise error

    with pytest.raises(error):
        make_scenes(
            tmp_path / "deep" / "out", ["mic"], size=8, num_train=num_train, num_val=0, num_test=0, progress=fail
        )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name == "nt", reason="no process groups to interrupt")
@pytest.mark.parametrize("moment", ["workers starting", "workers at work"])
def test_ctrl_c_stops_quietly(moment: str, tmp_path: Path) -> None:
    """A terminal's Ctrl-C reaches every process of the group; only the first may answer."""
    script = tmp_path / "script.py"
    script.write_text(
        "from pathlib import Path\n"
        "from edge_se_sampler.data.made import make_scenes\n"
        "if __name__ == '__main__':\n"
        "    try:\n"
        f"        make_scenes(Path({str(tmp_path / 'out')!r}), ['mic', 'ficus'], num_train=500,\n"
        "                    progress=lambda done, total: print(done, flush=True))\n"
        "    except KeyboardInterrupt:\n"
        "        print('stopped')\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)}
    with subprocess.Popen(
        [sys.executable, str(script)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        if moment == "workers at work":
            assert process.stdout.readline() == "5\n"
        else:
            while not list(tmp_path.glob("out/.making-*/ficus/*test.json")):  # the last thing before they are started
                assert process.poll() is None
                time.sleep(0.01)
            time.sleep(0.15)
        os.killpg(process.pid, signal.SIGINT)
        said, complained = process.communicate(timeout=20)
    assert said.splitlines()[-1] == "stopped"
    assert complained == ""
    assert process.returncode == 0
    assert [path.name for path in tmp_path.iterdir()] == ["script.py"]
