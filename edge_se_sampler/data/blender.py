"""Folders in the format of NeRF's Blender scenes (NeRF-synthetic): transforms_{train,val,test}.json and images."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.image_file import read_image
from edge_se_sampler.data.scene_file import JsonValue, SourceFile, SourceLocation, quote, read_json
from edge_se_sampler.data.views import Views

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)


# of the image and its camera, all in pixels: for one frame, or at the top of the file for all frames
_INTRINSICS = {
    "w": JsonValue.count,
    "h": JsonValue.count,
    "cx": JsonValue.number,
    "cy": JsonValue.number,
    "fl_x": JsonValue.positive_number,
    "fl_y": JsonValue.positive_number,
}


@dataclass(frozen=True)
class _Frame:
    location: SourceLocation
    file_path: str
    image: SourceFile
    mask: SourceFile | None
    pose: np.ndarray  # (3, 4) float64, camera to world
    intrinsics: dict[str, JsonValue]  # by their names in _INTRINSICS; the frame's own replace the file's

    def get(self, key: str, default: float) -> float:
        return self.intrinsics[key].number() if key in self.intrinsics else default


def transforms_path(folder: Path, split: str) -> Path:
    return folder / f"transforms_{split}.json"


def listed_file(path: str) -> str:
    """The file, relative to the folder, that a file_path or mask_path means: .png may be left out."""
    return path if path.lower().endswith((".png", ".jpg", ".jpeg")) else f"{path}.png"


def has_split(folder: Path, split: str) -> bool:
    """Whether the folder has a transforms_<split>.json."""
    return os.path.exists(transforms_path(Path(folder), split))


def read_blender(folder: Path, split: Split) -> Views:
    """Read one split of a scene; files that no frame lists are ignored. Poses are returned as written (not moved,
    scaled or orthonormalized). A frame without mask_path is trained on as a whole. InputError for anything that cannot
    be used: first of the folder, then of the json, then of the images."""
    folder = Path(folder)
    _check_folder(folder, split)
    top = read_json(transforms_path(folder, split))
    hint = "list each view as {file_path, transform_matrix}"
    listed = top.required("frames", hint)
    entries = listed.list()
    if not entries:
        raise listed.location.error("is empty", hint)
    shared = _read_intrinsics(top)
    frames = [_read_frame(entry, shared, folder) for entry in entries]
    half_tan = _read_half_tan(top, frames)
    first: dict[Path, SourceFile] = {}
    for file in (frame.image for frame in frames):
        if (other := first.setdefault(file.path, file)) is not file:
            raise file.error(f"is already the image of {other.location.field}", "list every image once")
    with ThreadPoolExecutor() as pool:  # decoding releases Python's lock
        images = tuple(pool.map(read_image, [frame.image for frame in frames]))
        _check_sizes(frames, images)
        mask_files = [frame.mask for frame in frames]
        masks = tuple(pool.map(_read_mask, mask_files, images)) if any(mask_files) else None
    if masks is not None and not any(mask.any() for mask in masks):
        raise listed.location.error("all pixels of all views are masked", "masks are non-zero where to train")
    return Views(tuple(frame.file_path for frame in frames), images, masks, _cameras(frames, images, half_tan))


def _check_folder(folder: Path, split: str) -> None:
    location = SourceLocation(folder)
    hint = "give the folder that has the transforms_*.json files"
    if not os.path.lexists(folder):
        raise location.error("no such folder", hint)
    if not os.path.isdir(folder):
        raise location.error("is not a folder", hint)
    if not os.access(folder, os.R_OK | os.X_OK):
        raise location.error("may not be read (permission denied)", "change the folder's permissions")
    if has_split(folder, split):
        return
    found = ", ".join(transforms_path(folder, other).name for other in SPLITS if has_split(folder, other))
    others = f"only {found}" if found else "nor that of any other split"
    hint = "a Blender scene has transforms_train.json and, for other splits, transforms_val.json, transforms_test.json"
    raise location.error(f"has no transforms_{split}.json, {others}", hint)


def _read_frame(entry: JsonValue, shared: dict[str, JsonValue], folder: Path) -> _Frame:
    file_path = entry.required("file_path", "write the image's path, relative to the folder, without .png")
    mask_path = entry.optional("mask_path")
    return _Frame(
        location=entry.location,
        file_path=file_path.file_path(),
        image=_locate(file_path, folder),
        mask=None if mask_path is None else _locate(mask_path, folder),
        pose=_read_pose(entry.required("transform_matrix", "write the 4x4 camera-to-world matrix")),
        intrinsics=shared | _read_intrinsics(entry),
    )


def _read_intrinsics(parent: JsonValue) -> dict[str, JsonValue]:
    for key in ("k1", "k2", "k3", "k4", "p1", "p2"):
        coefficient = parent.optional(key)
        if coefficient is not None and coefficient.number() != 0:
            problem = f"is {quote(coefficient.value)}, but lens distortion is not supported"
            raise coefficient.location.error(problem, "undistort the images, and leave it out")
    stated = {key: value for key in _INTRINSICS if (value := parent.optional(key))}
    for key, value in stated.items():
        _INTRINSICS[key](value)
    return stated


def _read_pose(matrix: JsonValue) -> np.ndarray:
    """The upper (3, 4) float64 of a rigid camera-to-world matrix."""
    rows = matrix.list()
    if len(rows) != 4 or any(not isinstance(row.value, list) or len(row.value) != 4 for row in rows):
        problem = f"must be 4 rows of 4 numbers, not {quote(matrix.value)}"
        raise matrix.location.error(problem, "write the 4x4 camera-to-world matrix")
    pose = np.array([[entry.number() for entry in row.list()] for row in rows])
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > 1e-6:
        problem = f"its last row must be [0, 0, 0, 1], not {quote(rows[3].value)}"
        raise matrix.location.error(problem, "put the translation in the last column (transposed?)")
    r = pose[:3, :3].clip(-2, 2)  # no rotation has entries beyond 1, and products of large ones overflow
    if np.abs(r.T @ r - np.eye(3)).max() > 1e-3 or np.linalg.det(r) < 0:  # real files are rounded
        hint = "its upper left 3x3 must be orthonormal with determinant +1: remove scale, shear and mirroring"
        raise matrix.location.error("is not a rigid motion", hint)
    return pose[:3]


def _read_half_tan(top: JsonValue, frames: Sequence[_Frame]) -> float:
    """tan(camera_angle_x / 2); NaN if there is no such angle and every frame has its fl_x instead."""
    angle = top.optional("camera_angle_x")
    if angle is None:
        for field in (frame.location.field for frame in frames if "fl_x" not in frame.intrinsics):
            hint = f"add the horizontal field of view in radians, or give {field} its fl_x in pixels"
            raise top.location.member("camera_angle_x").error("is missing", hint)
        return math.nan
    if not 1e-6 <= angle.number() < math.pi:  # below, focal lengths overflow
        hint = "write the horizontal field of view in radians (degrees times pi/180)"
        raise angle.location.error(f"must lie between 0 and pi, not {quote(angle.value)}", hint)
    return math.tan(angle.number() / 2)


def _locate(name: JsonValue, folder: Path) -> SourceFile:
    """The file that `name` means; InputError if that lies outside `folder`, be it through a link."""
    if os.path.isabs(name.file_path()):
        raise name.location.error(f"{quote(name.value)} is an absolute path", "write it relative to the folder")
    listed = listed_file(name.value)
    file = SourceFile(Path(os.path.realpath(folder / listed)), name.location, listed)
    if not file.path.is_relative_to(os.path.realpath(folder)):
        raise file.error("leads out of the folder", "put the file into the folder")
    return file


def _check_sizes(frames: Sequence[_Frame], images: Sequence[np.ndarray]) -> None:
    """Raise InputError for an image whose size is neither the stated one nor, where none is stated, the first's."""
    for axis, key in enumerate(("h", "w")):
        for frame, image in zip(frames, images, strict=True):
            found = f"is {image.shape[1]} x {image.shape[0]} pixels"
            stated = frame.intrinsics.get(key)
            if stated and stated.count() != image.shape[axis]:
                problem = f"is {stated.count()}, but {quote(frame.image.name)} {found}"
                raise stated.location.error(problem, f"correct {key} in the file or in the frame, or the image")
            if not stated and image.shape[axis] != images[0].shape[axis]:
                height, width = images[0].shape[:2]
                hint = "give the frame its own w and h, or the image that size"
                raise frame.image.error(f"{found}, the first image {width} x {height}", hint)


def _read_mask(file: SourceFile | None, image: np.ndarray) -> np.ndarray:
    """(H, W) bool: where a color of the mask is not black; everywhere if there is no file."""
    height, width = image.shape[:2]
    if file is None:
        return np.ones((height, width), dtype=bool)
    colors = read_image(file)[..., :3]  # without alpha: an opaque black mask still masks
    if colors.shape[:2] != (height, width):
        problem = f"is {colors.shape[1]} x {colors.shape[0]} pixels, its image {width} x {height}"
        raise file.error(problem, "give the mask the size of its image")
    return np.any(colors, axis=-1)


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
