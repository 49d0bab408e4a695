"""The frames of a transforms json, as NeRF's Blender scenes have them and nerfstudio, instant-ngp and others write."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edge_se_sampler.data.frames import Frame, choose_orientation, read_headers
from edge_se_sampler.data.image_file import ImageHeader, read_image
from edge_se_sampler.data.lens import Intrinsics, Lens
from edge_se_sampler.data.mask_files import find_mask
from edge_se_sampler.data.scene_file import (
    JsonValue,
    SourceFile,
    SourceLocation,
    check_listed_once,
    locate_file,
    quote,
)

_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
# of the image and its camera, in pixels but for angles: for one frame, or at the top of the file for all frames
_INTRINSICS = {
    "w": JsonValue.count,
    "h": JsonValue.count,
    "cx": JsonValue.number,
    "cy": JsonValue.number,
    "fl_x": JsonValue.positive_number,
    "fl_y": JsonValue.positive_number,
    "camera_angle_x": lambda value: _read_half_tan(value),
    "camera_angle_y": lambda value: _read_half_tan(value),
    **dict.fromkeys(_DISTORTION, JsonValue.number),
    "camera_model": lambda value: _read_model(value),
    "is_fisheye": lambda value: _read_flag(value),
    "fisheye_crop_radius": JsonValue.positive_number,
}
_UNSUPPORTED = ("ftheta_p0", "latlong", "equirectangular", "orthographic")
# keys by which instant-ngp's json says that a camera is no perspective one
_MODELS = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"}
_SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class Entry:
    """A member of `frames`."""

    location: SourceLocation
    file_path: str
    image: SourceFile
    mask: SourceFile | None
    pose: np.ndarray  # (3, 4) float64, camera to world
    intrinsics: dict[str, JsonValue]  # by their names in _INTRINSICS; the frame's own replace the file's

    def get(self, key: str, default: float) -> float:
        return self.intrinsics[key].number() if key in self.intrinsics else default

    def has_size(self, header: ImageHeader) -> bool:
        """Whether an image of that size is the one whose size is stated; True if none is."""
        sizes = (("w", header.width), ("h", header.height))
        return all(key not in self.intrinsics or self.intrinsics[key].count() == size for key, size in sizes)


def listed_file(path: str) -> str:
    """The file, relative to the folder, that a file_path or mask_path means: .png may be left out."""
    return path if path.lower().endswith(_SUFFIXES) else f"{path}.png"


def read_entries(top: JsonValue, folder: Path) -> list[Entry]:
    """The members of a json's `frames`; InputError if one is bad, or there are none, or two are of one image."""
    hint = "list each view as {file_path, transform_matrix}"
    listed = top.required("frames", hint)
    if not listed.list():
        raise listed.location.error("is empty", hint)
    shared = _read_intrinsics(top)
    entries = [_read_entry(entry, shared, folder) for entry in listed.list()]
    for field in (
        entry.location.field for entry in entries if not entry.intrinsics.keys() & {"fl_x", "camera_angle_x"}
    ):
        hint = f"add the horizontal field of view in radians, or give {field} its fl_x in pixels"
        raise top.location.member("camera_angle_x").error("is missing", hint)
    check_listed_once(entry.image for entry in entries)
    return entries


def read_frames(entries: Sequence[Entry]) -> list[Frame]:
    """The frames of at least one entry, their images' headers read; InputError if one has another size than it should:
    the stated one or, where none is stated, the first's."""
    headers = read_headers([entry.image for entry in entries])
    pairs = list(zip(entries, headers, strict=True))
    headers = [choose_orientation(entry.image, header, entry.has_size) for entry, header in pairs]
    for key, axis in (("h", "height"), ("w", "width")):
        for entry, header in zip(entries, headers, strict=True):
            _check_size(entry, header, headers[0], key, axis)
    return [
        Frame(entry.file_path, entry.image, entry.mask, entry.pose, header, _camera(entry, header))
        for entry, header in zip(entries, headers, strict=True)
    ]


def _read_entry(entry: JsonValue, shared: dict[str, JsonValue], folder: Path) -> Entry:
    file_path = entry.required("file_path", "write the image's path, relative to the folder, without .png")
    mask_path = entry.optional("mask_path")
    own = _read_intrinsics(entry)
    # an angle of the frame's own says more than a focal length of the file's
    shared = {key: value for key, value in shared.items() if key.replace("fl_", "camera_angle_") not in own}
    path = read_path(file_path, folder)
    image = _locate(path, folder, file_path.location)
    return Entry(
        location=entry.location,
        file_path=path,
        image=image,
        mask=find_mask(folder, image.name, image)
        if mask_path is None
        else _locate(read_path(mask_path, folder), folder, mask_path.location),
        pose=_read_pose(entry.required("transform_matrix", "write the 4x4 camera-to-world matrix")),
        intrinsics=shared | own,
    )


def _read_intrinsics(parent: JsonValue) -> dict[str, JsonValue]:
    for key in _UNSUPPORTED:
        if (value := parent.optional(key)) and value.value is not None and value.value is not False:
            raise value.location.error("is of a camera that is not supported", "make perspective images of it")
    stated = {key: value for key in _INTRINSICS if (value := parent.optional(key))}
    if (value := parent.optional("distortion_params")) is not None:  # which count before others in nerfstudio, too
        if len(value.list()) != len(_DISTORTION):
            raise value.location.error(f"has {len(value.list())} numbers", f"write {', '.join(_DISTORTION)}")
        stated |= dict(zip(_DISTORTION, value.list(), strict=True))
    for key in stated.keys() & _DISTORTION:  # which nerfstudio writes in quotes for RealityCapture's cameras
        stated[key] = stated[key].unquoted()
    for key, value in stated.items():
        _INTRINSICS[key](value)
    return stated


def _read_half_tan(angle: JsonValue) -> float:
    """tan(angle / 2) of a field of view."""
    if not 1e-6 <= angle.number() < math.pi:  # below, focal lengths overflow
        axis = "horizontal" if angle.location.field.endswith("x") else "vertical"
        hint = f"write the {axis} field of view in radians (degrees times pi/180)"
        raise angle.location.error(f"must lie between 0 and pi, not {quote(angle.value)}", hint)
    return math.tan(angle.number() / 2)


def _read_model(value: JsonValue) -> str:
    if not isinstance(value.value, str) or value.value not in _MODELS:
        problem = f"is {quote(value.value)}, a camera model that is not supported"
        raise value.location.error(problem, f"use one of {', '.join(sorted(_MODELS))}")
    return value.value


def _read_flag(value: JsonValue) -> bool:
    if not isinstance(value.value, bool):
        raise value.location.error(f"must be true or false, not {quote(value.value)}", "write true or false")
    return value.value


def _read_pose(matrix: JsonValue) -> np.ndarray:
    """The upper (3, 4) float64 of a rigid camera-to-world matrix."""
    rows = matrix.list()
    if len(rows) != 4 or any(not isinstance(row.value, list) or len(row.value) != 4 for row in rows):
        problem = f"must be 4 rows of 4 numbers, not {quote(matrix.value)}"
        raise matrix.location.error(problem, "write the 4x4 camera-to-world matrix")
    return rigid_pose(matrix, [entry for row in rows for entry in row.list()])


def rigid_pose(matrix: JsonValue, entries: Sequence[JsonValue]) -> np.ndarray:
    """The upper (3, 4) float64 of a camera-to-world matrix, by its 16 entries, row by row; InputError if that is not
    rigid."""
    pose = np.array([entry.number() for entry in entries]).reshape(4, 4)
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > 1e-6:
        problem = f"its last row must be [0, 0, 0, 1], not {quote(pose[3].tolist())}"
        raise matrix.location.error(problem, "put the translation in the last column (transposed?)")
    r = pose[:3, :3].clip(-2, 2)  # no rotation has entries beyond 1, and products of large ones overflow
    if np.abs(r.T @ r - np.eye(3)).max() > 1e-3 or np.linalg.det(r) < 0:  # real files are rounded
        hint = "its upper left 3x3 must be orthonormal with determinant +1: remove scale, shear and mirroring"
        raise matrix.location.error("is not a rigid motion", hint)
    return pose[:3]


def read_path(name: JsonValue, folder: Path) -> str:
    """The path that `name` holds, which may have been written on Windows."""
    path = name.file_path()
    return path if os.path.exists(folder / listed_file(path)) else path.replace("\\", "/")


def _locate(path: str, folder: Path, location: SourceLocation) -> SourceFile:
    """The file that a listed path means; without .png, .jpg or .jpeg, the first of these that exists, else one of
    exactly that name, which may be of another kind, else the first."""
    listed = listed_file(path)
    if path != listed:
        others = (*(path + suffix for lower in _SUFFIXES for suffix in (lower, lower.upper())), path)
        listed = next((other for other in others if os.path.isfile(folder / other)), listed)
    return locate_file(folder, listed, location)


def _check_size(entry: Entry, header: ImageHeader, first: ImageHeader, key: str, axis: str) -> None:
    found = f"is {header.width} x {header.height} pixels"
    stated = entry.intrinsics.get(key)
    if getattr(header, axis) == (stated.count() if stated else getattr(first, axis)):
        return
    read_image(entry.image)  # of a damaged file that is what to say, whatever size it claims
    if stated:
        problem = f"is {stated.count()}, but {quote(entry.image.name)} {found}"
        raise stated.location.error(problem, f"correct {key} in the file or in the frame, or the image")
    hint = "give the frame its own w and h, or the image that size"
    raise entry.image.error(f"{found}, the first image {first.width} x {first.height}", hint)


def _camera(entry: Entry, header: ImageHeader) -> Intrinsics:
    """Without fl_y and camera_angle_y pixels are square, without cx and cy the principal point is the center."""
    width, height, known = header.width, header.height, entry.intrinsics
    fx = known["fl_x"].number() if "fl_x" in known else 0.5 * width / _read_half_tan(known["camera_angle_x"])
    fy = 0.5 * height / _read_half_tan(known["camera_angle_y"]) if "camera_angle_y" in known else fx
    cx, cy = entry.get("cx", width / 2), entry.get("cy", height / 2)
    return Intrinsics(fx, entry.get("fl_y", fy), cx, cy, read_lens(known))


def read_lens(known: dict[str, JsonValue]) -> Lens | None:
    """The lens that an entry's intrinsics state, None for a pinhole's; InputError for terms that are not supported."""
    k1, k2, k3, k4, p1, p2 = (known.get(key) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model, flag = known.get("camera_model"), known.get("is_fisheye")
    fisheye = (model is not None and model.value == "OPENCV_FISHEYE") or (flag is not None and flag.value)
    if fisheye and "fisheye_crop_radius" in known:
        problem, hint = "is not supported", "leave it out, and give masks that are black beyond it"
        raise known["fisheye_crop_radius"].location.error(problem, hint)
    for coefficient in (p1, p2) if fisheye else (k4,):
        if coefficient is not None and coefficient.number() != 0:
            kind = "a fisheye" if fisheye else "a lens that is none"
            raise coefficient.location.error(f"is not supported of {kind}", "undistort the images, or leave it out")
    terms = (k1, k2, k3, k4) if fisheye else (k1, k2, p1, p2, k3)
    values = tuple(0.0 if term is None else term.number() for term in terms)
    return Lens(fisheye, values) if fisheye or any(values) else None
