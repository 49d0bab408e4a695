"""Frames of a render: what each output shows, and folders of them that are broken off and continued."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from tiny import tiny_model

from edge_se_sampler.data.cameras import Cameras, RayBundle
from edge_se_sampler.engine import frames
from edge_se_sampler.engine.frames import choose_depth_unit, name_checkpoint, render_frame, write_frames
from edge_se_sampler.errors import InputError

SIZE = {"width": 5, "height": 4}
CAMERAS = Cameras.of(np.stack([np.eye(4)] * 3), fx=3, fy=3, cx=2.5, cy=2, **SIZE)
ALPHA, DEPTH = 0.75, 3.0
COLOR = (0.8, 0.4, 0.2)
OUTPUTS = ("rgb", "rgba", "accumulation", "depth", "raw-depth")


class Wall(torch.nn.Module):
    """A wall of one color, three quarters opaque, at depth 3 along the optical axis; the left column sees nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.config, self.device = tiny_model().config, torch.device("cpu")

    def chunks(self, num_rays: int) -> list[slice]:
        return [slice(0, num_rays)]

    def find_empty_depths(self, camera: Cameras) -> None:
        return None

    def forward(self, rays: RayBundle) -> dict[str, torch.Tensor]:
        norm = rays.metadata["directions_norm"]
        alpha = torch.full_like(norm, ALPHA)
        alpha[::5] = 0
        color = torch.tensor(COLOR).expand(len(rays), 3)
        return {
            "rgb_fine": color * alpha + 1 - alpha,
            "accumulation_fine": alpha,
            "depth_fine": alpha * DEPTH * norm + (1 - alpha) * 6 * norm,
            "background": torch.ones(len(rays), 3),
        }


WALL: Any = Wall()


def test_every_output_of_a_wall() -> None:
    images = render_frame(WALL, CAMERAS, 1, OUTPUTS, 0.001)
    shapes = {name: image.shape for name, image in images.items()}
    assert shapes == {
        "rgb": (4, 5, 3),
        "rgba": (4, 5, 4),
        "accumulation": (4, 5),
        "depth": (4, 5, 3),
        "raw-depth": (4, 5),
    }
    assert (images["raw-depth"][:, 0] == 0).all()
    assert images["raw-depth"].dtype == np.uint16
    np.testing.assert_allclose(images["raw-depth"][:, 1:], 3000, atol=1)  # in the corners, too
    assert (images["accumulation"][:, 1:] == round(ALPHA * 255)).all()
    np.testing.assert_allclose(images["rgba"][:, 1:, :3], np.broadcast_to(np.multiply(COLOR, 255), (4, 4, 3)), atol=1)
    assert (images["rgba"][..., 3] == images["accumulation"]).all()
    straight = images["rgba"] / 255
    on_white = straight[..., :3] * straight[..., 3:] + 1 - straight[..., 3:]
    np.testing.assert_allclose(on_white * 255, images["rgb"], atol=1.5)
    assert (images["depth"][:, 0] == 255).all()


def test_a_frame_is_rendered_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """All rays of a frame of 8192 x 8192 pixels would take many gigabytes."""
    whole, drawn = render_frame(WALL, CAMERAS, 1, OUTPUTS, 0.001), []
    monkeypatch.setattr(WALL, "chunks", lambda count: (slice(i, i + 10) for i in range(0, count, 10)))
    generate = Cameras.generate_rays
    monkeypatch.setattr(Cameras, "generate_rays", lambda *args: drawn.append(args[1:]) or generate(*args))
    parts = render_frame(WALL, CAMERAS, 1, OUTPUTS, 0.001)
    assert [camera.tolist() for camera, _ in drawn] == [[[0]], [[0]]]
    assert [len(coords) for _, coords in drawn] == [10, 10]
    every = torch.cartesian_prod(torch.arange(4), torch.arange(5)) + 0.5
    assert torch.equal(torch.cat([coords for _, coords in drawn]), every)
    for name in OUTPUTS:
        np.testing.assert_array_equal(parts[name], whole[name])


def test_near_is_red_and_far_is_blue(monkeypatch: pytest.MonkeyPatch) -> None:
    colors = []
    for depth in (2.2, 5.8):
        monkeypatch.setattr("test_frames.DEPTH", depth)
        colors.append(render_frame(WALL, CAMERAS, 0, ("depth",), 1)["depth"][2, 2].astype(int))
    near, far = colors
    assert near[0] > near[2] + 50
    assert far[2] > far[0] + 50


@pytest.mark.parametrize(("far", "unit"), [(6, 1e-4), (6.6, 1e-3), (6000, 0.1), (0.06, 1e-6)])
def test_the_depth_unit_reaches_as_far_as_the_scene(far: float, unit: float) -> None:
    assert choose_depth_unit(far, None) == pytest.approx(unit)
    assert choose_depth_unit(far, 2 * unit) == 2 * unit
    for bad in (far / 70000, far, 0, -1, float("nan")):
        with pytest.raises(InputError, match="--depth-unit"):
            choose_depth_unit(far, bad)


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    path = tmp_path / "step-000000009.ckpt"
    path.write_bytes(b"edge-se-checkpoint 2 abc\nweights")
    return path


@pytest.fixture
def rendered(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, list[str]]]:
    """What has been rendered: index and outputs of each frame."""
    calls = []

    def render(model: Any, cameras: Cameras, index: int, outputs: list[str], *others: Any) -> dict[str, np.ndarray]:
        calls.append((index, outputs))
        return render_frame(model, cameras, index, outputs, *others)

    monkeypatch.setattr(frames, "render_frame", render)
    return calls


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_checkpoint_that_a_training_has_deleted_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"step-9\.ckpt: cannot be read"):
        name_checkpoint(tmp_path / "step-9.ckpt")


def test_a_folder_says_what_its_frames_are(tmp_path: Path, checkpoint: Path) -> None:
    write_frames(tmp_path / "out", WALL, CAMERAS, ("rgb", "raw-depth"), 0.001, [name_checkpoint(checkpoint)])
    names = [f"{output}/0000{i}.png" for output in ("rgb", "raw-depth") for i in range(3)]
    assert sorted(files(tmp_path / "out")) == sorted([*names, "frames.json"])
    facts = json.loads((tmp_path / "out" / "frames.json").read_text())
    depth = iio.imread(tmp_path / "out" / "raw-depth" / "00001.png") * facts["depth_unit"]
    assert depth[2, 3] == pytest.approx(DEPTH, abs=1e-3)
    assert facts["frames"][1]["file"] == "00001.png"
    assert facts["frames"][1]["transform_matrix"] == np.eye(4).tolist()
    assert (facts["frames"][1]["fl_x"], facts["frames"][1]["w"]) == (3, 5)


def test_only_what_is_missing_or_broken_is_rendered_again(tmp_path: Path, checkpoint: Path, rendered: list) -> None:
    folder = tmp_path / "out"
    write_frames(folder, WALL, CAMERAS, ("rgb", "depth"), 0.001, [name_checkpoint(checkpoint)])
    whole = files(folder)
    (folder / "rgb" / "00000.png").write_bytes(whole["rgb/00000.png"][:-30])  # cut short
    (folder / "depth" / "00000.png").write_bytes(b"")
    (folder / "depth" / "00002.png").unlink()
    rendered.clear()
    write_frames(folder, WALL, CAMERAS, ("rgb", "depth"), 0.001, [name_checkpoint(checkpoint)])
    assert rendered == [(0, ["rgb", "depth"]), (2, ["depth"])]
    assert files(folder) == whole
    write_frames(folder, WALL, CAMERAS, ("accumulation",), 0.001, [name_checkpoint(checkpoint)])  # another of the same
    assert rendered[2:] == [(i, ["accumulation"]) for i in range(3)]


def test_ctrl_c_keeps_what_is_whole(tmp_path: Path, checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(model: Any, cameras: Cameras, index: int, *others: Any) -> dict[str, np.ndarray]:
        if index == 1:
            raise KeyboardInterrupt
        return render_frame(model, cameras, index, *others)

    with monkeypatch.context() as patch:
        patch.setattr(frames, "render_frame", interrupted)
        with pytest.raises(KeyboardInterrupt):
            write_frames(tmp_path / "out", WALL, CAMERAS, ("rgb",), 0.001, [name_checkpoint(checkpoint)])
    assert sorted(files(tmp_path / "out")) == ["frames.json", "rgb/00000.png"]
    write_frames(tmp_path / "out", WALL, CAMERAS, ("rgb",), 0.001, [name_checkpoint(checkpoint)])
    assert len(files(tmp_path / "out")) == 4


def test_a_process_that_was_killed_at_its_first_file_leaves_a_folder_to_go_on_with(
    tmp_path: Path, checkpoint: Path
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".frames.json.tmp").write_text('{"check')
    write_frames(tmp_path / "out", WALL, CAMERAS, ("rgb",), 0.001, [name_checkpoint(checkpoint)])
    assert sorted(files(tmp_path / "out")) == ["frames.json", *(f"rgb/0000{i}.png" for i in range(3))]


def moved() -> Cameras:
    poses = CAMERAS.camera_to_worlds.clone()
    poses[2, 0, 3] += 1e-3
    return replace(CAMERAS, camera_to_worlds=poses)


OTHERS: dict[str, Callable[[], tuple[Cameras, float, bytes]]] = {
    "checkpoint": lambda: (CAMERAS, 0.001, b"edge-se-checkpoint 2 xyz\nweights"),
    "depth_unit": lambda: (CAMERAS, 0.002, b"edge-se-checkpoint 2 abc\nweights"),
    "frames": lambda: (moved(), 0.001, b"edge-se-checkpoint 2 abc\nweights"),
}


@pytest.mark.parametrize("differing", OTHERS)
def test_frames_of_other_settings_never_mix(differing: str, tmp_path: Path, checkpoint: Path) -> None:
    folder = tmp_path / "out"
    write_frames(folder, WALL, CAMERAS[[0, 1, 2]], ("rgb",), 0.001, [name_checkpoint(checkpoint)])
    (folder / "rgb" / "00001.png").unlink()
    before = files(folder)
    cameras, unit, content = OTHERS[differing]()
    checkpoint.write_bytes(content)
    with pytest.raises(InputError, match=re.escape(f"({differing})")):
        write_frames(folder, WALL, cameras, ("rgb",), unit, [name_checkpoint(checkpoint)])
    assert files(folder) == before


def test_what_the_last_digits_of_a_pose_say_is_no_other_camera(tmp_path: Path, checkpoint: Path) -> None:
    write_frames(tmp_path / "out", WALL, CAMERAS, ("rgb",), 0.001, [name_checkpoint(checkpoint)])
    nearly = replace(CAMERAS, fx=CAMERAS.fx + 1e-13)
    write_frames(tmp_path / "out", WALL, nearly, ("rgb",), 0.001, [name_checkpoint(checkpoint)])


@pytest.mark.parametrize("content", ["", "{", "[1]"])
def test_folders_that_are_none_of_ours_stay_as_they_are(content: str, tmp_path: Path, checkpoint: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "holiday.jpg").write_text("sun")
    with pytest.raises(InputError, match="no frames"):
        write_frames(folder, WALL, CAMERAS, ("rgb",), 0.001, [name_checkpoint(checkpoint)])
    (folder / "frames.json").write_text(content)
    before = files(folder)
    with pytest.raises(InputError, match=r"frames\.json"):
        write_frames(folder, WALL, CAMERAS, ("rgb",), 0.001, [name_checkpoint(checkpoint)])
    assert files(folder) == before
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["photos"]
