"""Captures that cannot be used: refused in one line that says where, what, and what to do; never a traceback."""

from __future__ import annotations

import copy
import io
import json
import os
import re
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from capture_folder import (
    COUNT,
    HEIGHT,
    NAMES,
    OPENCV,
    PINHOLE,
    WIDTH,
    bounds,
    colmap_files,
    picture,
    transforms,
    turned_jpeg,
    write_colmap,
    write_images,
    write_transforms,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from edge_se_sampler.data.dataset import DataSettings, read_split
from edge_se_sampler.engine.config import override
from edge_se_sampler.engine.session import prepare
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def refusal(folder: Path, **options: Any) -> str:
    """The message of the InputError that reading raises, checked for what every message must be."""
    with pytest.raises(InputError) as caught:
        read_split(folder, "train", DataSettings(**options))
    message = str(caught.value)
    check_message(message)
    assert re.fullmatch(r".*?: .{6,}?; .{6,}", message)
    return message


def check_message(message: str) -> None:
    assert message.isprintable(), "one line, nothing unescaped"
    assert len(message) < 900


def put(document: dict[str, Any], key: str, value: Any) -> None:
    *path, last = [int(part) if part.isdigit() else part for part in key.split()]
    target: Any = document
    for part in path:
        target = target[part]
    target[last] = value


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("camera_model", "EQUIRECTANGULAR", r"camera_model: is 'EQUIRECTANGULAR', a camera model"),
        ("camera_model", 3, "camera_model: is 3"),
        ("frames 2 camera_model", "FOV", r"frames\[2\]\.camera_model"),
        ("is_fisheye", "yes", "is_fisheye: must be true or false"),
        ("equirectangular", True, "equirectangular: is of a camera"),
        ("ftheta_p0", 0.0, "ftheta_p0: is of a camera"),
        ("frames 2 latlong", True, r"frames\[2\]\.latlong: is of a camera"),
        ("distortion_params", [0.1, 0.0], "distortion_params: has 2 numbers; write k1, k2, k3, k4, p1, p2"),
        ("distortion_params", [0, 0, 0, 0.1, 0, 0], r"distortion_params\[3\]: is not supported of a lens"),
        ("k1", "0,1", "k1: must be a number"),
        ("k2", "nan", "k2: must be a number"),
        ("fl_x", "40", "fl_x: must be a number"),
        ("k4", 0.1, "k4: is not supported of a lens that is none"),
        ("frames 1 p1", None, r"frames\[1\]\.p1: must be a number"),
        ("k1", float("nan"), "k1: is NaN"),
        ("k2", 1e308, r"frames\[1\]\.file_path: .*shows nothing once its lens is undone"),
        ("w", 49, "w: is 49, but"),
        ("camera_angle_y", 4, "camera_angle_y: must lie between 0 and pi"),
        ("train_filenames", "all", "train_filenames: must be a list"),
        ("train_filenames", ["images/nowhere.png"], r"train_filenames\[0\]: .*is the file of no frame"),
        ("test_filenames", [3], r"test_filenames\[0\]: must be non-empty text"),
        ("train_filenames", [], ""),
        ("frames 4 file_path", "../outside.png", r"frames\[4\]\.file_path: .*leads out"),
        ("frames 4 mask_path", "/etc/passwd", "absolute"),
        ("frames 4 file_path", f"images/{NAMES[3]}", "already the image of"),
        ("frames 4 transform_matrix", [[1, 0], [0, 1]], "4 rows of 4"),
        ("frames", {}, "frames: must be a list"),
        ("fl_x", 1e300, r"frames\[1\]\.file_path: .* focal length is 1e\+300"),
        ("frames 2 fl_y", 1e-9, r"frames\[2\]\.file_path: .* focal length is 1e-09"),
        ("fl_x", 0, "fl_x: must be positive"),
        ("fl_x", -40, "fl_x: must be positive"),
        ("frames 3 cy", -1e9, r"frames\[3\]\.file_path: .* principal point at 23, -1e\+09"),
        ("w", 10**9, "w: is 1000000000, but"),
        ("frames 4 transform_matrix 0 3", 1e300, r"frames\[4\]\.file_path: .* camera at 1e\+300"),
        ("frames 4 file_path", "images/\0.png", "characters that no file name can have"),
        ("frames 4 mask_path", "images/\0.png", "characters that no file name can have"),
        ("frames 4 mask_path", "x" * 5000, "cannot be read .file name too long"),
    ],
)
def test_a_bad_field_of_transforms_json(key: str, value: Any, says: str, tmp_path: Path) -> None:
    document = write_transforms(tmp_path, PINHOLE)
    put(document, key, value)
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    if says:
        assert re.search(says, refusal(tmp_path))
    else:
        assert read_split(tmp_path, "train") is not None


def test_a_name_that_is_too_long_is_of_an_image_that_is_not_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = write_transforms(tmp_path, PINHOLE)
    put(document, "frames 4 file_path", "x" * 5000)
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    views = read_split(tmp_path, "train")
    assert views is not None
    assert len(views.names) == 7
    assert "1 of the 9 listed images do not exist" in capsys.readouterr().err


def test_cameras_too_far_from_the_origin_to_be_told_apart(tmp_path: Path) -> None:
    """As those of surveys are, whose coordinates are of a country or the earth."""
    document = write_transforms(tmp_path, PINHOLE)
    for frame in document["frames"]:
        frame["transform_matrix"][0][3] += 1e4
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert read_split(tmp_path, "train") is not None
    for frame in document["frames"]:
        frame["transform_matrix"][0][3] += 9e4
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert re.search(
        r"transforms.json: its cameras are 1e\+05 from the origin, but only .* from each", refusal(tmp_path)
    )


def test_a_camera_far_from_all_others_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = write_transforms(tmp_path, PINHOLE)
    assert read_split(tmp_path, "train") is not None
    assert capsys.readouterr().err == ""
    document["frames"][4]["transform_matrix"][0][3] += 1e3
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert read_split(tmp_path, "train") is not None
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert "frames[4]" in line
    assert "999 from the middle" in line


def test_held_out_images_of_one_tripod_are_near_enough_to_the_origin(tmp_path: Path) -> None:
    document = write_transforms(tmp_path, PINHOLE)
    names = [frame["file_path"] for frame in document["frames"]]
    document |= {"train_filenames": names[2:], "test_filenames": names[:2]}
    matrix = document["frames"][0]["transform_matrix"]
    document["frames"][1]["transform_matrix"] = [[*row[:3], row[3] + 1e-5] for row in matrix[:3]] + [matrix[3]]
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    held_out = read_split(tmp_path, "test")
    assert held_out is not None
    assert len(held_out.names) == 2


def test_a_fisheye_has_no_tangential_terms(tmp_path: Path) -> None:
    document = write_transforms(tmp_path) | {"is_fisheye": True, "p2": 0.1}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert "p2: is not supported of a fisheye" in refusal(tmp_path)


ABSURD = struct.pack("<Q", 2**62)
BINARY = {
    "cameras.bin": [
        (lambda data: data[:30], r"cameras: the file ends within it \(byte 30\)"),
        (lambda data: ABSURD + data[8:], "cameras: the file ends within it"),
        (lambda data: struct.pack("<Q", 0), "has no cameras"),
        (lambda data: data[:12] + struct.pack("<i", 6) + data[16:], "'FULL_OPENCV' is not supported|ends within"),
        (lambda data: data[:12] + struct.pack("<i", 99) + data[16:], "'number 99' is not supported"),
        (lambda data: data[:16] + struct.pack("<Q", 0) + data[24:], "have 0 x 36 pixels"),
        (lambda data: data[:32] + struct.pack("<d", float("nan")) + data[40:], "not finite"),
        (lambda data: data[:32] + struct.pack("<d", -1) + data[40:], "focal length is not above 0"),
        (lambda data: struct.pack("<Q", 2) + data[8:] + data[8:], r"cameras\[1\]: is a second camera 7"),
        (lambda data: b"", "is empty"),
    ],
    "images.bin": [
        (lambda data: data[:-1], r"images\[8\]: the file ends within it"),
        (lambda data: data[:80], "the file ends within"),
        (lambda data: ABSURD + data[8:], "images: the file ends within it"),
        (lambda data: data[:12] + b"\0" * 32 + data[44:], r"images\[0\]: its pose is not finite, or no rotation"),
        (lambda data: data[:68] + struct.pack("<I", 5) + data[72:], "there is no camera 5"),
        (lambda data: data[:72] + b"\xff" + data[73:], "not UTF-8"),
        (lambda data: data[:72] + b"../" + data[75:], "leads out of the folder"),
        (lambda data: data.replace(b"view 01", b"view 02"), "already the image of"),
        (lambda data: data[:72] + b"\0" + data[72 + len(NAMES[0]) + 1 :], "has no name"),
        (lambda data: struct.pack("<Q", 0), "has no images"),
    ],
    "points3D.bin": [
        (lambda data: data[:-1], r"points3D\[29\]: the file ends within it"),
        (lambda data: ABSURD + data[8:], "points3D: the file ends within it"),
        (lambda data: data[:16] + struct.pack("<d", float("inf")) + data[24:], r"\[0\]: its position is not finite"),
    ],
}


@pytest.mark.parametrize(
    ("name", "change", "says"), [(name, *case) for name, cases in BINARY.items() for case in cases]
)
def test_a_bad_binary_model(name: str, change: Callable[[bytes], bytes], says: str, tmp_path: Path) -> None:
    files = write_colmap(tmp_path)
    (tmp_path / "sparse/0" / name).write_bytes(change(files[name]))
    message = refusal(tmp_path)
    assert name in message
    assert re.search(says, message)


@pytest.mark.parametrize(
    ("name", "old", "new", "says"),
    [
        ("cameras.txt", b"PINHOLE", b"FOV", "line 2: its model 'FOV' is not supported"),
        ("cameras.txt", b"48", b"48.5", "48.5 x 36 pixels"),
        ("cameras.txt", b"40.0", b"forty", "line 2: has '.*' where numbers belong"),
        ("cameras.txt", b" 19.5", b"", "has 3 parameters, PINHOLE has 4"),
        ("cameras.txt", b"7 PINHOLE 48 36", b"7 PINHOLE", "pixels|parameters"),
        ("cameras.txt", b"48 36", b"1000000000 750000000", "whole numbers from 1"),
        ("images.txt", b"view 00", b"view\0 00", "line 1: has characters that no file name can have"),
        ("images.txt", b"1 ", b"", "line 1: "),
        ("images.txt", b" 7 view 00", b" 9 view 00", "line 1: there is no camera 9"),
        ("images.txt", b"1.5 2.5 3 ", b"1.5 2.5 x ", "where numbers belong"),
        ("images.txt", b" -1\n", b" 99999999999999999999\n", "more than 64 bits"),
        ("points3D.txt", b"1 ", b"1e999 ", "line 1"),
        ("points3D.txt", b"30 ", b"nan ", "line 30"),
    ],
)
def test_a_bad_text_model(name: str, old: bytes, new: bytes, says: str, tmp_path: Path) -> None:
    files = write_colmap(tmp_path, text=True)
    assert old in files[name]
    (tmp_path / "sparse/0" / name).write_bytes(files[name].replace(old, new, 1))
    message = refusal(tmp_path)
    assert name in message
    assert re.search(says, message)


@pytest.mark.parametrize("focal", [b"1e300", b"1e-300", b"1e9"])
def test_a_focal_length_of_a_model_that_no_camera_has(focal: bytes, tmp_path: Path) -> None:
    files = write_colmap(tmp_path, text=True)
    (tmp_path / "sparse/0/cameras.txt").write_bytes(files["cameras.txt"].replace(b"40.0", focal))
    assert re.search(r"images.txt: line 3: 'view 01.png' is of 48 x 36 pixels, .*focal length is 1e", refusal(tmp_path))


def test_a_model_without_images(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    for name in NAMES:
        (tmp_path / "images" / name).unlink()
    (tmp_path / "images" / "other").touch()
    assert "9 of the 9 listed images do not exist" in refusal(tmp_path)
    (tmp_path / "images" / "other").unlink()  # an empty folder is none
    assert "has no images; put them into images, images_2, images_4 or images_8" in refusal(tmp_path)


@pytest.mark.parametrize("missing", ["images.bin", "cameras.bin"])
def test_a_model_without_one_of_its_files(missing: str, tmp_path: Path) -> None:
    write_colmap(tmp_path)
    (tmp_path / "sparse/0" / missing).unlink()
    assert re.search("images.bin: does not exist|nothing that lists cameras", refusal(tmp_path))


def test_an_image_of_another_shape_or_damaged(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    path = tmp_path / "images" / NAMES[1]
    iio.imwrite(path, picture(1)[:20])
    assert re.search(r"images\[1\]: 'view 01.png' is 48 x 20 pixels, its camera's images 48 x 36", refusal(tmp_path))
    iio.imwrite(path, picture(1))
    path.write_bytes(path.read_bytes()[:-20])
    assert re.search(r"images\[1\]: 'view 01.png' is truncated", refusal(tmp_path))


def test_an_image_of_another_kind_is_there(tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    (tmp_path / "images" / "view 01.webp").write_bytes(iio.imwrite("<bytes>", picture(1), extension=".webp"))
    document["frames"][1]["file_path"] = "images/view 01.webp"
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert "'images/view 01.webp' is not a PNG or JPEG image" in refusal(tmp_path)


def test_a_mask_of_another_size(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    (tmp_path / "masks").mkdir()
    iio.imwrite(tmp_path / "masks" / NAMES[1], np.ones((3, 3), np.uint8))
    assert re.search(r"images\[1\]: 'masks/view 01.png' is 3 x 3 pixels, its image 48 x 36", refusal(tmp_path))


@pytest.mark.parametrize("kind", ["image", "mask"])
def test_a_link_that_leads_out(kind: str, tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    write_colmap(folder)
    (folder / "masks").mkdir()
    iio.imwrite(tmp_path / "outside.png", picture(0))
    path = folder / ("images" if kind == "image" else "masks") / NAMES[1]
    path.unlink(missing_ok=True)
    os.symlink(tmp_path / "outside.png", path)
    assert "leads out of the folder" in refusal(folder)


@pytest.mark.parametrize("flag", [{"downscale": 0}, {"downscale": 40}, {"eval_every": 1}, {"eval_every": 0}])
def test_bad_settings(flag: dict[str, Any], tmp_path: Path) -> None:
    write_transforms(tmp_path)
    with pytest.raises(InputError, match=f"--{next(iter(flag)).replace('_', '-')}"):
        read_split(tmp_path, "train", DataSettings(**flag))


def test_nothing_is_written_and_the_exit_code_is_2(tmp_path: Path, edge_se: Callable[..., Any]) -> None:
    files = write_colmap(tmp_path / "scene")
    (tmp_path / "scene/sparse/0/images.bin").write_bytes(files["images.bin"][:-1])
    before = sorted(tmp_path.rglob("*"))
    answer = edge_se("train", "lean-nerf", "--data", tmp_path / "scene", "--output-dir", tmp_path / "outputs")
    assert answer.code == 2
    assert len(answer.err.splitlines()) == 1
    assert sorted(tmp_path.rglob("*")) == before


TINY = {
    "max_num_iterations": 4,
    "machine.device_type": "cpu",
    "pipeline.model.size": "tiny",
    "pipeline.model.voxel_size_px": 4.0,
    "pipeline.model.max_memory": 0.05,
    "pipeline.datamanager.train_num_rays_per_batch": 32,
}


def accept(folder: Path) -> None:
    """A training that starts, or an InputError of one line and nothing written: anything else is raised."""
    outputs = folder.parent / "outputs"
    try:
        trainer = prepare(override(method_configs()["lean-nerf"], {**TINY, "data": folder, "output_dir": outputs}))
    except InputError as problem:
        check_message(str(problem))
        assert not outputs.exists()
        return
    trainer.train_iteration(0)
    shutil.rmtree(outputs)


HYPOTHESIS = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@HYPOTHESIS
@given(data=st.data())
def test_any_change_of_llffs_bounds(data: st.DataObject, images: Path) -> None:
    rows = bounds()
    for _ in range(data.draw(st.integers(1, 3))):
        rows[data.draw(st.integers(0, COUNT - 1)), data.draw(st.integers(0, 16))] = data.draw(NUMBERS)
    saved = io.BytesIO()
    np.save(saved, rows)
    clear(images)
    (images / "poses_bounds.npy").write_bytes(data.draw(mutated(saved.getvalue(), most=120)))
    accept(images)


@pytest.mark.slow
@HYPOTHESIS
@given(data=st.data())
def test_any_change_of_a_mask(data: st.DataObject, images: Path) -> None:
    """A PNG, or a JPEG that says how to turn it."""
    clear(images)
    (images / "transforms.json").write_text(json.dumps(transforms(PINHOLE)))
    shape = data.draw(st.sampled_from([(HEIGHT, WIDTH), (WIDTH, HEIGHT), (3, 3)]))
    mask = np.zeros(shape, data.draw(st.sampled_from([np.uint8, np.uint16])))
    mask[:2] = 255
    content = iio.imwrite("<bytes>", mask, extension=".png")
    if data.draw(st.booleans()):
        content = turned_jpeg(mask.astype(np.uint8), data.draw(st.integers(1, 9)))
    (images / "masks").mkdir(exist_ok=True)
    (images / "masks" / f"{NAMES[1]}.png").write_bytes(data.draw(mutated(content, most=80)))
    accept(images)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mutated")
    write_images(folder / "images")
    return folder


VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(-3, 50), st.floats(), st.text(max_size=5), st.just([]), st.just({}),
    st.sampled_from([1e308, -1e308, 1e-308, 2**70, "../x", "images", "/", [[1]], [0.0] * 4]),
)  # fmt: skip


NUMBERS = st.one_of(st.floats(), st.sampled_from([0.0, -1.0, 1e-300, 1e9, 1e300]))


def clear(folder: Path) -> None:
    """Leave the images alone."""
    for path in folder.iterdir():
        if path.is_dir() and path.name != "images":
            shutil.rmtree(path)
        elif path.is_file():
            path.unlink()


@st.composite
def mutated(draw: st.DrawFn, content: bytes, most: int) -> bytes:
    """Bytes of which some are replaced, among the first `most`, or the last ones are missing; or all as they are."""
    changed = bytearray(content)
    for _ in range(draw(st.integers(0, 3))):
        start = draw(st.integers(0, min(len(changed), most)))
        changed[start : start + draw(st.integers(0, 9))] = draw(st.binary(max_size=9))
    return bytes(changed[: draw(st.integers(0, len(changed)))] if draw(st.booleans()) else changed)


def _places(value: Any, path: tuple = ()) -> list[tuple]:
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path] * bool(path) + [place for key, child in children for place in _places(child, (*path, key))]


@pytest.mark.parametrize("name", ["transforms.json", "transforms_train.json"])
@HYPOTHESIS
@given(data=st.data())
def test_any_change_of_a_json(name: str, data: st.DataObject, images: Path) -> None:
    document = transforms(OPENCV)
    for path in data.draw(st.lists(st.sampled_from(_places(document)), min_size=1, max_size=3)):
        target: Any = document
        try:
            for key in path[:-1]:
                target = target[key]
            target[path[-1]] = copy.deepcopy(data.draw(VALUES))
        except (TypeError, KeyError, IndexError):
            continue  # an earlier change took that place
    clear(images)
    (images / name).write_text(json.dumps(document))
    accept(images)


@pytest.mark.slow
@pytest.mark.parametrize("text", [False, True])
@HYPOTHESIS
@given(data=st.data())
def test_any_change_of_a_model(text: bool, data: st.DataObject, images: Path) -> None:
    clear(images)
    (images / "sparse").mkdir()
    files = colmap_files(OPENCV, text)
    changed = data.draw(st.sampled_from(sorted(files)))
    files[changed] = data.draw(mutated(files[changed], most=400))
    for name, value in files.items():
        (images / "sparse" / name).write_bytes(value)
    accept(images)
