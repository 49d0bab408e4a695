"""edge-se view without a browser: turns, sizes of pictures, outputs and camera paths."""

from __future__ import annotations

import json
import math
import threading
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lean_models import VIEWS, config_of
from tiny import tiny_trainer

from edge_se_sampler.data.camera_path import read_camera_path
from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.engine.config import SAMPLER, override
from edge_se_sampler.engine.rendering import render_outputs
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs
from edge_se_sampler.occupancy.hull import find_focus
from edge_se_sampler.sampling.strategies import RankedError

viser = pytest.importorskip("viser", reason="the viewer needs the [view] extra")

from browsers import keyframe, view_tiny, wait_until  # noqa: E402

from edge_se_sampler.viewer import html  # noqa: E402
from edge_se_sampler.viewer.camera_path import FPS, View, camera_path  # noqa: E402
from edge_se_sampler.viewer.rendering import Pace, Renderer, choose_heights  # noqa: E402
from edge_se_sampler.viewer.viewed import Turns, Viewed  # noqa: E402


@pytest.fixture
def viewed() -> Viewed:
    return view_tiny()


def test_who_has_waited_longest_has_the_next_turn() -> None:
    turns, order = Turns(), []

    def take(name: str, times: int) -> None:
        for _ in range(times):
            with turns:
                order.append(name)

    threads = [threading.Thread(target=take, args=("training", 50)), threading.Thread(target=take, args=("viewer", 3))]
    with turns:
        for count, thread in enumerate(threads):
            thread.start()
            wait_until(lambda count=count: len(turns._waiting) == count + 2)
    for thread in threads:
        thread.join()
    assert order[:2] == ["training", "viewer"]
    assert order.count("viewer") == 3


def test_who_gives_up_waiting_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    turns, order = Turns(), []

    def give_up(_: object) -> None:
        raise KeyboardInterrupt

    def take() -> None:
        with turns:
            order.append("next")

    with turns:
        with monkeypatch.context() as patch:
            patch.setattr(turns._changed, "wait_for", give_up)
            with pytest.raises(KeyboardInterrupt):
                take()
        thread = threading.Thread(target=take, daemon=True)
        thread.start()
        wait_until(lambda: len(turns._waiting) == 2)
    thread.join(timeout=10)
    assert order == ["next"]


def test_pictures_fit_the_measured_pace_and_grow_to_the_full_height() -> None:
    pace = Pace(seconds=0.1)
    for _ in range(20):
        pace.record(rays=60_000, seconds=1.0)
    assert pace.rays == pytest.approx(6_000, rel=0.01)
    heights = choose_heights(pace.rays, aspect=1.5, full=720)
    assert heights[0] ** 2 * 1.5 == pytest.approx(6_000, rel=0.05)
    assert heights[-1] == 720
    assert all(1.4 <= after / before <= 2.8 for before, after in pairwise(heights))
    assert choose_heights(10**9, aspect=1.0, full=720) == [720]
    for _ in range(20):
        pace.record(rays=600, seconds=1.0)  # another program has begun
    assert choose_heights(pace.rays, 1.5, 720)[0] < heights[0]


def test_a_picture_is_put_together_from_its_turns(viewed: Viewed) -> None:
    camera, renderer = VIEWS.cameras[[2]], Renderer(viewed)
    renderer.turn = SimpleNamespace(rays=37, record=lambda *_: None)  # type: ignore[assignment]
    keys = ["rgb_fine", "depth_fine"]
    found = renderer.render(camera, keys, lambda: False, everything=False)
    whole = render_outputs(viewed.model, camera.to(dtype=torch.float32).image_rays(0), keys)
    assert found is not None
    for key in keys:
        assert torch.equal(found[key].reshape(whole[key].shape), whole[key])
    assert viewed.model.training  # as training left it


def test_a_picture_ends_between_two_turns_when_it_is_not_wanted(viewed: Viewed) -> None:
    renderer, calls = Renderer(viewed), []
    renderer.turn = SimpleNamespace(rays=64, record=lambda *_: calls.append(1))  # type: ignore[assignment]
    assert renderer.picture(VIEWS.cameras[[0]], "rgb", lambda: len(calls) == 2) is None
    assert len(calls) == 2


def test_what_lies_beyond_the_far_depth_of_the_training_views_is_seen(viewed: Viewed) -> None:
    view = View.of_training(viewed.cameras, 0)
    view.pose[:, 3] *= 10
    picture = Renderer(viewed).picture(view.camera(256), "accumulation", lambda: False)
    assert picture is not None
    assert picture.max() > 20


@pytest.mark.parametrize("output", ["rgb", "depth", "accumulation"])
def test_outputs_are_pictures(viewed: Viewed, output: str) -> None:
    picture = Renderer(viewed).picture(View.of_training(viewed.cameras, 0).camera(16), output, lambda: False)
    assert picture is not None
    assert picture.shape == (16, 16, 3)
    assert picture.dtype == np.uint8
    assert picture.std() > 1


def test_depths_are_those_of_what_is_seen_whatever_is_behind(viewed: Viewed) -> None:
    model, camera = viewed.model, View.of_training(viewed.cameras, 0).camera(16)
    pictures = []
    for far in (model.config.depths[1], 1000.0):
        model.config = replace(model.config, far=far)
        pictures.append(Renderer(viewed).picture(camera, "depth", lambda: False))
    np.testing.assert_allclose(*pictures, atol=4)  # a depth may round to the next color


def test_a_view_of_a_training_camera_has_its_rays() -> None:
    for k in range(3):
        view = View.of_training(VIEWS.cameras, k)
        handle = SimpleNamespace(wxyz=view.wxyz, position=view.pose[:, 3], fov=view.fov, aspect=view.aspect)
        again = View.of(handle)  # type: ignore[arg-type]
        np.testing.assert_allclose(again.pose, view.pose, atol=1e-12)
        rays, own = again.camera(16).image_rays(0), VIEWS.cameras.image_rays(k)
        torch.testing.assert_close(rays.directions, own.directions)
        torch.testing.assert_close(rays.origins, own.origins)


def read_path(content: dict[str, Any]) -> Cameras:
    """As nerfstudio's get_path_from_json does."""
    height, width = content["render_height"], content["render_width"]
    poses = [np.array(frame["camera_to_world"]).reshape(4, 4) for frame in content["camera_path"]]
    focal = [height / 2 / math.tan(math.radians(frame["fov"]) / 2) for frame in content["camera_path"]]
    size = {"width": width, "height": height}
    return Cameras.of(poses, fx=focal, fy=focal, cx=width / 2, cy=height / 2, **size)


def test_a_camera_path_leads_through_its_keyframes() -> None:
    keyframes = [keyframe(0.0), keyframe(0.6, fov=0.9), keyframe(1.1)]
    content = camera_path(keyframes, seconds=(2 * 24 + 1) / FPS, height=100)
    cameras = read_path(content)
    assert len(cameras) == 49
    assert (content["render_width"], content["fps"]) == (150, FPS)
    for frame, view in zip((0, 24, 48), keyframes, strict=True):
        np.testing.assert_allclose(cameras.camera_to_worlds[frame].numpy(), view.pose, atol=1e-9)
        torch.testing.assert_close(cameras.fy[[frame]], view.camera(100).fy)
    rotation = cameras.camera_to_worlds[:, :, :3]
    torch.testing.assert_close(rotation.mT @ rotation, torch.eye(3).double().expand(49, 3, 3))
    steps = cameras.camera_to_worlds[:, :, 3].diff(dim=0).norm(dim=1)
    assert steps.diff().abs().max() < 0.15 * steps.mean()  # neither a jump nor a halt


def test_one_keyframe_is_a_path_that_stands_still() -> None:
    cameras = read_path(camera_path([keyframe(0.3)], seconds=1.0, height=64))
    assert len(cameras) == FPS
    np.testing.assert_allclose(cameras.camera_to_worlds.numpy(), np.stack([keyframe(0.3).pose] * FPS), atol=1e-9)


@pytest.mark.parametrize(("aspect", "expected"), [(2.2, (8191, 3723)), (0.4, (3277, 8192)), (1e5, (8192, 1))])
def test_a_camera_path_is_no_larger_than_render_takes(aspect: float, expected: tuple[int, int], tmp_path: Path) -> None:
    """Of a browser's window of any shape, for photographs of 9,000 pixels through the longest lens."""
    view = View(keyframe(0.3).pose, math.radians(0.006), aspect)
    (tmp_path / "path.json").write_text(json.dumps(camera_path([view], seconds=1.0, height=9000)))
    cameras = read_camera_path(tmp_path / "path.json").cameras
    assert (int(cameras.width[0]), int(cameras.height[0])) == expected


def test_the_drawn_cells_are_the_occupied_ones_and_the_hull(viewed: Viewed) -> None:
    grid, cells, hull = viewed.model.grid, viewed.occupied_cells(), viewed.hull_cells()
    assert cells is not None
    assert hull is not None
    assert len(cells[0]) == len(np.unique(cells[0].round(6), axis=0)) == int(grid.occupied.sum())
    assert grid.contains(torch.from_numpy(cells[0])).all()
    assert len(hull[0]) * hull[1] ** 3 >= len(cells[0]) * cells[1] ** 3


def test_probabilities_are_those_of_the_current_strategy() -> None:
    by_errors = {f"{SAMPLER}.early": "uniform", f"{SAMPLER}.late": "se", f"{SAMPLER}.error_source": "cached"}
    viewed = Viewed(tiny_trainer(override(config_of(100), by_errors), VIEWS))
    sampler = viewed.trainer.pipeline.datamanager.train_pixel_sampler
    uniform = viewed.probability(0, lambda: None)
    assert viewed.strategy == "uniform"
    assert uniform is not None
    assert len(np.unique(uniform[uniform > 0])) == 1
    sampler.set_step(50)
    assert viewed.strategy == "se"
    error_map = sampler.strategies["se"].selector.error_map
    assert viewed.probability(0, lambda: None) is None  # nothing is known yet
    error_map.add({k: (16, 16) for k in range(len(VIEWS.names))})
    rows, columns = np.nonzero(uniform)
    pixels = np.stack((np.zeros_like(rows), rows, columns), axis=1)
    error_map.update(pixels, np.arange(len(rows)) + 0.0, step=viewed.trainer.next_step)
    by_error = viewed.probability(0, lambda: None)
    assert by_error is not None
    assert by_error.mean() == pytest.approx(1)
    assert ((by_error > 0) == (uniform > 0)).all()
    assert np.corrcoef(by_error[rows, columns], np.arange(len(rows)))[0, 1] > 0.9
    assert isinstance(sampler.strategies["se"].selector, RankedError)


def test_pixels_that_are_never_drawn_have_no_ranks() -> None:
    """Whose errors are small, as those of the background are."""
    views = VIEWS.with_masks([np.arange(256).reshape(16, 16) % 3 == 0] * len(VIEWS.images))
    by_errors = {f"{SAMPLER}.early": "uniform", f"{SAMPLER}.late": "se"}
    viewed = Viewed(tiny_trainer(override(config_of(100), by_errors), views))
    uniform = viewed.probability(0, lambda: None)
    assert uniform is not None
    drawn = uniform > 0
    assert drawn.mean() < 0.4
    viewed.trainer.pipeline.datamanager.train_pixel_sampler.set_step(50)
    errors = np.where(drawn, 1.0 + np.arange(drawn.size).reshape(drawn.shape), 0.0)
    found = viewed.probability(0, lambda: errors)
    assert found is not None
    relative = found[drawn] / found[drawn].mean()
    assert (relative.min(), relative.max()) == pytest.approx((0, 2), abs=0.05)


def test_an_error_is_the_difference_to_the_image(viewed: Viewed) -> None:
    renderer = Renderer(viewed)
    error = renderer.squared_error(1, lambda: False)
    rgb = render_outputs(viewed.model, VIEWS.cameras.to(dtype=torch.float32).image_rays(1), ["rgb_fine"])["rgb_fine"]
    image = VIEWS.images[1] / 255.0
    truth = image[..., :3] * image[..., 3:] + (1 - image[..., 3:])
    assert error is not None
    np.testing.assert_allclose(error, ((rgb.reshape(16, 16, 3).numpy() - truth) ** 2).mean(axis=2), atol=5e-3)


def test_masks_leave_out_what_is_unknown(viewed: Viewed) -> None:
    all_known = viewed.masks  # lean-nerf's are of pixels whose rays meet the hull
    masks = [np.random.default_rng(i).random(image.shape[:2]) < 0.5 for i, image in enumerate(VIEWS.images)]
    found = Viewed(tiny_trainer(config_of(1), VIEWS.with_masks(masks))).masks
    assert all_known is not None
    assert found is not None
    np.testing.assert_array_equal(found, np.array(all_known) & masks)
    assert Viewed(tiny_trainer(method_configs()["vanilla-nerf"], VIEWS)).masks is None


def test_a_single_camera_looks_at_what_is_halfway_between_near_and_far() -> None:
    """Its axis alone says nothing of how far that is."""
    viewed = Viewed(tiny_trainer(config_of(1), VIEWS.subset([0])))
    camera = SimpleNamespace()
    server: Any = SimpleNamespace(scene=SimpleNamespace(set_up_direction=lambda _: None), initial_camera=camera)
    focus, scale = html.set_initial_camera(server, viewed)
    assert scale == pytest.approx(sum(viewed.trainer.config.pipeline.model.depths) / 2)
    np.testing.assert_allclose(focus, camera.look_at)
    assert np.linalg.norm(focus - camera.position) == pytest.approx(scale)
    assert (camera.near, camera.far) == pytest.approx((0.01 * scale, 100 * scale))


def test_a_camera_far_from_all_others_does_not_move_the_point_to_begin_at() -> None:
    viewed = Viewed(tiny_trainer(config_of(1), VIEWS))
    camera = SimpleNamespace()
    server: Any = SimpleNamespace(scene=SimpleNamespace(set_up_direction=lambda _: None), initial_camera=camera)
    poses = viewed.trainer.pipeline.datamanager.cameras.camera_to_worlds
    poses[0, :, 3] = 1000.0
    focus, _ = html.set_initial_camera(server, viewed)
    expected, _ = find_focus(viewed.cameras[list(range(1, len(poses)))].to("cpu", torch.float64))
    np.testing.assert_allclose(focus, expected)
    np.testing.assert_allclose(camera.position, poses[1, :, 3], rtol=1e-6)


def test_an_html_file_begins_behind_the_cameras_that_turn(
    viewed: Viewed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or they would pass close before the eyes."""
    servers, set_initial_camera = [], html.set_initial_camera

    def remember(server: Any, viewed: Viewed) -> Any:
        servers.append(server)
        return set_initial_camera(server, viewed)

    monkeypatch.setattr(html, "set_initial_camera", remember)
    monkeypatch.setattr(html.Viewed, "load", lambda *_: viewed)
    monkeypatch.setattr(html, "NUM_POINTS", 100)
    html.write_html(RunFolder(tmp_path), viewed.trainer.config, tmp_path / "run.html")
    focus, _ = find_focus(viewed.cameras.to("cpu").to(dtype=torch.float64))
    distance = np.linalg.norm(viewed.cameras.camera_to_worlds[:, :, 3].double().numpy() - focus, axis=1)
    assert np.linalg.norm(np.asarray(servers[0].initial_camera.position) - focus) > 1.2 * distance.max()
    assert (tmp_path / "run.html").stat().st_size > 10_000
    monkeypatch.setattr("edge_se_sampler.export.points.SEEN", 2.0)  # more than there can be
    with pytest.raises(InputError, match="opaque in no training view"):
        html.write_html(RunFolder(tmp_path), viewed.trainer.config, tmp_path / "empty.html")
    assert not (tmp_path / "empty.html").exists()
