"""Blender folders that cannot be used: each is refused in one line that says where, what, and what to do."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import imageio.v3 as iio
import numpy as np
import pytest
from blender_folder import HEIGHT, WIDTH, pixels, png, write_json, write_scene

from edge_se_sampler.data import frames, image_file
from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.errors import InputError

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")  # numpy's overflow is no message for a person

Doc = dict[str, Any]
JSON = "transforms_train.json"
DELETE = object()
LONG = 10**6


def refusal(folder: Path, split: Literal["train", "val", "test"] = "train") -> str:
    """The message of the InputError that reading raises, checked for what every message must be."""
    with pytest.raises(InputError) as caught:
        read_blender(folder, split)
    message = str(caught.value)
    assert message.isprintable(), "one line, nothing unescaped"
    assert len(message) < 800
    location, problem, hint = re.fullmatch(r"(.*?): (.*?); (.*)", message).groups()  # type: ignore[union-attr]
    assert all(len(part) > 5 for part in (location, problem, hint))
    return message


def put(keys: str, value: object) -> Callable[[Doc], None]:
    """The change that sets (or, for DELETE, removes) the field at e.g. "frames 1 file_path"."""

    def change(doc: Doc) -> None:
        *path, last = [int(key) if key.isdigit() else key for key in keys.split()]
        target: Any = doc
        for key in path:
            target = target[key]
        if value is DELETE:
            del target[last]
        else:
            target[last] = value

    return change


def _name(value: Any) -> str:
    """The same in every process."""
    return "deleted" if value is DELETE else f"{str(value)[:25]!a}".replace("\\x00", "NUL")


def bad(keys: str, *values: object, says: str, field: str = "") -> list[Any]:
    """Table rows: at `keys` each of `values`, refused for `field` with a message like `says`."""
    named = field or re.sub(r" (\d+)", r"[\1]", keys).replace(" ", ".")
    return [pytest.param(put(keys, value), named, says, id=f"{keys}={_name(value)}") for value in values]


def rotated(scale: float = 1, mirror: bool = False, last: tuple[float, ...] = (0, 0, 0, 1)) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, :3] *= scale
    matrix[0, 0] *= -1 if mirror else 1
    matrix[3] = last
    return matrix.tolist()


MATRIX = "frames 2 transform_matrix"
IMAGE = "frames 1 file_path"
MASK = "frames 1 mask_path"
NUMBER = "must be a number"
NOT_FINITE = "NaN, Infinity or too large"

FIELDS = [
    *bad("frames", DELETE, says="is missing.*list each view"),
    *bad("frames", {}, "text", None, 3, True, says="must be a list"),
    *bad("frames", [], says="is empty"),
    *bad("frames 1", [], "text", None, 3, says="must be a json object"),
    *bad("camera_angle_x", DELETE, says="is missing.*radians"),
    *bad("camera_angle_x", 0, -0.5, 3.15, 39.6, 1e-300, 5e-324, says="between 0 and pi.*radians"),
    *bad("camera_angle_x", np.pi, says="between 0 and pi"),
    *bad("camera_angle_x", "0.69", "", True, None, [0.69], says=NUMBER),
    *bad("camera_angle_x", float("nan"), float("inf"), says=NOT_FINITE),
    *bad("camera_angle_x", 10**400, says="fits a double"),
    *bad(IMAGE, DELETE, says="is missing.*relative"),
    *bad(IMAGE, "", "  ", 3, None, ["r_1"], True, says="non-empty text"),
    *bad(IMAGE, "train/r_1\0", "\ud800", says="no file name can have"),
    *bad(IMAGE, "train/nowhere", "train/r_1.jpg", "x" * LONG, "new\nline\x1b[31m", says="does not exist|too long"),
    *bad(IMAGE, "/etc/passwd", "/nowhere.png", says="absolute.*relative"),
    *bad(IMAGE, "../outside", "train/../../outside", says="leads out"),
    *bad(IMAGE, "./train/r_0", "train//r_0.png", "train/../train/r_0", says=r"already the image of frames\[0\]"),
    *bad(MASK, "", 3, None, says="non-empty text"),
    *bad(MASK, "mask\0.png", says="no file name can have"),
    *bad(MASK, "train/nowhere.png", says="does not exist"),
    *bad(MASK, "/etc/passwd", says="absolute"),
    *bad(MASK, "../outside", says="leads out"),
    *bad(MATRIX, DELETE, says="is missing.*4x4"),
    *bad(MATRIX, None, "text", 3, {}, says="must be a list"),
    *bad(MATRIX, [], np.eye(4)[:3].tolist(), np.eye(3).tolist(), np.eye(5).tolist(), [1] * 16, says="4 rows of 4"),
    *bad(MATRIX, [[1, 0, 0, 0], [0, 1, 0], [0, 0, 1, 0], [0, 0, 0, 1]], says="4 rows of 4"),
    *bad(MATRIX, rotated(scale=1.01), rotated(scale=0), rotated(scale=1e200), says="rigid.*remove scale"),
    *bad(MATRIX, rotated(mirror=True), says="rigid.*mirroring"),
    *bad(MATRIX, rotated(last=(0, 0, 0, 2)), rotated(last=(1, 2, 3, 1)), says=r"\[0, 0, 0, 1\].*transposed"),
    *bad(f"{MATRIX} 0 3", "1.5", None, True, [1], says=NUMBER),
    *bad(f"{MATRIX} 0 3", float("nan"), float("-inf"), says=NOT_FINITE),
    *bad(f"{MATRIX} 0 3", 10**400, says="fits a double"),
    *bad("w", 0, -6, says="positive"),
    *bad("w", 6.5, says="whole"),
    *bad("h", "4", True, None, says=NUMBER),
    *bad("frames 1 w", 0.5, says="whole"),
    *bad("w", WIDTH + 1, says=f"is 7, but.*r_0.*{WIDTH} x {HEIGHT}.*correct w"),
    *bad("frames 1 h", WIDTH, says=f"is 6, but.*r_1.*{WIDTH} x {HEIGHT}.*correct h"),
    *bad("cx", "3", True, says=NUMBER),
    *bad("frames 1 cy", float("inf"), says=NOT_FINITE),
    *bad("fl_x", 0, -1, says="positive"),
    *bad("frames 1 fl_y", "4", says=NUMBER),
    *bad("extra", [{"a b": float("nan")}], says=NOT_FINITE, field="extra[0]['a b']"),
    *bad("frames", ["\n" * LONG], says="json object", field="frames[0]"),
]


@pytest.fixture
def doc(tmp_path: Path) -> Doc:
    """A good scene in tmp_path/scene, of which a test then spoils something; beside it an image to lead out to."""
    iio.imwrite(tmp_path / "outside.png", pixels(0))
    return write_scene(tmp_path / "scene")


@pytest.mark.parametrize(("change", "field", "says"), FIELDS)
def test_a_bad_field(tmp_path: Path, doc: Doc, change: Callable[[Doc], None], field: str, says: str) -> None:
    change(doc)
    write_json(tmp_path / "scene", doc)
    message = refusal(tmp_path / "scene")
    assert f"{JSON}: {field}" in message
    assert re.search(says, message)


def test_without_an_angle_the_frame_that_needs_it_is_named(tmp_path: Path, doc: Doc) -> None:
    del doc["camera_angle_x"]
    doc["frames"][0]["fl_x"] = 9
    doc["frames"][1]["fl_y"] = 9
    write_json(tmp_path / "scene", doc)
    assert re.search(r"camera_angle_x: is missing; .*frames\[1\]", refusal(tmp_path / "scene"))


def test_a_bad_angle_is_refused_even_where_fl_x_overrides_it(tmp_path: Path, doc: Doc) -> None:
    write_json(tmp_path / "scene", doc | {"fl_x": 9, "camera_angle_x": -1})
    assert "camera_angle_x: must lie" in refusal(tmp_path / "scene")


@pytest.mark.parametrize(
    ("data", "says"),
    [
        pytest.param(b"", r"is empty \(0 bytes\)", id="empty"),
        pytest.param(b'{\n "frames": [}', "not valid json.*line 2 column 13", id="broken"),
        pytest.param(b'{"frames": [', "not valid json.*line 1", id="cut short"),
        pytest.param(b'{"a": "\xff"}', r"not UTF-8 text \(byte 7\)", id="latin-1"),
        pytest.param('{"frames": []}'.encode("utf-16"), "not UTF-8", id="UTF-16"),
        pytest.param(b"[]", "must be a json object", id="a list"),
        pytest.param(b"null", "must be a json object", id="null"),
        pytest.param(b"NaN", NOT_FINITE, id="NaN"),
        pytest.param(b'{"camera_angle_x": 1e400}', "camera_angle_x: is NaN", id="1e400"),
        pytest.param(b'{"camera_angle_x": -Infinity}', "camera_angle_x: is NaN", id="-Infinity"),
        pytest.param(b'{"camera_angle_x": ' + b"9" * 10000 + b"}", "digits", id="an integer of 10000 digits"),
        pytest.param(b"[" * 200_000, "nested too deeply", id="deeply nested"),
        pytest.param(b'{"frames": ' + b"[" * 500 + b"]" * 500 + b"}", r"frames\[0\]: must be a json", id="nested"),
        pytest.param(b"\x89PNG\r\n\x1a\n\0", "not UTF-8", id="an image"),
    ],
)
def test_a_bad_json_file(tmp_path: Path, data: bytes, says: str) -> None:
    (tmp_path / JSON).write_bytes(data)
    message = refusal(tmp_path)
    assert JSON in message
    assert re.search(says, message)


def cut(file: bytes, by: int) -> bytes:
    return file[:-by]


GOOD_PNG = iio.imwrite("<bytes>", pixels(0, 32, 32), extension=".png")
GOOD_JPEG = iio.imwrite("<bytes>", pixels(0, 32, 32, 3), extension=".jpg")
FLIPPED = GOOD_PNG[:100] + bytes([GOOD_PNG[100] ^ 1]) + GOOD_PNG[101:]
ZEROED = GOOD_PNG[: len(GOOD_PNG) // 2].ljust(len(GOOD_PNG), b"\0")
CMYK_JPEG = iio.imwrite("<bytes>", pixels(0, 32, 32), extension=".jpg", mode="CMYK")

IMAGES = [
    pytest.param(b"", r"is empty \(0 bytes\)", id="empty"),
    pytest.param(b"not an image", "not a PNG or JPEG", id="text"),
    pytest.param(iio.imwrite("<bytes>", pixels(0), extension=".bmp"), "not a PNG or JPEG", id="bmp"),
    *[
        pytest.param(cut(GOOD_PNG, by), "is truncated or damaged", id=f"png cut by {by}")
        for by in (1, 4, 12, 13, 20, 500, len(GOOD_PNG) - 30, len(GOOD_PNG) - 8)
    ],
    *[
        pytest.param(cut(GOOD_JPEG, by), "truncated", id=f"jpeg cut by {by}")
        for by in (1, 2, 3, 20, 500, len(GOOD_JPEG) - 3)
    ],
    pytest.param(FLIPPED, "is truncated or damaged", id="png with one bit flipped"),
    pytest.param(ZEROED, "is truncated or damaged", id="png of which half is zeros"),
    pytest.param(png(6, 4, 16, 2, (b"\0" + b"\1" * 36) * 4), "16-bit.*8 bits", id="16-bit RGB"),
    pytest.param(png(6, 4, 16, 6, (b"\0" + b"\1" * 48) * 4), "16-bit.*8 bits", id="16-bit RGBA"),
    pytest.param(png(6, 4, 16, 0, (b"\0" + b"\1" * 12) * 4), "16-bit.*8 bits", id="16-bit gray"),
    pytest.param(png(0, 4, 8, 2, b"\0" * 4), "zero size", id="no columns"),
    pytest.param(png(6, 0, 8, 2, b""), "zero size", id="no rows"),
    pytest.param(png(10**5, 10**5, 8, 2, b"\0"), r"has more than 178,956,970 pixels; make it", id="a bomb"),
    pytest.param(png(6, 4, 8, 2, b"\0" * 30), "cannot be decoded", id="rows missing"),
    pytest.param(png(6, 4, 3, 2, b"\0" * 76), "cannot be decoded", id="nonsense in the header"),
    pytest.param(CMYK_JPEG, "CMYK.*RGB", id="CMYK"),
    pytest.param(iio.imwrite("<bytes>", pixels(0, 9, 5), extension=".png"), "9 x 5 pixels.*6 x 4", id="another size"),
]


@pytest.mark.parametrize("key", ["file_path", "mask_path"])
@pytest.mark.parametrize(("data", "says"), IMAGES)
def test_a_bad_image_or_mask(tmp_path: Path, doc: Doc, key: str, data: bytes, says: str) -> None:
    (tmp_path / "scene/bad.png").write_bytes(data)
    doc["frames"][2][key] = "bad"
    write_json(tmp_path / "scene", doc)
    message = refusal(tmp_path / "scene")
    assert f"{JSON}: frames[2].{key}: 'bad.png'" in message
    assert re.search(says, message)


@pytest.mark.parametrize("key", ["file_path", "mask_path"])
@pytest.mark.parametrize(
    ("make", "says"),
    [
        pytest.param(os.mkdir, "is a directory", id="a directory"),
        pytest.param(os.mkfifo, "not a regular file", id="a pipe"),
        pytest.param(lambda path: os.symlink("nowhere.png", path), "does not exist", id="a link to nowhere"),
        pytest.param(lambda path: os.symlink("bad.png", path), "cannot be read|does not exist", id="a link to itself"),
        pytest.param(lambda path: os.symlink("../outside.png", path), "leads out", id="a link out"),
    ],
)
def test_a_path_that_is_no_regular_file(
    tmp_path: Path, doc: Doc, key: str, make: Callable[[Path], None], says: str
) -> None:
    make(tmp_path / "scene/bad.png")
    doc["frames"][2][key] = "bad.png"
    write_json(tmp_path / "scene", doc)
    message = refusal(tmp_path / "scene")
    assert f"{JSON}: frames[2].{key}: 'bad.png'" in message
    assert re.search(says, message)


def test_a_sibling_folder_whose_name_begins_alike_is_outside(tmp_path: Path, doc: Doc) -> None:
    write_scene(tmp_path / "scene2")
    doc["frames"][1]["file_path"] = "../scene2/train/r_1"
    write_json(tmp_path / "scene", doc)
    assert "leads out" in refusal(tmp_path / "scene")


def test_two_frames_of_one_image_through_a_link(tmp_path: Path, doc: Doc) -> None:
    os.symlink("r_0.png", tmp_path / "scene/train/link.png")
    doc["frames"][2]["file_path"] = "train/link"
    write_json(tmp_path / "scene", doc)
    assert re.search(r"frames\[2\]\.file_path: .*already the image of frames\[0\]", refusal(tmp_path / "scene"))


def test_masks_that_hide_every_pixel(tmp_path: Path, doc: Doc) -> None:
    iio.imwrite(tmp_path / "scene/mask.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    for frame in doc["frames"]:
        frame["mask_path"] = "mask.png"
    write_json(tmp_path / "scene", doc)
    assert f"{JSON}: frames: all pixels of all views are masked" in refusal(tmp_path / "scene")


@pytest.mark.parametrize("name", [JSON, "train/r_1.png"])
def test_a_file_that_may_not_be_read_is_reported_even_to_root(
    tmp_path: Path, doc: Doc, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Refused by a stand-in for the system: root, as which tests may run, may read everything."""
    read = Path.read_bytes

    def guarded(path: Path) -> bytes:
        if path == tmp_path / "scene" / name:
            raise PermissionError(13, "Permission denied")
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", guarded)
    message = refusal(tmp_path / "scene")
    assert Path(name).name in message
    assert "permission denied" in message


@pytest.mark.parametrize("name", [".", JSON, "train/r_1.png"])
def test_a_file_or_folder_that_may_not_be_read(tmp_path: Path, doc: Doc, name: str) -> None:
    path = tmp_path / "scene" / name
    mode = path.stat().st_mode
    path.chmod(0)
    try:
        if os.access(path, os.R_OK):
            pytest.skip("root may read everything")
        assert "permission denied" in refusal(tmp_path / "scene")
    finally:
        path.chmod(mode)


def test_no_such_folder(tmp_path: Path) -> None:
    assert "nowhere: no such folder" in refusal(tmp_path / "nowhere")
    assert r"no\nwhere: no such folder" in refusal(tmp_path / "no\nwhere")
    assert "no such folder" in refusal(tmp_path / "nul\0")


def test_a_folder_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "scene.zip").touch()
    assert "scene.zip: is not a folder" in refusal(tmp_path / "scene.zip")


def test_no_such_split(tmp_path: Path, doc: Doc) -> None:
    write_json(tmp_path / "scene", doc, "val")
    message = refusal(tmp_path / "scene", "test")
    assert re.search(r"no transforms_test\.json, only transforms_train\.json, transforms_val\.json;", message)
    (tmp_path / "empty").mkdir()
    assert re.search(r"no transforms_train\.json.*; .*transforms_train\.json", refusal(tmp_path / "empty"))


def test_transforms_that_is_a_directory(tmp_path: Path) -> None:
    (tmp_path / JSON).mkdir()
    assert f"{JSON}: is a directory" in refusal(tmp_path)


def test_the_json_is_checked_to_its_end_before_any_image(
    tmp_path: Path, doc: Doc, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*args: object) -> None:
        raise AssertionError("an image was read")

    monkeypatch.setattr(frames, "read_image", never)
    monkeypatch.setattr(image_file, "read_image", never)
    for change in (put(f"{MATRIX} 2 2", 5), put("frames 2 file_path", "../outside"), put("frames 2 mask_path", 1)):
        spoilt = json.loads(json.dumps(doc))
        change(spoilt)
        write_json(tmp_path / "scene", spoilt)
        assert "frames[2]" in refusal(tmp_path / "scene")
