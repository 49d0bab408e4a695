"""Camera paths of nerfstudio's viewer: what they mean, and what is refused."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from capture_folder import write_colmap, write_transforms

from edge_se_sampler.data.camera_path import CameraPath, read_camera_path, undo_dataparser
from edge_se_sampler.errors import InputError

TURN = [0, -1, 0, 5, 1, 0, 0, 6, 0, 0, 1, 7, 0, 0, 0, 1]  # x of the camera is y of the world


def path_json() -> dict[str, Any]:
    """As nerfstudio 1.1.5 writes it."""
    identity = np.eye(4).flatten().tolist()
    cameras = [
        {"camera_to_world": pose, "fov": fov, "aspect": 1.5} for pose, fov in ((identity, 90), (list(TURN), 60.0))
    ]
    return {
        "default_fov": 75.0,
        "default_transition_sec": 2.0,
        "keyframes": [{"matrix": identity, "fov": 90, "aspect": 1.5, "override_transition_enabled": False}],
        "camera_type": "perspective",
        "render_height": 40,
        "render_width": 60,
        "fps": 24,
        "seconds": 4.0,
        "is_cycle": False,
        "smoothness_value": 0.5,
        "camera_path": cameras,
    }


def write(folder: Path, content: Any) -> Path:
    path = folder / "camera_path.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_matrices_are_row_by_row_and_angles_are_vertical(tmp_path: Path) -> None:
    path = read_camera_path(write(tmp_path, path_json()))
    cameras = path.cameras
    assert path.frames_per_second == 24
    assert (cameras.width[1].item(), cameras.height[1].item()) == (60, 40)
    top_middle = cameras.generate_rays(torch.tensor([[0], [1]]), torch.tensor([[0.0, 30.0]] * 2, dtype=torch.float64))
    np.testing.assert_allclose(top_middle.origins, [[0, 0, 0], [5, 6, 7]])
    half = math.radians(30)
    np.testing.assert_allclose(top_middle.directions[0], [0, math.sqrt(0.5), -math.sqrt(0.5)], atol=1e-12)
    np.testing.assert_allclose(top_middle.directions[1], [-math.sin(half), 0, -math.cos(half)], atol=1e-12)
    right_middle = cameras.generate_rays(torch.tensor([[0]]), torch.tensor([[20.0, 50.0]], dtype=torch.float64))
    np.testing.assert_allclose(right_middle.directions[0], [math.sqrt(0.5), 0, -math.sqrt(0.5)], atol=1e-12)


def test_what_older_writers_leave_out_may_be_missing(tmp_path: Path) -> None:
    needed = {key: path_json()[key] for key in ("render_height", "render_width", "camera_path")}
    path = read_camera_path(write(tmp_path, needed))
    assert len(path.cameras) == 2
    assert path.frames_per_second is None


def camera(change: Callable[[dict], Any]) -> Callable[[dict], Any]:
    return lambda content: change(content["camera_path"][1])


BAD: dict[str, tuple[Callable[[dict], Any], str]] = {
    "no height": (lambda c: c.pop("render_height"), "render_height: is missing"),
    "width in words": (lambda c: c.update(render_width="wide"), "render_width: must be a number"),
    "half a pixel": (lambda c: c.update(render_width=60.5), "render_width: must be a whole number"),
    "negative height": (lambda c: c.update(render_height=-40), "render_height: must be positive"),
    "huge height": (lambda c: c.update(render_height=10**6), "render_height: is 1000000 pixels"),
    "fisheye": (lambda c: c.update(camera_type="fisheye"), "camera_type: is 'fisheye'"),
    "type is a number": (lambda c: c.update(camera_type=3), "camera_type: is 3"),
    "no rate": (lambda c: c.update(fps=0), "fps: must be positive"),
    "rate is a list": (lambda c: c.update(fps=[24]), "fps: must be a number"),
    "no path": (lambda c: c.pop("camera_path"), "camera_path: is missing"),
    "empty path": (lambda c: c.update(camera_path=[]), "camera_path: is empty"),
    "path is an object": (lambda c: c.update(camera_path={}), "camera_path: must be a list"),
    "camera is a list": (lambda c: c["camera_path"].append([]), r"camera_path\[2\]: must be a json object"),
    "no matrix": (camera(lambda c: c.pop("camera_to_world")), r"camera_path\[1\].camera_to_world: is missing"),
    "short matrix": (camera(lambda c: c["camera_to_world"].pop()), r"\[1\].camera_to_world: has 15 entries"),
    "word in a matrix": (
        camera(lambda c: c.update(camera_to_world=["x"] * 16)),
        r"camera_to_world\[0\]: must be a num",
    ),
    "infinite": (camera(lambda c: c["camera_to_world"].__setitem__(3, math.inf)), r"camera_to_world\[3\]: is NaN"),
    "mirrored": (camera(lambda c: c["camera_to_world"].__setitem__(10, -1)), "camera_to_world: is not a rigid motion"),
    "transposed": (
        camera(lambda c: c.update(camera_to_world=np.reshape(TURN, (4, 4)).T.flatten().tolist())),
        "last row",
    ),
    "no angle": (camera(lambda c: c.pop("fov")), r"\[1\].fov: is missing"),
    "angle of nothing": (camera(lambda c: c.update(fov=0)), r"\[1\].fov: is 0"),
    "angle too wide": (camera(lambda c: c.update(fov=180)), r"\[1\].fov: is 180"),
    "angle is null": (camera(lambda c: c.update(fov=None)), r"\[1\].fov: must be a number"),
    "angle is not finite": (camera(lambda c: c.update(fov=math.nan)), r"\[1\].fov: is NaN"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_field_is_named_in_one_line(name: str, tmp_path: Path) -> None:
    change, message = BAD[name]
    content = path_json()
    change(content)
    with pytest.raises(InputError, match=message) as problem:
        read_camera_path(write(tmp_path, content))
    assert "\n" not in str(problem.value)
    assert "camera_path.json" in str(problem.value)


@pytest.mark.parametrize("content", ["", "[]", "{", "\0"])
def test_what_is_no_json_object_is_refused(content: str, tmp_path: Path) -> None:
    with pytest.raises(InputError):
        read_camera_path(write(tmp_path, content))
    with pytest.raises(InputError, match="does not exist"):
        read_camera_path(tmp_path / "nothing.json")


def test_nerfstudio_means_the_same_cameras(tmp_path: Path) -> None:
    paths = pytest.importorskip("nerfstudio.cameras.camera_paths")
    theirs = paths.get_path_from_json(path_json())
    ours = read_camera_path(write(tmp_path, path_json())).cameras
    torch.testing.assert_close(theirs.camera_to_worlds, ours.camera_to_worlds, check_dtype=False)
    for key in ("fx", "fy", "cx", "cy"):
        torch.testing.assert_close(getattr(theirs, key), getattr(ours, key), check_dtype=False)


MOTION = np.array([[0.0, 0, 1, 0.3], [1, 0, 0, -0.2], [0, 1, 0, 0.7]])
"""From the data to nerfstudio, before it is scaled."""
APPLIED = np.array([[0.0, 1, 0, 0.5], [1, 0, 0, 2], [0, 0, -1, -1]])
"""From the original data to the json's."""


def square(motion: np.ndarray) -> np.ndarray:
    return np.vstack((motion, (0, 0, 0, 1)))


def drawn_path(folder: Path, scale: float = 0.25) -> CameraPath:
    """The path of `path_json`, as it is drawn in nerfstudio's viewer."""
    content = path_json()
    for camera in content["camera_path"]:
        pose = square(MOTION) @ np.reshape(camera["camera_to_world"], (4, 4))
        pose[:3, 3] *= scale
        camera["camera_to_world"] = pose.ravel().tolist()
    return read_camera_path(write(folder, content))


def write_dataparser(folder: Path, motion: Any = MOTION, scale: float = 0.25) -> Path:
    path = folder / "dataparser_transforms.json"
    path.write_text(json.dumps({"transform": np.array(motion).tolist(), "scale": scale}))
    return path


@pytest.mark.parametrize("applied", [None, "written", "old COLMAP"])
def test_a_path_drawn_in_nerfstudio_returns_to_the_data(applied: str | None, tmp_path: Path) -> None:
    """With what nerfstudio's own json says of the data before it, which its file takes together with its own motion."""
    scene = write_transforms(tmp_path / "scene")
    motion, scale = MOTION, 0.25
    if applied == "written":
        scene |= {"applied_transform": APPLIED.tolist(), "applied_scale": 3.0}
        (tmp_path / "scene" / "transforms.json").write_text(json.dumps(scene))
        motion, scale = MOTION @ square(APPLIED), 0.75
    elif applied == "old COLMAP":
        (tmp_path / "scene" / "colmap" / "sparse" / "0").mkdir(parents=True)
        motion = MOTION @ np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
    path = drawn_path(tmp_path)
    found = undo_dataparser(path, write_dataparser(tmp_path, motion, scale), tmp_path / "scene", "auto")
    expected = read_camera_path(write(tmp_path, path_json()))
    torch.testing.assert_close(found.cameras.camera_to_worlds, expected.cameras.camera_to_worlds)
    assert found.frames_per_second == 24
    assert torch.equal(found.cameras.fx, expected.cameras.fx)


def test_what_another_json_says_of_data_in_colmaps_format_does_not_count(tmp_path: Path) -> None:
    """nerfstudio's file is of COLMAP's own world, which is that of our reader."""
    write_colmap(tmp_path / "scene")
    scene = write_transforms(tmp_path / "scene") | {"applied_transform": APPLIED.tolist()}
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(scene))
    found = undo_dataparser(drawn_path(tmp_path), write_dataparser(tmp_path), tmp_path / "scene", "colmap")
    expected = read_camera_path(write(tmp_path, path_json()))
    torch.testing.assert_close(found.cameras.camera_to_worlds, expected.cameras.camera_to_worlds)


@pytest.mark.parametrize(
    ("motion", "scale", "message"),
    [
        (MOTION[:2], 1.0, "transform: must be 3 rows of 4 numbers"),
        (square(MOTION), 1.0, "transform: must be 3 rows of 4 numbers"),
        (2 * MOTION, 1.0, "transform: is not a rigid motion"),
        (MOTION[:, 0], 1.0, r"transform\[0\]: must be a list"),
        (MOTION, 0.0, "scale: must be positive"),
    ],
)
def test_a_bad_dataparser_file_is_named_in_one_line(motion: Any, scale: float, message: str, tmp_path: Path) -> None:
    write_transforms(tmp_path / "scene")
    with pytest.raises(InputError, match=message) as problem:
        undo_dataparser(drawn_path(tmp_path), write_dataparser(tmp_path, motion, scale), tmp_path / "scene", "auto")
    assert "dataparser_transforms.json" in str(problem.value)
    assert "\n" not in str(problem.value)
