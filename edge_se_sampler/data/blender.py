"""Folders in the format of NeRF's Blender scenes (NeRF-synthetic): transforms_{train,val,test}.json and images."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from edge_se_sampler.data import json_schema as field
from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.image_file import ImageFile, read_image
from edge_se_sampler.data.source_location import Where, shown
from edge_se_sampler.data.views import Views

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)

_SUFFIXES = (".png", ".jpg", ".jpeg")
_RIGID_TOLERANCE = 1e-3  # of the rotation's entries: real files are rounded
_LAST_ROW_TOLERANCE = 1e-6  # 0 and 1 survive rounding, so this only forgives arithmetic
_LEAST_ANGLE = 1e-6  # radians; below, focal lengths overflow before they mean anything

# What a frame, or the file for all frames, may say of its camera: sizes and lengths in pixels
_SETTINGS: dict[str, field.Check[float]] = {
    "w": field.count,
    "h": field.count,
    "cx": field.number,
    "cy": field.number,
    "fl_x": field.positive,
    "fl_y": field.positive,
}

_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


@dataclass(frozen=True)
class _Setting:
    value: float
    where: Where  # the frame's own field, or the file's


@dataclass(frozen=True)
class _Frame:
    """An entry of `frames`, checked as far as the json alone allows."""

    where: Where
    name: str  # file_path
    mask_name: str | None  # mask_path
    pose: np.ndarray  # (3, 4) float64, camera to world
    settings: dict[str, _Setting]  # by their names in _SETTINGS; the frame's own win over the file's

    def get(self, key: str, default: float) -> float:
        return self.settings[key].value if key in self.settings else default


def transforms_path(folder: Path, split: str) -> Path:
    """The json of a split."""
    return folder / f"transforms_{split}.json"


def listed_file(name: str) -> str:
    """The file, relative to the folder, that a file_path or mask_path means: .png may be left out."""
    return name if name.lower().endswith(_SUFFIXES) else f"{name}.png"


def has_split(folder: Path, split: str) -> bool:
    """Whether the folder has a transforms_<split>.json."""
    return os.path.exists(transforms_path(Path(folder), split))


def read_blender(folder: Path, split: Split) -> Views:
    """Read one split of a scene; the files that no frame lists are not looked at.

    Poses are given as written (not moved, scaled or made orthonormal). Without masks every pixel counts; if some
    frames have one, the others count whole. Raises InputError, in one line, for anything that cannot be used:
    first for the folder, then for the json, then for paths, and only then for the images.
    """
    folder = Path(folder)
    _check_folder(folder, split)
    where = Where(transforms_path(folder, split))
    top = field.load_object(where)
    frames = _frames(top, where)
    half_tan = _half_tan(top, where, frames)
    files = [_locate(frame.name, frame.where.key("file_path"), folder) for frame in frames]
    _check_distinct(files)
    mask_files = [
        _locate(frame.mask_name, frame.where.key("mask_path"), folder) if frame.mask_name is not None else None
        for frame in frames
    ]
    with ThreadPoolExecutor() as pool:  # decoding leaves Python's lock to others
        images = tuple(pool.map(read_image, files))
        _check_sizes(frames, files, images)
        masks = tuple(pool.map(_read_mask, mask_files, images)) if any(mask_files) else None
    if masks is not None and not any(mask.any() for mask in masks):
        raise where.key("frames").error("all pixels of all views are masked", "masks are non-zero where to train")
    return Views(tuple(frame.name for frame in frames), images, masks, _cameras(frames, images, half_tan))


def _check_folder(folder: Path, split: str) -> None:
    """Raise InputError unless `folder` is a folder that has the split."""
    where = Where(folder)
    if not os.path.lexists(folder):
        raise where.error("no such folder", "give the folder that has the transforms_*.json files")
    if not os.path.isdir(folder):
        raise where.error("is not a folder", "give the folder that has the transforms_*.json files")
    if not os.access(folder, os.R_OK | os.X_OK):
        raise where.error("may not be read (permission denied)", "change the folder's permissions")
    if has_split(folder, split):
        return
    found = ", ".join(transforms_path(folder, other).name for other in SPLITS if has_split(folder, other))
    hint = "a Blender scene has transforms_train.json and, for other splits, transforms_val.json, transforms_test.json"
    has = f"only {found}" if found else "nor that of any other split"
    raise where.error(f"has no {transforms_path(folder, split).name}, {has}", hint)


def _frames(top: field.Object, where: Where) -> list[_Frame]:
    """All entries of `frames`, checked."""
    hint = "list each view as {file_path, transform_matrix}"
    entries = field.required(top, "frames", where, field.as_list, hint)
    if not entries:
        raise where.key("frames").error("is empty", hint)
    shared = _settings(top, where)
    return [_frame(entry, where.key("frames").item(i), shared) for i, entry in enumerate(entries)]


def _frame(entry: Any, where: Where, shared: dict[str, _Setting]) -> _Frame:
    frame = field.as_object(entry, where)
    hint = "write the image's path, relative to the folder, without .png"
    return _Frame(
        where=where,
        name=field.required(frame, "file_path", where, field.path_text, hint),
        mask_name=field.optional(frame, "mask_path", where, field.path_text),
        pose=field.required(frame, "transform_matrix", where, _pose, "write the 4x4 camera-to-world matrix"),
        settings={**shared, **_settings(frame, where)},
    )


def _settings(parent: field.Object, where: Where) -> dict[str, _Setting]:
    for key in _DISTORTION:
        if key in parent and field.number(parent[key], where.key(key)) != 0:
            problem = f"is {shown(parent[key])}, but rays here know no lens distortion"
            raise where.key(key).error(problem, "undistort the images, and leave it out")
    return {
        key: _Setting(check(parent[key], where.key(key)), where.key(key))
        for key, check in _SETTINGS.items()
        if key in parent
    }


def _pose(value: Any, where: Where) -> np.ndarray:
    """The upper (3, 4) float64 of a rigid camera-to-world matrix; InputError for anything else."""
    rows = field.as_list(value, where)
    if len(rows) != 4 or any(not isinstance(row, list) or len(row) != 4 for row in rows):
        raise where.error(f"must be 4 rows of 4 numbers, not {shown(value)}", "write the 4x4 camera-to-world matrix")
    matrix = np.array(
        [[field.number(x, where.item(i).item(j)) for j, x in enumerate(row)] for i, row in enumerate(rows)]
    )
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > _LAST_ROW_TOLERANCE:
        raise where.error(
            f"its last row must be [0, 0, 0, 1], not {shown(rows[3])}",
            "put the translation in the last column (transposed?)",
        )
    if not _is_rotation(matrix[:3, :3]):
        hint = "its upper left 3x3 must be orthonormal with determinant +1: remove scale, shear and mirroring"
        raise where.error("is not a rigid motion", hint)
    return matrix[:3]


def _is_rotation(r: np.ndarray) -> bool:
    """Whether (3, 3) `r` is orthonormal and no mirroring, up to rounding."""
    if np.abs(r).max() > 2:  # no rotation has such entries, and the products below might overflow
        return False
    off = np.abs(r.T @ r - np.eye(3)).max()
    return bool(off <= _RIGID_TOLERANCE and np.linalg.det(r) > 0)


def _half_tan(top: field.Object, where: Where, frames: Sequence[_Frame]) -> float:
    """tan(camera_angle_x / 2); NaN if there is no such angle, and every frame has the fl_x that makes up for it."""
    angle = field.optional(top, "camera_angle_x", where, field.number)
    if angle is None:
        for frame in frames:
            if "fl_x" not in frame.settings:
                hint = f"add the horizontal field of view in radians, or give {frame.where.field} its fl_x in pixels"
                raise where.key("camera_angle_x").error("is missing", hint)
        return math.nan
    if not _LEAST_ANGLE <= angle < math.pi:
        hint = "write the horizontal field of view in radians (degrees times pi/180)"
        raise where.key("camera_angle_x").error(f"must lie between 0 and pi, not {shown(angle)}", hint)
    return math.tan(angle / 2)


def _locate(name: str, where: Where, folder: Path) -> ImageFile:
    """The file that `name` means; InputError if that lies outside `folder`, be it through a link."""
    if os.path.isabs(name):
        raise where.error(f"{shown(name)} is an absolute path", "write it relative to the folder")
    listed = listed_file(name)
    path = Path(os.path.realpath(folder / listed))
    if not path.is_relative_to(os.path.realpath(folder)):
        raise where.error(f"{shown(listed)} leads out of the folder", "put the file into the folder")
    return ImageFile(where, listed, path)


def _check_distinct(files: Sequence[ImageFile]) -> None:
    """Raise InputError if two frames have one image."""
    first: dict[Path, ImageFile] = {}
    for file in files:
        other = first.setdefault(file.path, file)
        if other is not file:
            problem = f"{shown(file.name)} is already the image of {other.where.field}"
            raise file.where.error(problem, "list every image once")


def _check_sizes(frames: Sequence[_Frame], files: Sequence[ImageFile], images: Sequence[np.ndarray]) -> None:
    """Raise InputError for an image whose size is neither the stated one nor, where none is stated, the first's."""
    for axis, key in enumerate(("h", "w")):
        for frame, file, image in zip(frames, files, images, strict=True):
            height, width = image.shape[:2]
            found = f"{shown(file.name)} is {width} x {height} pixels"
            stated = frame.settings.get(key)
            if stated and stated.value != image.shape[axis]:
                problem = f"is {stated.value}, but {found}"
                raise stated.where.error(problem, f"correct {key} in the file or in the frame, or the image")
            if not stated and image.shape[axis] != images[0].shape[axis]:
                first_height, first_width = images[0].shape[:2]
                problem = f"{found}, the first image {first_width} x {first_height}"
                raise file.where.error(problem, "give the frame its own w and h, or the image that size")


def _read_mask(file: ImageFile | None, image: np.ndarray) -> np.ndarray:
    """(H, W) bool: where a colour of the mask is not black; everywhere if there is no file."""
    height, width = image.shape[:2]
    if file is None:
        return np.ones((height, width), dtype=bool)
    colours = read_image(file)[..., :3]  # without alpha: an opaque black mask still masks
    if colours.shape[:2] != (height, width):
        found = f"{shown(file.name)} is {colours.shape[1]} x {colours.shape[0]} pixels"
        raise file.where.error(f"{found}, its image {width} x {height}", "give the mask the size of its image")
    return np.any(colours, axis=-1)


def _cameras(frames: Sequence[_Frame], images: Sequence[np.ndarray], half_tan: float) -> Cameras:
    """The frames' cameras; without fl_y pixels are square, without cx and cy the principal point is the center."""
    height, width = np.array([image.shape[:2] for image in images]).T
    fx = [frame.get("fl_x", 0.5 * w / half_tan) for frame, w in zip(frames, width.tolist(), strict=True)]
    return Cameras.of(
        [frame.pose for frame in frames],
        fx=fx,
        fy=[frame.get("fl_y", x) for frame, x in zip(frames, fx, strict=True)],
        cx=[frame.get("cx", w / 2) for frame, w in zip(frames, width.tolist(), strict=True)],
        cy=[frame.get("cy", h / 2) for frame, h in zip(frames, height.tolist(), strict=True)],
        width=width,
        height=height,
    )
