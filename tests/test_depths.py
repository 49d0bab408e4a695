"""Near and far from the scene: points, silhouettes, cameras; flags and NeRF's own scenes insist."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from capture_folder import write_blender, write_colmap
from tiny import ball_views

from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.dataset import read_split
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.config import TrainerConfig, override
from edge_se_sampler.engine.pipeline import resolve_depths
from edge_se_sampler.engine.session import resolve_config
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models.config import LeanModelConfig
from edge_se_sampler.occupancy.depths import NEAR_SHARE, find_depths
from edge_se_sampler.occupancy.hull import find_box, find_focus
from edge_se_sampler.occupancy.scene_analysis import analyze_scene


def moved(views: Views, scale: float, shift: tuple[float, float, float]) -> Views:
    """The same images of a scene of another unit and origin, whose format says nothing of depths."""
    poses = views.cameras.camera_to_worlds.numpy().copy()
    poses[:, :, 3] = scale * poses[:, :, 3] + shift
    c = views.cameras
    cameras = Cameras.of(
        poses, fx=c.fx[:, 0], fy=c.fy[:, 0], cx=c.cx[:, 0], cy=c.cy[:, 0], width=c.width[:, 0], height=c.height[:, 0]
    )
    return replace(views, cameras=cameras, depths=None)


def lean_model(config: TrainerConfig) -> LeanModelConfig:
    assert isinstance(config.pipeline.model, LeanModelConfig)
    return config.pipeline.model


def opaque(views: Views) -> Views:
    return replace(views, images=tuple(image[..., :3] for image in views.images))


@pytest.mark.parametrize("scale", [1.0, 0.01, 300.0])
def test_silhouettes_of_a_ball(scale: float) -> None:
    """The ball of radius 1, 4 away, in whatever units: nothing of it is cut off, and little is added."""
    found = find_depths(moved(ball_views(16, 64), scale, (5.0, -70.0, 2.0)))
    assert (found.source, found.near_share) == ("the silhouettes", 0)
    assert 2.4 < found.near / scale <= 3
    assert 5 <= found.far / scale < 5.6


def test_what_few_cameras_see_does_not_count() -> None:
    """Of twelve views one looks the other way, from far off: alone it carves nothing."""
    views = moved(ball_views(12, 32), 1.0, (0.0, 0.0, 0.0))
    poses = views.cameras.camera_to_worlds.clone()
    poses[0, :, 3] *= 2.5
    found = find_depths(replace(views, cameras=replace(views.cameras, camera_to_worlds=poses)))
    assert 2.2 < found.near <= 3
    assert found.far < 4 * 2.5 + 1.7  # where that camera sees the ball


@pytest.mark.parametrize("has_alpha", [True, False])
def test_a_wrong_pose_far_away_does_not_move_the_scene(has_alpha: bool) -> None:
    views = moved(ball_views(12, 32), 1.0, (5.0, 0.0, 1.0))
    views = views if has_alpha else opaque(views)
    poses = views.cameras.camera_to_worlds.clone()
    poses[3, :, 3] += 100
    wrong = replace(views, cameras=replace(views.cameras, camera_to_worlds=poses))
    others = views.subset([i for i in range(12) if i != 3])
    depths = find_depths(wrong)
    assert depths == find_depths(others)
    box, other_box = (find_box(some, depths.near, depths.far) for some in (wrong, others))
    np.testing.assert_array_equal(box.center, other_box.center)
    assert (box.half_extent, box.pixel_footprint) == (other_box.half_extent, other_box.pixel_footprint)
    found, expected = (
        analyze_scene(some, depths.near, depths.far, voxel_size_px=1.0, by_alpha=True, near_share=depths.near_share)
        for some in (wrong, others)
    )
    np.testing.assert_array_equal(found.focus, expected.focus)
    assert found.hull.cell_size == expected.hull.cell_size
    np.testing.assert_array_equal(found.hull.cells, expected.hull.cells)
    assert found.num_silhouettes == (11 if has_alpha else 0)
    assert found.is_carved_close == has_alpha
    assert len(found.hit_pixels) == 12
    assert wrong.subset([0, 1, 2, 3]).leave_out_far().names == wrong.names[:4]  # of four, none is like most


def test_what_masks_leave_out_does_not_count_as_missed_by_the_hull() -> None:
    """A stand that two views show, and their masks hide."""
    views = ball_views(12, 64)
    masks = [np.ones((64, 64), bool) for _ in views.images]
    for i in (0, 1):
        views.images[i][:6] = 255
        masks[i][:6] = False
    hidden = analyze_scene(views.with_masks(masks), 2.5, 5.5, voxel_size_px=0.25, by_alpha=True)
    shown = analyze_scene(views, 2.5, 5.5, voxel_size_px=0.25, by_alpha=True)
    assert (hidden.num_silhouettes, shown.num_silhouettes) == (12, 0)


def test_points_decide_but_for_stray_ones() -> None:
    views = opaque(moved(ball_views(12, 32), 1.0, (0.0, 0.0, 0.0)))
    rng = np.random.default_rng(0)
    surface = rng.normal(size=(1000, 3))
    surface /= np.linalg.norm(surface, axis=1, keepdims=True)
    surface[:2] = (1e4, 0, 0), (0, -1e4, 0)
    found = find_depths(replace(views, points=(surface,) * 12))
    assert found.source == "the points of the reconstruction"
    assert 2.6 < found.near <= 3
    assert 5 <= found.far < 5.6
    assert found.near_share == pytest.approx(0.9 * 3 / 4, rel=0.02)
    close = find_depths(replace(views, points=(surface * 2.8,) * 12))
    assert close.near_share == pytest.approx(0.9 * (4 - 2.8) / 4, rel=0.05)


def test_cameras_alone() -> None:
    found = find_depths(opaque(moved(ball_views(12, 32), 10.0, (1.0, 2.0, 3.0))))
    assert (found.near, found.far) == pytest.approx((12, 80), rel=1e-3)
    assert "cameras" in found.source
    assert found.near_share == NEAR_SHARE


def test_a_single_camera_tells_nothing() -> None:
    view = opaque(moved(ball_views(12, 32), 10.0, (0.0, 0.0, 0.0))).subset([0])
    config = method_configs()["lean-nerf"]
    with pytest.raises(InputError, match=r"give --pipeline\.model\.near"):
        resolve_config(config, view)
    given = override(config, {"pipeline.model.near": 10.0, "pipeline.model.far": 60.0})
    model = lean_model(resolve_config(given, view))
    assert (model.depths, model.near_share) == ((10, 60), None)


@pytest.mark.parametrize("radius", [0.0, 1e-12, 1e-3])
@pytest.mark.parametrize("seed", range(6))
def test_cameras_that_turn_about_one_point_tell_nothing(seed: int, radius: float) -> None:
    """Their axes meet where they are, but for rounding."""
    views = opaque(ball_views(12, 32))
    rng = np.random.default_rng(seed)
    poses = views.cameras.camera_to_worlds.clone()
    poses[:, :, :3] = torch.from_numpy(np.linalg.qr(rng.normal(size=(12, 3, 3)))[0])
    poses[:, :, 3] = torch.from_numpy(rng.normal(size=3) + radius * rng.normal(size=(12, 3)))
    turning = replace(views, cameras=replace(views.cameras, camera_to_worlds=poses), depths=None)
    with pytest.raises(InputError, match=r"give --pipeline\.model\.near"):
        find_depths(turning)


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (-8.0, 0.0, 0.0), (-60.0, 3.0, 40.0)])
@pytest.mark.parametrize("show", [opaque, lambda views: views])
def test_nothing_is_told_by_where_the_origin_is(
    shift: tuple[float, float, float], show: Callable[[Views], Views]
) -> None:
    """Of one optical axis, and of parallel ones, no point is nearest to all of them."""
    ball = ball_views(6, 32)
    poses = ball.cameras.camera_to_worlds[:1].repeat(6, 1, 1)
    poses[:, :, 3] += torch.linspace(-0.2, 0.2, 6)[:, None] * poses[:, :, 0]
    parallel = replace(
        ball, images=ball.images[:1] * 6, cameras=replace(ball.cameras, camera_to_worlds=poses.contiguous())
    )
    for views in (ball.subset([0]), parallel):
        with pytest.raises(InputError, match=r"give --pipeline\.model\.near"):
            find_depths(show(moved(views, 1.0, shift)))


def test_rays_begin_before_all_points_even_of_cameras_that_look_past_what_they_surround() -> None:
    views = opaque(moved(ball_views(24, 32), 1.0, (0.0, 0.0, 0.0)))
    turn = torch.tensor([[0.82, 0.0, -0.57], [0.0, 1.0, 0.0], [0.57, 0.0, 0.82]], dtype=torch.float64)  # 35 degrees
    poses = views.cameras.camera_to_worlds.clone()
    poses[:, :, :3] = poses[:, :, :3] @ turn
    cameras = replace(views.cameras, camera_to_worlds=poses)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(2000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    found = find_depths(replace(views, cameras=cameras, points=(points,) * 24))
    focus = find_focus(cameras)[0]
    depths = np.concatenate([cameras.project(i, torch.from_numpy(points))[1].numpy() for i in range(24)])
    begin = np.repeat(np.linalg.norm(poses[:, :, 3].numpy() - focus, axis=1), len(points)) * found.near_share
    assert found.near_share > 0.3
    assert (depths < begin).mean() < 0.01


def test_a_view_from_close_by_is_not_cut_off() -> None:
    views = moved(ball_views(12, 64, radius=0.35), 1.0, (0.0, 0.0, 0.0))
    close = moved(ball_views(12, 64, radius=0.35 * 4 / 1.1), 1.1 / 4, (0.0, 0.0, 0.0))  # the same ball, 1.1 away
    poses = torch.cat((views.cameras.camera_to_worlds[:10], close.cameras.camera_to_worlds[10:]))
    both = replace(
        views,
        images=(*views.images[:10], *close.images[10:]),
        cameras=replace(views.cameras, camera_to_worlds=poses),
    )
    found = find_depths(both)
    assert found.source == "the silhouettes"
    assert 0.3 < found.near <= 1.1 - 0.35


def test_focus() -> None:
    focus, depth = find_focus(moved(ball_views(12, 32), 2.0, (1.0, 2.0, 3.0)).cameras)
    np.testing.assert_allclose(focus, (1, 2, 3), atol=1e-9)
    np.testing.assert_allclose(depth, 8, atol=1e-9)


def test_nerfs_own_scenes_keep_2_and_6(scene: Path, tmp_path: Path) -> None:
    """Their json has an angle of view; real folders of that format state focal lengths."""
    assert read_blender(scene, "train").depths == (2.0, 6.0)
    write_blender(tmp_path / "real")
    assert read_blender(tmp_path / "real", "train").depths is None


@pytest.mark.parametrize(("scale", "is_nerfs"), [(1.0, True), (2.4, False), (0.6, False)])
def test_scenes_of_another_size_have_depths_of_their_own(scale: float, is_nerfs: bool, tmp_path: Path) -> None:
    """Blender's add-ons write an angle of view, too, wherever the cameras are."""
    document = write_blender(tmp_path)
    frames = document["frames"]
    for frame in frames:
        for row in frame["transform_matrix"][:3]:
            row[3] *= scale
    written, camera = tmp_path / "transforms_train.json", {"camera_angle_x": 1.0}
    written.write_text(json.dumps(camera | {"k1": 0.0, "aabb_scale": 4, "frames": frames}))  # as colmap2nerf.py does
    assert read_blender(tmp_path, "train").depths is None
    written.write_text(json.dumps(camera | {"frames": frames}))
    views = read_blender(tmp_path, "train")
    assert (views.depths == (2.0, 6.0)) == is_nerfs
    found = find_depths(views)
    assert ((found.near, found.far) == (2.0, 6.0)) == is_nerfs
    assert found.near < 4 * scale < found.far


def test_the_config_records_depths_and_flags_insist(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    views = read_split(tmp_path, "train")
    assert views is not None
    config = method_configs()["lean-nerf"]
    resolved = resolve_config(config, views)
    model = lean_model(resolved)
    found = find_depths(views)
    assert (model.near, model.far, model.near_share) == (found.near, found.far, found.near_share)
    assert (resolved.data_format, resolved.eval_every) == ("colmap", 8)
    assert resolve_config(resolved, views) == resolved
    given = lean_model(resolve_config(override(config, {"pipeline.model.near": 0.5}), views))
    assert (given.near, given.far, given.near_share) == (0.5, model.far, None)
    _, source = resolve_depths(views, replace(config.pipeline.model, near=0.5))
    assert source == f"{find_depths(views).source} and the settings"
