"""edge-se view without a browser: turns, sizes of pictures, interruption, camera paths, and addresses."""

from __future__ import annotations

import math
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from lean_models import VIEWS, config_of
from tiny import SMALL, tiny_trainer

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.engine.checkpoint import load_checkpoint, save_checkpoint
from edge_se_sampler.engine.rendering import render_outputs
from edge_se_sampler.engine.run_folder import RunFolder, config_digest
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.methods import method_configs
from edge_se_sampler.sampling.strategies import RankedError

viser = pytest.importorskip("viser", reason="the viewer needs the [view] extra")

from edge_se_sampler.viewer.address import ViewerConfig  # noqa: E402
from edge_se_sampler.viewer.camera_path import FPS, View, camera_path  # noqa: E402
from edge_se_sampler.viewer.panel import Panel  # noqa: E402
from edge_se_sampler.viewer.rendering import Pace, Renderer, choose_heights  # noqa: E402
from edge_se_sampler.viewer.viewed import Turns, Viewed  # noqa: E402


@pytest.fixture
def viewed() -> Viewed:
    """A lean-nerf of three steps, without a folder."""
    trainer = tiny_trainer(config_of(3), VIEWS)
    for step in range(3):
        trainer.train_iteration(step)
    return Viewed(trainer)


def wait_until(condition: Callable[[], Any], seconds: float = 20) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.005)


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
            wait_until(lambda count=count: turns._next == count + 2)
    for thread in threads:
        thread.join()
    assert order[:2] == ["training", "viewer"]
    assert order.count("viewer") == 3


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
    found = renderer.render(camera, keys, lambda: False, depths=None)
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


def test_a_view_of_a_training_camera_has_its_rays() -> None:
    for k in range(3):
        view = View.of_training(VIEWS.cameras, k)
        handle = SimpleNamespace(wxyz=view.wxyz, position=view.pose[:, 3], fov=view.fov, aspect=view.aspect)
        again = View.of(handle)  # type: ignore[arg-type]
        np.testing.assert_allclose(again.pose, view.pose, atol=1e-12)
        rays, own = again.camera(16).image_rays(0), VIEWS.cameras.image_rays(k)
        torch.testing.assert_close(rays.directions, own.directions)
        torch.testing.assert_close(rays.origins, own.origins)


def keyframe(angle: float, fov: float = 0.7) -> View:
    """On a circle of radius 4 around the z axis, looking at the origin."""
    back = np.array([math.cos(angle), math.sin(angle), 0.0])
    right, up = np.array([-back[1], back[0], 0.0]), np.array([0.0, 0.0, 1.0])
    return View(np.column_stack((right, up, back, 4 * back)), fov, 1.5)


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


def test_the_drawn_cells_are_the_occupied_ones_and_the_hull(viewed: Viewed) -> None:
    grid, cells, hull = viewed.model.grid, viewed.occupied_cells(), viewed.hull_cells()
    assert cells is not None
    assert hull is not None
    assert len(cells[0]) == len(np.unique(cells[0].round(6), axis=0)) == int(grid.occupied.sum())
    assert grid.contains(torch.from_numpy(cells[0])).all()
    assert len(hull[0]) * hull[1] ** 3 >= len(cells[0]) * cells[1] ** 3


def test_probabilities_are_those_of_the_current_strategy() -> None:
    viewed = Viewed(tiny_trainer(config_of(100), VIEWS))
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


def test_an_error_is_the_difference_to_the_image(viewed: Viewed) -> None:
    renderer = Renderer(viewed)
    error = renderer.squared_error(1, lambda: False)
    rgb = render_outputs(viewed.model, VIEWS.cameras.to(dtype=torch.float32).image_rays(1), ["rgb_fine"])["rgb_fine"]
    image = VIEWS.images[1] / 255.0
    truth = image[..., :3] * image[..., 3:] + (1 - image[..., 3:])
    assert error is not None
    np.testing.assert_allclose(error, ((rgb.reshape(16, 16, 3).numpy() - truth) ** 2).mean(axis=2), atol=5e-3)


class FakeClient:
    """A browser that remembers the pictures that it is sent."""

    def __init__(self, send: Callable[[np.ndarray], None] = lambda _: None) -> None:
        self.pictures: list[np.ndarray] = []
        self.callbacks: list[Callable[[Any], None]] = []
        self.gui, self.scene = MagicMock(), MagicMock()
        self.gui.add_dropdown.side_effect = lambda _, options: MagicMock(value=options[0])
        self.gui.add_slider.side_effect = lambda *_, **__: MagicMock(value=128)
        self.gui.add_number.side_effect = lambda _, value, **__: MagicMock(value=value)
        self.scene.add_camera_frustum.side_effect = lambda *_, **kwargs: MagicMock(position=kwargs["position"])

        def show(picture: np.ndarray, **_: Any) -> None:
            self.pictures.append(picture)
            send(picture)

        self.scene.set_background_image.side_effect = show
        self.camera = SimpleNamespace(image_height=128, on_update=self.callbacks.append)
        self.move(0.0)

    def move(self, angle: float) -> None:
        view = keyframe(angle)
        vars(self.camera).update(wxyz=view.wxyz, position=view.pose[:, 3], fov=view.fov, aspect=view.aspect)
        for callback in self.callbacks:
            callback(self.camera)

    def panel(self, viewed: Viewed) -> Panel:
        return Panel(self, viewed, scale=4.0)  # type: ignore[arg-type]


def test_a_browser_sees_a_small_picture_at_once_and_then_a_sharp_one_until_it_moves(viewed: Viewed) -> None:
    client = FakeClient()
    panel = client.panel(viewed)
    panel.renderer.frame = SimpleNamespace(rays=600, record=lambda *_: None)  # type: ignore[assignment]
    wait_until(lambda: client.pictures and client.pictures[-1].shape == (128, 192, 3))
    time.sleep(0.5)
    count = len(client.pictures)
    time.sleep(0.5)
    assert len(client.pictures) == count  # nothing has changed: nothing is rendered
    client.move(1.0)
    wait_until(lambda: len(client.pictures) > count and client.pictures[-1].shape == (128, 192, 3))
    assert [len(picture) for picture in client.pictures[count:]] == [20, 40, 80, 128]
    assert (client.pictures[-1] != client.pictures[count - 1]).any()
    viewed.trainer.next_step += 1  # newer weights: sharp again, but not small in between
    wait_until(lambda: len(client.pictures) == count + 5)
    assert len(client.pictures[-1]) == 128
    panel.close()


def test_the_next_move_interrupts_what_becomes_sharp(viewed: Viewed) -> None:
    client = FakeClient()
    panel, moves = client.panel(viewed), []
    panel.renderer.frame = SimpleNamespace(rays=600, record=lambda *_: None)  # type: ignore[assignment]
    wait_until(lambda: client.pictures and len(client.pictures[-1]) == 128)
    count = len(client.pictures)

    def move_once(*_: Any) -> None:
        if len(client.pictures) == count + 1 and not moves:  # the second picture is being rendered
            moves.append(client.move(0.2))

    panel.renderer.turn = SimpleNamespace(rays=300, record=move_once)  # type: ignore[assignment]
    client.move(0.1)
    wait_until(lambda: len(client.pictures) > count and len(client.pictures[-1]) == 128)
    assert [len(picture) for picture in client.pictures[count:]] == [20, 20, 40, 80, 128]
    panel.close()


def test_a_slow_browser_stalls_neither_training_nor_others(viewed: Viewed) -> None:
    stuck, slow = threading.Event(), threading.Event()

    def hang(_: np.ndarray) -> None:
        stuck.set()
        slow.wait(60)

    slow_client, quick_client = FakeClient(hang), FakeClient()
    panels = [slow_client.panel(viewed)]
    assert stuck.wait(20)
    for angle in range(100):  # its moves do not queue
        slow_client.move(angle / 10)
    panels.append(quick_client.panel(viewed))
    wait_until(lambda: quick_client.pictures and len(quick_client.pictures[-1]) == 128)
    with viewed.turns:
        viewed.trainer.train_iteration(2)
    assert len(slow_client.pictures) == 1
    slow.set()
    wait_until(lambda: len(slow_client.pictures[-1]) == 128)
    assert len(slow_client.pictures) < 20
    for panel in panels:
        panel.close()


def trained(folder: Path, view: Callable[[Trainer], None] = lambda _: None) -> Trainer:
    trainer = tiny_trainer(config_of(60), VIEWS, folder)
    view(trainer)
    trainer.train()
    return trainer


def test_a_viewed_training_has_bit_for_bit_the_weights_of_another(tmp_path: Path) -> None:
    client = FakeClient()

    def view(trainer: Trainer) -> None:
        panel = client.panel(Viewed(trainer))
        panel.renderer.turn = SimpleNamespace(rays=500, record=lambda *_: None)  # type: ignore[assignment]

        def fly() -> None:
            for angle in range(1000):
                client.move(angle / 10)
                panel.viewed.probability(0, lambda: None)
                panel.viewed.occupied_cells()
                time.sleep(0.01)
                if trainer.next_step == 60:
                    break
            panel.close()

        threading.Thread(target=fly, daemon=True).start()
        wait_until(lambda: client.pictures)

    alone, seen = trained(tmp_path / "alone"), trained(tmp_path / "viewed", view)
    assert len(client.pictures) > 5
    assert int(seen.pipeline.model.grid.level) > 0  # cells have been subdivided under the viewer's eyes
    states = [trainer.pipeline.model.state_dict() for trainer in (alone, seen)]
    for name, value in states[0].items():
        assert torch.equal(states[1][name], value), name
    assert torch.equal(alone.pipeline.model.random.get_state(), seen.pipeline.model.random.get_state())


def files_of(run: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in run.rglob("*") if path.is_file()}


def test_a_newer_checkpoint_is_shown_and_nothing_is_written(run: Path) -> None:
    before = files_of(run)
    viewed = Viewed.load(RunFolder(run), RunFolder(run).config(method_configs()))
    assert (viewed.trainer.next_step, viewed.strategy) == (6, "se")
    viewed.reload()
    model = viewed.model
    assert files_of(run) == before
    (old,) = (run / "checkpoints").iterdir()
    # what another process would write at a later step
    state = load_checkpoint(old, config_digest(viewed.trainer.config))
    state["step"], name = 8, next(name for name in state["model"] if "weight" in name)
    state["model"][name] += 1
    save_checkpoint(run / "checkpoints", 8, state)
    viewed.reload()
    assert viewed.trainer.next_step == 9
    assert viewed.model is not model
    assert torch.equal(viewed.model.state_dict()[name], state["model"][name])


def test_a_port_that_is_taken_is_named(run: Path, edge_se) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        answer = edge_se("view", run, "--port", port)
        training = edge_se("train", "lean-nerf", "--view", "--viewer.port", port, "--data", "nowhere")
    for result in (answer, training):
        assert result.code == 2
        assert result.err.count("\n") == 1
        assert f"port {port} of 127.0.0.1 is taken" in result.err


@pytest.mark.parametrize(
    ("flags", "named"),
    [(("--port", "70000"), "70000"), (("--host", "no.such.host.invalid"), "no.such.host.invalid")],
)
def test_an_address_that_is_none_is_refused(run: Path, edge_se, flags: tuple[str, str], named: str) -> None:
    answer = edge_se("view", run, *flags)
    assert answer.code == 2
    assert named in answer.err.splitlines()[-1]


def test_another_host_has_a_warning(capsys: pytest.CaptureFixture[str]) -> None:
    ViewerConfig(port=0).check()
    assert not capsys.readouterr().err
    ViewerConfig(host="0.0.0.0", port=0).check()
    assert capsys.readouterr().err.count("\n") == 1


def test_without_viser_the_extra_is_named(run: Path, edge_se, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edge_se_sampler.viewer.address.find_spec", lambda _: None)
    for arguments in (("view", run), ("view", run, "--html", "x.html"), ("train", "lean-nerf", "--view")):
        answer = edge_se(*arguments)
        assert answer.code == 2
        assert "edge-se-sampler[view]" in answer.err


@pytest.mark.parametrize("trains", [False, True])
def test_the_page_is_served_on_a_free_port_until_ctrl_c(run: Path, scene: Path, tmp_path: Path, trains: bool) -> None:
    flags = ["view", run, "--port", 0]
    if trains:
        flags = [
            "train",
            "edge-se-nerf",
            "--data",
            scene,
            "--output-dir",
            tmp_path,
            *SMALL,
            "--view",
            "--viewer.port",
            0,
        ]
    command = [sys.executable, "-m", "edge_se_sampler.cli", *map(str, flags)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        found = re.search(r"http://127\.0\.0\.1:(\d+)", process.stdout.readline())
        assert found is not None
        assert int(found[1]) > 0
        page = urllib.request.urlopen(found[0], timeout=10).read()
        assert b"<html" in page.lower()
        if trains:
            wait_until(lambda: "goes on until Ctrl-C" in process.stdout.readline())  # type: ignore[union-attr]
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=20)
    assert (process.returncode, out, err) == (0, "", "")
