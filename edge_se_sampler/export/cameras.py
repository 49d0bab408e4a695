"""The images and cameras of a run's data as nerfstudio's transforms.json."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from edge_se_sampler.data.blender import transforms_path as blender_path
from edge_se_sampler.data.camera_path import read_applied
from edge_se_sampler.data.capture import SPLITS
from edge_se_sampler.data.dataset import DataSettings, find_format, list_frames
from edge_se_sampler.data.frames import DYNAMIC_MASK, Frame, read_mask
from edge_se_sampler.data.scene_file import SourceFile, read_json
from edge_se_sampler.data.transforms import transforms_path
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.files import check_output, encode_png, make_folder, write_atomically, write_json
from edge_se_sampler.engine.session import check_run_data, select_views
from edge_se_sampler.errors import InputError

POINTS_NAME = "points.ply"
EXPORTER = {"exported_by": "edge-se export"}
"""Tells the file from others of its name, which are not replaced; nerfstudio does not read it."""


def export_cameras(config: TrainerConfig, path: Path) -> str:
    """Write the cameras of a run's data, of the images as they are in their files: at full size, with their lenses'
    distortion. Which are trained on is listed, and which are held out; masks that nerfstudio would read otherwise are
    written anew. Returns a line about it; InputError if the data or the file cannot be used."""
    check_output(path, ".json")
    check_run_data(config)
    assert config.data is not None  # or it would not be there
    lists = {
        "blender": [blender_path(config.data, split) for split in SPLITS],
        "transforms": [transforms_path(config.data)],
    }
    own = lists.get(find_format(config.data, config.data_format), [])
    others = [other for paths in lists.values() for other in paths if other.exists()]  # of the same images
    if os.path.realpath(path) in map(os.path.realpath, (*own, *others)):
        raise InputError(f"--output-path {path}: the data itself, which is not overwritten; give another file")
    if path.exists() and not _is_export(path):
        raise InputError(f"--output-path {path}: is none that was exported here, and would be replaced; name another")
    settings = DataSettings(config.data_format, eval_every=config.eval_every)
    splits = {split: list_frames(config.data, split, settings) for split in SPLITS}
    selected = select_views(config, len(splits["train"]))
    splits["train"] = splits["train"] if selected is None else [splits["train"][i] for i in selected]
    # nerfstudio wants both
    splits["val"], splits["test"] = splits["val"] or splits["test"], splits["test"] or splits["val"]
    listed = {frame.image.path: frame for split in SPLITS for frame in splits[split]}
    frames = {image: describe_frame(frame, path.parent) for image, frame in listed.items()}
    motion, scale = read_applied(config.data, config.data_format)
    rewritten = _rewrite_masks(listed, frames, path)
    masks = _mask_all(list(frames.values()))
    for name, mask in (rewritten | masks).items():  # only once all could be read
        make_folder((path.parent / name).parent, "the masks'")
        write_atomically(path.parent / name, mask)
    applied = {"applied_transform": motion[:3].tolist(), "applied_scale": scale}
    content = EXPORTER | applied | share_intrinsics(list(frames.values()))
    for split in SPLITS if splits["test"] else ():  # nerfstudio wants all lists or none
        content[f"{split}_filenames"] = [frames[frame.image.path]["file_path"] for frame in splits[split]]
    line = f"{path}: {len(frames)} cameras, {len(splits['train'])} of them to train on"
    line += f"; masks beside it, in which all is known, for those without: {', '.join(sorted(masks))}" if masks else ""
    if rewritten:
        line += f"; {len(rewritten)} masks written anew beside it, which nerfstudio would read otherwise"
    if len({frame["camera_model"] for frame in frames.values()}) > 1:
        line += "; nerfstudio takes all cameras for perspective ones, since fisheyes are among others"
    if turned := sum(frame.header.orientation >= 5 for frame in listed.values()):
        line += f"; nerfstudio does not turn images as their EXIF orientation says, as {turned} of these have to be"
    if (path.parent / POINTS_NAME).is_file() and scale == 1:
        content["ply_file_path"] = POINTS_NAME
        line += f"; the {POINTS_NAME} that lies beside it is named as their points"
    elif (path.parent / POINTS_NAME).is_file():
        line += f"; the {POINTS_NAME} that lies beside it is not named: nerfstudio would scale it by applied_scale, too"
    write_json(path, content)
    return line


def _is_export(path: Path) -> bool:
    try:
        return read_json(path).object().items() >= EXPORTER.items()
    except InputError:
        return False


def describe_frame(frame: Frame, folder: Path) -> dict[str, Any]:
    """A member of `frames`, with files relative to a folder."""
    camera, lens = frame.camera, frame.camera.lens
    pose = np.vstack((frame.pose, (0, 0, 0, 1)))
    entry: dict[str, Any] = {"file_path": relative_path(frame.image.path, folder), "transform_matrix": pose.tolist()}
    if frame.mask is not None:
        entry["mask_path"] = relative_path(frame.mask.path, folder)
    entry |= {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    entry |= {"w": frame.header.width, "h": frame.header.height, "camera_model": "OPENCV"}
    if lens is not None:
        names = ("k1", "k2", "k3", "k4") if lens.fisheye else ("k1", "k2", "p1", "p2", "k3")
        entry |= dict(zip(names, lens.coefficients, strict=True))
        entry["camera_model"] = "OPENCV_FISHEYE" if lens.fisheye else "OPENCV"
    return entry


def _rewrite_masks(listed: dict[Path, Frame], entries: dict[Path, dict[str, Any]], path: Path) -> dict[str, bytes]:
    """What is known as a gray PNG, for frames whose mask is none, or says it otherwise: the files, in a folder beside
    the json and named as the images are, which the frames' entries name from now on."""
    root, files = os.path.commonpath([image.parent for image in listed]), {}
    for image, frame in listed.items():
        if frame.mask is None or _is_plain(frame.mask):
            continue
        known = read_mask(frame.mask, np.broadcast_to(np.uint8(0), (frame.header.height, frame.header.width))) > 0
        name = f"{path.stem}-masks/{relative_path(image, Path(root))}.png"
        files[name] = encode_png(np.where(known, np.uint8(255), np.uint8(0)))
        entries[image]["mask_path"] = name
    return files


def _mask_all(frames: list[dict[str, Any]]) -> dict[str, bytes]:
    """If some frames have masks, give the others one that says that all is known: nerfstudio wants masks of all frames
    or of none. Returns the files of these, beside the json."""
    without, files = [frame for frame in frames if "mask_path" not in frame], {}
    for frame in without if len(without) < len(frames) else []:
        name = frame["mask_path"] = f"all-known-{frame['w']}x{frame['h']}.png"
        files[name] = files.get(name) or encode_png(np.full((frame["h"], frame["w"]), 255, np.uint8))
    return files


def _is_plain(mask: SourceFile) -> bool:
    """Whether nerfstudio, which takes what is not 0 of a file's one channel, reads a mask as we do."""
    try:
        with Image.open(mask.path) as image:
            gray = image.format == "PNG" and image.mode in ("1", "L")
    except Exception:  # OSError, DecompressionBombError, ...: reading it says what is wrong
        return False
    return gray and not os.path.basename(mask.name).startswith(DYNAMIC_MASK)


def relative_path(file: Path, folder: Path) -> str:
    """A file's path relative to a folder; as it is, where they are on different drives."""
    try:
        return Path(os.path.relpath(file, folder.resolve())).as_posix()
    except ValueError:
        return file.as_posix()


def share_intrinsics(frames: list[dict[str, Any]]) -> dict[str, Any]:
    """The json of frames, with what is of the camera at its top if it is the same for all; the camera's model, which
    nerfstudio reads there alone, even if nothing else is."""
    own = {"file_path", "mask_path", "transform_matrix"}
    cameras = [{key: value for key, value in frame.items() if key not in own} for frame in frames]
    names = ["camera_model", *(key for key in cameras[0] if all(camera == cameras[0] for camera in cameras))]
    shared = {key: cameras[0][key] for key in names if all(camera[key] == cameras[0][key] for camera in cameras)}
    frames = [{key: value for key, value in frame.items() if key not in shared} for frame in frames]
    return shared | {"frames": frames}
