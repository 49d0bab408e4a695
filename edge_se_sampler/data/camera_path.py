"""Camera paths as nerfstudio's viewer writes them (1.1.5: camera_path.json)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.config import DataFormat
from edge_se_sampler.data.dataset import find_format
from edge_se_sampler.data.frames import MAX_POSITION
from edge_se_sampler.data.scene_file import JsonValue, SourceLocation, quote, read_json
from edge_se_sampler.data.transforms import transforms_path
from edge_se_sampler.data.transforms_frames import rigid_pose

MAX_SIDE = 8192  # pixels
FIELDS_OF_VIEW = 0.001, 179.0  # degrees
OLD_COLMAP_TRANSFORM = ((0, 1, 0, 0), (1, 0, 0, 0), (0, 0, -1, 0))
"""The applied_transform that nerfstudio assumes of COLMAP's scenes whose json has none."""


@dataclass(frozen=True)
class CameraPath:
    cameras: Cameras
    frames_per_second: float | None  # None: the file does not say


def read_camera_path(path: Path) -> CameraPath:
    """The cameras of a path, in the world that the file means, and its frame rate. A camera's fov is the vertical field
    of view in degrees, its matrix is camera to world, row by row. InputError for what cannot be used."""
    top = read_json(path)
    kind = top.optional("camera_type")
    if kind is not None and str(kind.value).lower() != "perspective":
        raise kind.location.error(f"is {quote(kind.value)}, which cannot be rendered", 'make it "perspective"')
    height, width = (_read_side(top, key) for key in ("render_height", "render_width"))
    fps = top.optional("fps")
    listed = top.required("camera_path", "list each camera as {camera_to_world, fov}")
    if not listed.list():
        raise listed.location.error("is empty", "add keyframes in the viewer, and save the path again")
    poses = np.stack([_read_pose(camera) for camera in listed.list()])
    focal = [height / 2 / math.tan(_read_angle(camera) / 2) for camera in listed.list()]
    centered = {"cx": width / 2, "cy": height / 2, "width": width, "height": height}
    _check_positions(poses, listed.location)
    cameras = Cameras.of(poses, fx=focal, fy=focal, **centered)
    return CameraPath(cameras, None if fps is None else fps.positive_number())


def undo_dataparser(path: CameraPath, transforms: Path, data: Path, data_format: DataFormat) -> CameraPath:
    """A path of a viewer of nerfstudio in the world of the data that its model was trained on: x of the data is
    s (R x + t) in nerfstudio, by a run's dataparser_transforms.json. InputError for files that cannot be used."""
    top, hint = read_json(transforms), "give the dataparser_transforms.json in the folder of nerfstudio's run"
    motion, scale = _read_motion(top.required("transform", hint)), top.required("scale", hint).positive_number()
    applied, applied_scale = read_applied(data, data_format)  # which the file takes together with its own
    motion, scale = motion @ np.linalg.inv(applied), scale / applied_scale
    poses = path.cameras.camera_to_worlds.numpy().copy()
    with np.errstate(over="ignore"):  # infinite positions are refused below
        poses[:, :, 3] = poses[:, :, 3] / scale - motion[:3, 3]
    _check_positions(poses, top.location)
    poses = path.cameras.camera_to_worlds.new_tensor(motion[:3, :3].T @ poses)
    return replace(path, cameras=replace(path.cameras, camera_to_worlds=poses))


def read_applied(data: Path, data_format: DataFormat) -> tuple[np.ndarray, float]:
    """The motion (4, 4) and the scale by which nerfstudio takes the world of a scene's cameras to be another than that
    of what they were made from, such as COLMAP's: neither, but where a transforms.json says so. InputError for a json
    that cannot be used."""
    motion, scale = np.eye(4), 1.0
    if find_format(data, data_format) == "transforms":
        scene = read_json(transforms_path(data))
        if (applied := scene.optional("applied_transform")) is not None:
            motion = _read_motion(applied)
        elif (data / "colmap" / "sparse" / "0").exists():
            motion = np.array((*OLD_COLMAP_TRANSFORM, (0, 0, 0, 1)), dtype=np.float64)
        if (applied_scale := scene.optional("applied_scale")) is not None:
            scale = applied_scale.positive_number()
    return motion, scale


def _check_positions(poses: np.ndarray, location: SourceLocation) -> None:
    """InputError for cameras (n, 3, 4) too far away for numbers of 32 bits."""
    if not np.abs(poses[:, :, 3]).max() <= MAX_POSITION:
        raise location.error("has cameras that are too far away", f"write coordinates of at most {MAX_POSITION:g}")


def _read_motion(matrix: JsonValue) -> np.ndarray:
    """A rigid motion (4, 4), of which a file has the upper 3 rows."""
    rows = [row.list() for row in matrix.list()]
    if [len(row) for row in rows] != [4, 4, 4]:
        raise matrix.location.error(f"must be 3 rows of 4 numbers, not {quote(matrix.value)}", "take nerfstudio's file")
    rows.append([JsonValue(value, matrix.location) for value in (0, 0, 0, 1)])
    return np.vstack((rigid_pose(matrix, [entry for row in rows for entry in row]), (0, 0, 0, 1)))


def _read_side(top: JsonValue, key: str) -> int:
    side = top.required(key, "write the pixels of a frame's side")
    if side.count() > MAX_SIDE:
        raise side.location.error(f"is {quote(side.value)} pixels", f"write at most {MAX_SIDE}")
    return side.count()


def _read_pose(camera: JsonValue) -> np.ndarray:
    hint = "write the 16 numbers of the 4x4 camera-to-world matrix, row by row"
    matrix = camera.required("camera_to_world", hint)
    if len(matrix.list()) != 16:
        raise matrix.location.error(f"has {len(matrix.list())} entries", hint)
    return rigid_pose(matrix, matrix.list())


def _read_angle(camera: JsonValue) -> float:
    """The vertical field of view, radians."""
    angle, (least, most) = camera.required("fov", "write the vertical field of view in degrees"), FIELDS_OF_VIEW
    if not least <= angle.number() <= most:
        raise angle.location.error(f"is {quote(angle.value)}", f"write degrees, between {least:g} and {most:g}")
    return math.radians(angle.number())
