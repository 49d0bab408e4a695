"""Off-centre counterparts of a Blender folder: its pictures pasted elsewhere on a larger canvas (see `canvas`).

The principal point goes with the picture; focal lengths in pixels and poses stay, so every pixel keeps its ray.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import numpy as np

from edge_se_sampler.data.blender import SPLITS, Split, has_split, listed_file, read_blender, transforms_path
from edge_se_sampler.data.canvas import TWINS, Canvas, background, object_pixels
from edge_se_sampler.data.json_schema import Object, load_object
from edge_se_sampler.data.new_folder import appearing, check_free
from edge_se_sampler.data.source_location import Where, shown
from edge_se_sampler.data.views import Views
from edge_se_sampler.errors import InputError

Shares = tuple[float, float]  # of an image's width and height


@dataclass(frozen=True)
class _Split:
    """A split that was found fit to be written."""

    split: Split
    document: Object  # its json
    files: list[dict[str, str]]  # of each frame: file_path, mask_path -> the file inside a twin


def offcenter(
    data: Path,
    out: Path,
    shift: Shares = (0.2, 0.15),
    pad: Shares | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Write every split of `data` twice, padded and centred to out/centered, padded and shifted to out/shifted.

    Both show every picture on a canvas of the same size, bit for bit; only its place differs, and `cx`, `cy`. Around
    it is transparent black (RGBA), or the colour of its border (RGB); masks hide what is around. Pictures are written
    as PNG, a .jpg under the name .png; files that no frame lists are not copied.

    Args:
        data: a folder as read_blender reads it.
        out: a folder that is not there, or empty.
        shift: right and down positive; rounded to whole pixels, as the shifted synthetic scenes' offset is.
        pad: added on either side, rounded likewise; None: as much as the shift.
        progress: called as progress(done, total), in views.

    Returns:
        the two folders. They appear together at the end: an error or Ctrl-C leaves nothing behind.

    Raises:
        InputError: bad data, a share that has no meaning, an `out` that cannot be written or is not empty, an RGB
            image without a plain border, or an object that would be cut off.
    """
    _check_shares(shift, pad)
    data, target = Path(data), Path(os.path.abspath(out))
    check_free(target.parent, [target])
    splits = _checked(data, shift, pad)
    done, total = 0, sum(len(split.files) for split in splits)
    with appearing(target.parent, [target]) as workspace, ThreadPoolExecutor() as pool:
        for split in splits:
            views = read_blender(data, split.split)
            canvases = [Canvas.of(image, shift, pad) for image in views.images]
            _write_documents(workspace / target.name, split, views, canvases)
            masks = views.masks or (None,) * len(canvases)
            folders = [workspace / target.name] * len(canvases)
            for _ in pool.map(_write_view, folders, split.files, canvases, views.images, masks):
                done += 1
                if progress:
                    progress(done, total)
    return [target / twin for twin in TWINS]


def _check_shares(shift: Shares, pad: Shares | None) -> None:
    if not all(-1 < share < 1 for share in shift):  # not so for NaN, too
        raise InputError(f"shift is {shift}: give two numbers between -1 and 1, shares of the image's width and height")
    if pad is not None and not all(0 <= share <= 1 for share in pad):
        raise InputError(f"pad is {pad}: give two numbers from 0 to 1, shares of the image's width and height")


def _checked(data: Path, shift: Shares, pad: Shares | None) -> list[_Split]:
    """All splits, read once to the end; InputError for what cannot be written as promised."""
    splits: list[_Split] = []
    taken: dict[str, tuple[str, str]] = {}
    clipped: list[tuple[Where, str, int]] = []
    needed = np.zeros(2)  # padding, over all views
    found: tuple[Split, ...] = tuple(split for split in SPLITS if has_split(data, split))
    for split in found or SPLITS[:1]:  # where there is none, the loader says so
        views = read_blender(data, split)
        where = Where(transforms_path(data, split))
        document, places = load_object(where), [where.key("frames").item(i) for i in range(len(views.names))]
        frames = zip(document["frames"], places, strict=True)
        splits.append(_Split(split, document, [_files(data, frame, place, taken) for frame, place in frames]))
        for name, image, place in zip(views.names, views.images, places, strict=True):
            canvas, shown_object = Canvas.of(image, shift, pad), _object(image, name, place)
            needed = np.maximum(needed, canvas.least_pad(shown_object))
            if lost := canvas.lost(shown_object):
                clipped.append((place, name, lost))
    if clipped:
        place, name, lost = clipped[0]
        more = f" ({len(clipped)} views would lose some)" if clipped[1:] else ""
        problem = f"{shown(listed_file(name))} would lose {lost} pixels of its object past the edge of the canvas{more}"
        raise place.key("file_path").error(problem, f"give at least --pad {needed[0]:g} {needed[1]:g}, or no --pad")
    return splits


def _object(image: np.ndarray, name: str, place: Where) -> np.ndarray:
    """object_pixels(), or InputError where the background is not known."""
    colour = background(image)
    if colour is None:
        problem = f"{shown(listed_file(name))} has no plain background: the pixels of its border differ"
        raise place.key("file_path").error(problem, "cut the object out (RGBA), or make the border one colour")
    return object_pixels(image, colour)


def _files(data: Path, frame: Object, place: Where, taken: dict[str, tuple[str, str]]) -> dict[str, str]:
    """Where inside a twin the frame's image and mask go; `taken` remembers what goes where."""
    files = {}
    for key in ("file_path", "mask_path"):
        if key in frame:
            listed = listed_file(frame[key])
            stem, suffix = os.path.splitext(Path(os.path.normpath(listed)).as_posix())
            file = stem + (suffix if suffix.lower() == ".png" else ".png")
            if file.startswith("../"):  # and in again: the loader does not mind, but we write there
                raise place.key(key).error(f"{shown(listed)} leads out of the folder", "write the path without ..")
            use = (key, os.path.realpath(data / listed))
            if taken.setdefault(file, use) != use:
                problem = f"{shown(listed)} would be written over another picture, {shown(file)}"
                raise place.key(key).error(problem, "give each image and mask a name of its own")
            files[key] = file
    return files


def _write_documents(folder: Path, split: _Split, views: Views, canvases: Sequence[Canvas]) -> None:
    for twin in TWINS:
        (folder / twin).mkdir(parents=True, exist_ok=True)
        text = json.dumps(_document(split, views, canvases, twin), indent=4)
        transforms_path(folder / twin, split.split).write_text(text, encoding="utf-8")


def _document(split: _Split, views: Views, canvases: Sequence[Canvas], twin: str) -> Object:
    """The json of a twin: what it was, but for the cameras' sizes and lengths, and .jpg that became .png."""
    cameras = [
        {
            "w": canvas.size[0],
            "h": canvas.size[1],
            "fl_x": float(views.cameras.fx[i]),
            "fl_y": float(views.cameras.fy[i]),
            "cx": float(views.cameras.cx[i]) + canvas.corners[twin][0],
            "cy": float(views.cameras.cy[i]) + canvas.corners[twin][1],
        }
        for i, canvas in enumerate(canvases)
    ]
    shared = {key: value for key, value in cameras[0].items() if all(camera[key] == value for camera in cameras)}
    top = {key: value for key, value in split.document.items() if key not in cameras[0]} | shared
    if "camera_angle_x" in top:  # not for us, who take fl_x, but for loaders that know nothing else
        widen = canvases[0].size[0] / canvases[0].picture[0]
        if "w" in shared:
            top["camera_angle_x"] = 2 * math.atan(math.tan(top["camera_angle_x"] / 2) * widen)
        else:
            del top["camera_angle_x"]  # no one angle is true of all
    del top["frames"]
    top["frames"] = [
        frame
        | {key: value for key, value in camera.items() if key in frame or key not in shared}
        | {key: file for key, file in files.items() if not listed_file(frame[key]).lower().endswith(".png")}
        for frame, camera, files in zip(split.document["frames"], cameras, split.files, strict=True)
    ]
    return top


def _write_view(
    folder: Path, files: dict[str, str], canvas: Canvas, image: np.ndarray, mask: np.ndarray | None
) -> None:
    """One view's picture into both twins and, where its frame has one, its mask (H, W) bool as grey."""
    colour = background(image)
    assert colour is not None  # as _checked saw
    layers: dict[str, tuple[np.ndarray, np.ndarray]] = {files["file_path"]: (image, colour)}
    if mask is not None and "mask_path" in files:
        layers[files["mask_path"]] = (mask * np.uint8(255), np.zeros((), np.uint8))
    for twin, corner in canvas.corners.items():
        for file, (layer, around) in layers.items():
            path = folder / twin / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(iio.imwrite("<bytes>", canvas.paste(layer, corner, around), extension=".png"))
