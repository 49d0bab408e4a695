"""COLMAP's sparse models: cameras, images and points3D, binary or text (COLMAP's documentation, "Output Format").

Every count is compared with the bytes that are left before memory is asked for.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edge_se_sampler.data.lens import Intrinsics, Lens
from edge_se_sampler.data.scene_file import SourceFile, SourceLocation, quote
from edge_se_sampler.errors import InputError

MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
"""COLMAP's number of a model -> its name, and how many parameters it has."""
SUPPORTED = [name for name, _ in list(MODELS.values())[:6]]
MAX_SIZE = 10**6
"""Pixels, of a side."""
MAX_COORDINATE = 1e30
"""World units: products of larger ones overflow."""


@dataclass(frozen=True)
class ColmapCamera:
    """A camera, and the size of the images that it took."""

    width: int
    height: int
    intrinsics: Intrinsics


@dataclass(frozen=True)
class ColmapImage:
    """A registered image."""

    location: SourceLocation
    name: str
    """Its file, relative to the folder of images."""
    pose: np.ndarray
    """(3, 4) float64, camera to world, OpenGL's axes."""
    camera_id: int
    point_ids: np.ndarray
    """(m,) int64: the points that it sees, -1 for features that are none."""


def find_models(folder: Path) -> list[Path]:
    """The folders with cameras, images and points3D of a scene, the one to read first: where COLMAP could not connect
    all images and made several, the one with the largest list of them."""
    for sparse in (folder / "sparse", folder / "colmap" / "sparse"):
        numbered = [path for path in sorted(sparse.glob("*")) if path.name.isdecimal()]
        if models := [path for path in numbered if _file_of(path, "cameras").exists()]:
            return sorted(models, key=lambda model: -_size_of(model, "images"))
        if _file_of(sparse, "cameras").exists():
            return [sparse]
    return []


def read_cameras(model: Path) -> dict[int, ColmapCamera]:
    """The cameras by their ids."""
    cameras = {}
    path = _file_of(model, "cameras")
    for location, number, name, values in (_text_cameras if path.suffix == ".txt" else _binary_cameras)(path):
        if number in cameras:
            raise location.error(f"is a second camera {number}", "give every camera an id of its own")
        cameras[number] = _camera(location, name, values)
    if not cameras:
        raise SourceLocation(path).error("has no cameras", "use the model of a reconstruction that succeeded")
    return cameras


def read_images(model: Path) -> list[ColmapImage]:
    """The registered images, in the order of the file."""
    path = _file_of(model, "images")
    images = list((_text_images if path.suffix == ".txt" else _binary_images)(path))
    if not images:
        raise SourceLocation(path).error("has no images", "use the model of a reconstruction that succeeded")
    return images


def read_points(model: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Ids (m,) int64, ascending, and positions (m, 3) float64 of the model's points; None if it has no such file."""
    if not any((model / f"points3D.{suffix}").exists() for suffix in ("bin", "txt")):
        return None
    path = _file_of(model, "points3D")
    if path.suffix == ".txt" and path.stat().st_size == 0:  # as COLMAP has it where poses are known
        return None
    records = list((_text_points if path.suffix == ".txt" else _binary_points)(path))
    ids = np.array([number for number, _ in records], dtype=np.int64)
    positions = np.array([position for _, position in records], dtype=np.float64).reshape(-1, 3)
    valid = (np.abs(positions) < MAX_COORDINATE).all(axis=1)
    if not valid.all():
        bad = int(np.flatnonzero(~valid)[0])
        raise SourceLocation(path).item(bad).error("its position is not finite", "write the model again")
    order = np.argsort(ids, kind="stable")
    return ids[order], positions[order]


def _file_of(model: Path, name: str) -> Path:
    binary, text = model / f"{name}.bin", model / f"{name}.txt"
    is_binary = binary.exists() or ((model / "cameras.bin").exists() and not text.exists())
    return binary if is_binary else text


def _size_of(model: Path, name: str) -> int:
    file = _file_of(model, name)
    return file.stat().st_size if file.exists() else 0


def _camera(location: SourceLocation, name: str, values: list[float]) -> ColmapCamera:
    if name not in SUPPORTED:
        hint = f"undistort the images (colmap image_undistorter); read are {', '.join(SUPPORTED)}"
        raise location.error(f"its model {quote(name)} is not supported", hint)
    (width, height), p = values[:2], values[2:]
    expected = dict(MODELS.values())[name]
    if len(p) != expected:
        raise location.error(f"has {len(p)} parameters, {name} has {expected}", "write the model again")
    if not all(size.is_integer() and 1 <= size <= MAX_SIZE for size in (width, height)):
        problem = f"its images have {width:g} x {height:g} pixels"
        raise location.error(problem, f"whole numbers from 1 to {MAX_SIZE} are expected")
    focal_count = 2 if name in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE") else 1
    if not np.isfinite(p).all() or min(p[:focal_count]) <= 0:
        raise location.error("its parameters are not finite, or its focal length is not above 0", "write them again")
    fx, fy, (cx, cy), terms = p[0], p[focal_count - 1], p[focal_count : focal_count + 2], p[focal_count + 2 :]
    lens = None
    if name == "OPENCV_FISHEYE":
        lens = Lens(True, tuple(terms))
    elif any(terms):
        lens = Lens(False, (*terms, *[0.0] * (5 - len(terms))))
    return ColmapCamera(int(width), int(height), Intrinsics(fx, fy, cx, cy, lens))


def _image(
    location: SourceLocation, name: str, camera_id: int, motion: list[float], point_ids: np.ndarray
) -> ColmapImage:
    """`motion`: quaternion w, x, y, z and translation, world to camera, OpenCV's axes."""
    if not np.abs(motion).max() < MAX_COORDINATE or (norm := float(np.linalg.norm(motion[:4]))) < 1e-6:
        raise location.error("its pose is not finite, or no rotation", "write the model again")
    w, x, y, z = (value / norm for value in motion[:4])
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    position = -rotation.T @ motion[4:]
    pose = np.concatenate((rotation.T * (1, -1, -1), position[:, None]), axis=1)
    return ColmapImage(location, name, pose, camera_id, point_ids)


class _Cursor:
    """Reads a binary file from its start, and refuses what goes beyond its end."""

    def __init__(self, path: Path) -> None:
        self.location = SourceLocation(path)
        self.data, self.position = SourceFile(path, self.location).read_bytes(), 0

    def read(self, layout: str, location: SourceLocation) -> tuple:
        self.require(struct.calcsize("<" + layout), location)
        values = struct.unpack_from("<" + layout, self.data, self.position)
        self.position += struct.calcsize("<" + layout)
        return values

    def count(self, least_bytes: int, location: SourceLocation) -> int:
        """A number of records of at least so many bytes each."""
        (count,) = self.read("Q", location)
        self.require(count * least_bytes, location)
        return count

    def require(self, num_bytes: int, location: SourceLocation) -> None:
        if num_bytes > len(self.data) - self.position:
            problem = f"the file ends within it (byte {len(self.data)}), or a count in it is wrong"
            raise location.error(problem, "copy the model again")

    def records(self, what: str, least_bytes: int) -> Iterator[SourceLocation]:
        """The location of each record of the file."""
        top = self.location.member(what)
        for i in range(self.count(least_bytes, top)):
            yield top.item(i)

    def text(self, location: SourceLocation) -> str:
        """Text up to a zero byte."""
        end = self.data.find(b"\0", self.position)
        if end < 0:
            raise location.error("the file ends within its name", "copy the model again")
        raw, self.position = self.data[self.position : end], end + 1
        return _decode(raw, location)


def _decode(raw: bytes, location: SourceLocation) -> str:
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        raise location.error("its name is not UTF-8", "rename the image") from None


def _binary_cameras(path: Path) -> Iterator[tuple[SourceLocation, int, str, list[float]]]:
    cursor = _Cursor(path)
    for location in cursor.records("cameras", 48):
        number, model, width, height = cursor.read("IiQQ", location)
        name, count = MODELS.get(model, (f"number {model}", 0))
        yield location, number, name, [float(width), float(height), *cursor.read(f"{count}d", location)]


def _binary_images(path: Path) -> Iterator[ColmapImage]:
    cursor = _Cursor(path)
    for location in cursor.records("images", 73):
        _, *motion, camera_id = cursor.read("I7dI", location)
        name = cursor.text(location)
        count = cursor.count(24, location)
        layout = np.dtype([("xy", "<f8", 2), ("id", "<i8")])
        points = np.frombuffer(cursor.data, layout, count, cursor.position)
        cursor.position += count * layout.itemsize
        yield _image(location, name, camera_id, motion, points["id"].copy())


def _binary_points(path: Path) -> Iterator[tuple[int, tuple[float, ...]]]:
    cursor = _Cursor(path)
    for location in cursor.records("points3D", 51):
        number, x, y, z = cursor.read("q3d", location)
        cursor.read("3Bd", location)
        track = cursor.count(8, location)
        cursor.position += 8 * track
        yield number, (x, y, z)


def _lines(path: Path) -> Iterator[tuple[SourceLocation, str]]:
    """The lines of a text file that are no comments."""
    location = SourceLocation(path)
    text = _decode(SourceFile(path, location).read_bytes(), location)
    for i, line in enumerate(text.split("\n")):  # names may have what else `splitlines` splits at
        if not line.startswith("#"):
            yield SourceLocation(path, f"line {i + 1}"), line.rstrip("\r")


def _numbers(location: SourceLocation, words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError:
        raise _no_numbers(location, words) from None


def _ids(location: SourceLocation, words: list[str]) -> list[int]:
    """Whole numbers of 64 bits."""
    try:
        numbers = [int(word) for word in words]
    except ValueError:
        raise _no_numbers(location, words) from None
    if any(not -(2**63) <= number < 2**63 for number in numbers):
        raise location.error("has an id of more than 64 bits", "write the model again")
    return numbers


def _no_numbers(location: SourceLocation, words: list[str]) -> InputError:
    return location.error(f"has {quote(' '.join(words))} where numbers belong", "write the model again")


def _words(location: SourceLocation, words: list[str], count: int) -> list[str]:
    if len(words) < count:
        raise location.error(f"has {len(words)} entries, at least {count} are expected", "write the model again")
    return words


def _text_cameras(path: Path) -> Iterator[tuple[SourceLocation, int, str, list[float]]]:
    for location, line in _lines(path):
        if words := line.split():
            number, name, *values = _words(location, words, 4)
            yield location, _ids(location, [number])[0], name, _numbers(location, values)


def _text_images(path: Path) -> Iterator[ColmapImage]:
    lines = _lines(path)
    for location, line in lines:
        if not (words := line.split(None, 9)):  # a name, the tenth, may have blanks
            continue
        motion = _numbers(location, _words(location, words, 10)[1:8])
        (camera_id,) = _ids(location, words[8:9])
        _, points = next(lines, (location, ""))  # an empty line for an image that sees none
        point_ids = np.array(_ids(location, points.split()[2::3]), dtype=np.int64)
        yield _image(location, words[9].rstrip(), camera_id, motion, point_ids)


def _text_points(path: Path) -> Iterator[tuple[int, tuple[float, ...]]]:
    for location, line in _lines(path):
        if words := line.split():
            (number,) = _ids(location, _words(location, words, 4)[:1])
            yield number, tuple(_numbers(location, words[1:4]))
