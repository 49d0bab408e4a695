"""Off-center copies of a Blender folder: its pictures pasted elsewhere on a larger canvas, by whole pixels.

The principal point moves with the picture; focal lengths in pixels and poses stay, so every pixel keeps its ray.

W, H  size of a picture, pixels
p     padding on either side, pixels: the canvas is W + 2 p_x by H + 2 p_y
d     shift of the picture on its canvas, pixels, right and down positive

The picture's upper left corner goes to p in the centered copy and to p + d in the shifted one.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import imageio.v3 as iio
import numpy as np

from edge_se_sampler.data.blender import is_left_out, read_blender, transforms_path
from edge_se_sampler.data.capture import SPLITS, Split
from edge_se_sampler.data.frames import DYNAMIC_MASK, read_mask
from edge_se_sampler.data.new_folder import staged_folders
from edge_se_sampler.data.scene_file import JsonValue, quote, read_json
from edge_se_sampler.data.transforms_frames import Entry, listed_file, read_entries, read_lens, read_path
from edge_se_sampler.data.views import Views
from edge_se_sampler.errors import InputError

Pair = tuple[int, int]  # x, y
Fractions = tuple[float, float]  # of an image's width and height
ANGLES = "camera_angle_x", "camera_angle_y"  # of narrower and lower images than a copy's
Files = list[dict[str, str]]  # of each frame: file_path, mask_path -> the file inside a copy


@dataclass(frozen=True)
class Canvas:
    """Where a picture is pasted; all in whole pixels (x, y)."""

    picture: Pair  # W, H
    pad: Pair  # p
    shift: Pair  # d, of at most a picture's size

    @classmethod
    def of(cls, image: np.ndarray, shift: Fractions, pad: Fractions | None) -> Canvas:
        """The canvas of an (H, W, ...) image; without `pad` the shifted picture just fits."""
        height, width = image.shape[:2]
        d = round(shift[0] * width), round(shift[1] * height)
        p = (abs(d[0]), abs(d[1])) if pad is None else (round(pad[0] * width), round(pad[1] * height))
        return cls((width, height), p, d)

    @property
    def size(self) -> Pair:
        return self.picture[0] + 2 * self.pad[0], self.picture[1] + 2 * self.pad[1]

    @property
    def corners(self) -> dict[str, Pair]:
        """The picture's upper left corner on the canvas, by copy."""
        return {"centered": self.pad, "shifted": (self.pad[0] + self.shift[0], self.pad[1] + self.shift[1])}

    def visible(self, corner: Pair) -> tuple[slice, slice]:
        """The rows and columns of the picture that land on the canvas."""
        (width, height), (x, y) = self.size, corner
        return slice(max(0, -y), min(self.picture[1], height - y)), slice(max(0, -x), min(self.picture[0], width - x))

    def paste(self, image: np.ndarray, corner: Pair, color: np.ndarray) -> np.ndarray:
        """The (H', W', ...) canvas that shows an (H, W, ...) image at `corner`, and `color` (...) around it."""
        x, y = corner
        rows, columns = self.visible(corner)
        canvas = np.full((self.size[1], self.size[0], *image.shape[2:]), color, image.dtype)
        canvas[rows.start + y : rows.stop + y, columns.start + x : columns.stop + x] = image[rows, columns]
        return canvas

    def min_pad(self, foreground: np.ndarray) -> np.ndarray:
        """(2,) fractions of W and H: the least padding with which the shifted copy keeps (H, W) bool `foreground`."""
        positions = np.argwhere(foreground)[:, ::-1] + self.shift
        before, after = -positions.min(axis=0, initial=0), positions.max(axis=0, initial=0) + 1 - self.picture
        return np.maximum(before, after) / self.picture


def plain_background(image: np.ndarray) -> np.ndarray | None:
    """(C,) uint8, around the object: transparent black (RGBA), or the color of its border (RGB; None if of several)."""
    if image.shape[2] == 4:
        return np.zeros(4, np.uint8)
    border = np.concatenate((image[0], image[-1], image[:, 0], image[:, -1]))
    return border[0] if np.all(border == border[0]) else None


def offcenter(
    data: Path,
    out: Path,
    shift: Fractions = (0.2, 0.15),
    pad: Fractions | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Path]:
    """Write every split of `data` twice, padded and centered to out/centered, padded and shifted to out/shifted.

    Both show every picture on a canvas of the same size, bit for bit; only its position differs, and `cx`, `cy`. Around
    it is transparent black (RGBA), or the color of its border (RGB); masks hide what is around. Pictures are written
    as PNG, a .jpg under the name .png; files that no frame lists are not copied. Both folders appear together at the
    end: an error or Ctrl-C leaves nothing behind.

    Args:
        shift: right and down positive; rounded to whole pixels, as the shifted synthetic scenes' offset is.
        pad: added on either side, rounded likewise; None: as much as the shift.

    Raises:
        InputError: bad data, a fraction out of range, an `out` that cannot be written or is not empty, an RGB
            image without a plain border, or an object that would be cut off.
    """
    if not all(-1 < fraction < 1 for fraction in shift):  # not so for NaN, too
        raise InputError(f"shift is {shift}: give two numbers between -1 and 1, fractions of the image's size")
    if pad is not None and not all(0 <= fraction <= 1 for fraction in pad):
        raise InputError(f"pad is {pad}: give two numbers from 0 to 1, fractions of the image's size")
    data, target = Path(data), Path(os.path.abspath(out))
    with staged_folders(target.parent, [target]) as workspace, ThreadPoolExecutor() as pool:
        folder = workspace / target.name
        plan = _plan_copies(data, shift, pad)
        done, total = 0, sum(map(len, plan.values()))
        for split, files in plan.items():
            views = read_blender(data, split)
            canvases = [Canvas.of(image, shift, pad) for image in views.images]
            top = read_json(transforms_path(data, split))
            document, entries = top.object(), read_entries(top, data)
            for copy in canvases[0].corners:
                (folder / copy).mkdir(parents=True, exist_ok=True)
                text = json.dumps(_document(document, files, views, canvases, copy), indent=4)
                transforms_path(folder / copy, split).write_text(text, encoding="utf-8")
            for _ in pool.map(partial(_write_view, folder), files, canvases, views.images, entries):
                done += 1
                progress(done, total)
    return [target / "centered", target / "shifted"]


def _plan_copies(data: Path, shift: Fractions, pad: Fractions | None) -> dict[Split, Files]:
    """The files of each split, all read to the end; InputError for what cannot be copied as promised."""
    plan: dict[Split, Files] = {}
    written: dict[str, tuple[str, str]] = {}
    cut_off: list[tuple[Entry, int]] = []
    needed = np.zeros(2)  # padding, over all views
    found: list[Split] = [split for split in SPLITS if not is_left_out(data, split)]
    if not found:
        read_blender(data, "train")  # says that there is none
    for split in found:
        top = read_json(transforms_path(data, split))
        frames = top.required("frames", "").list()
        entries = read_entries(top, data)
        for entry in entries:
            if not os.path.exists(entry.image.path):
                raise entry.image.error("does not exist", "put the file there, or list only what is there")
            if read_lens(entry.intrinsics) is not None:
                raise entry.location.error("its lens distorts", "undistort the images, and leave its coefficients out")
        views = read_blender(data, split)
        plan[split] = [_output_files(data, *each, written) for each in zip(frames, entries, strict=True)]
        for image, entry in zip(views.images, entries, strict=True):
            background = plain_background(image)
            if background is None:
                problem = "has no plain background: the pixels of its border differ"
                raise entry.image.error(problem, "cut the object out (RGBA), or make the border one color")
            foreground = image[..., 3] > 0 if image.shape[2] == 4 else np.any(image != background, axis=-1)
            canvas = Canvas.of(image, shift, pad)
            needed = np.maximum(needed, canvas.min_pad(foreground))
            kept = foreground[canvas.visible(canvas.corners["shifted"])]
            if count := np.count_nonzero(foreground) - np.count_nonzero(kept):
                cut_off.append((entry, count))
    if cut_off:
        entry, count = cut_off[0]
        more = f" ({len(cut_off)} views would lose some)" if cut_off[1:] else ""
        problem = f"would lose {count} pixel{'' if count == 1 else 's'} of its object past the edge of the canvas{more}"
        raise entry.image.error(problem, f"give at least --pad {needed[0]:g} {needed[1]:g}, or no --pad")
    return plan


def _output_files(data: Path, frame: JsonValue, entry: Entry, written: dict[str, tuple[str, str]]) -> dict[str, str]:
    """Where inside a copy the frame's image and mask go, listed or not; `written` maps files already in use to their
    source."""
    files = {}
    for key in ("file_path", "mask_path"):
        if value := frame.optional(key):
            listed = listed_file(read_path(value, data))
            stem, suffix = os.path.splitext(Path(os.path.normpath(listed)).as_posix())
            file = stem + (suffix if suffix.lower() == ".png" else ".png")
            if _is_inverted(key, file):  # and the copy's mask is not
                file = str(PurePosixPath(file).with_name(PurePosixPath(file).name.removeprefix(DYNAMIC_MASK)))
            if file.startswith("../"):  # and in again: the loader does not mind, but we write there
                raise value.location.error(f"{quote(listed)} leads out of the folder", "write the path without ..")
            source = (key, os.path.realpath(data / listed))
            if written.setdefault(file, source) != source:
                problem = f"{quote(listed)} would be written over another picture, {quote(file)}"
                raise value.location.error(problem, "give each image and mask a name of its own")
            files[key] = file
    if entry.mask is not None and "mask_path" not in files:
        files["mask_path"] = f"masks/{files['file_path']}"
        source = ("mask_path", str(entry.mask.path))
        if written.setdefault(files["mask_path"], source) != source:
            raise frame.location.error(f"its mask would be written over {files['mask_path']}", "list it as mask_path")
    return files


def _document(
    source: dict[str, Any], files: Files, views: Views, canvases: Sequence[Canvas], copy: str
) -> dict[str, Any]:
    """The json of a copy: the source's, but for the cameras' intrinsics, and .jpg that became .png."""
    intrinsics = [
        {
            "w": canvas.size[0],
            "h": canvas.size[1],
            "fl_x": float(views.cameras.fx[i]),
            "fl_y": float(views.cameras.fy[i]),
            "cx": float(views.cameras.cx[i]) + canvas.corners[copy][0],
            "cy": float(views.cameras.cy[i]) + canvas.corners[copy][1],
        }
        for i, canvas in enumerate(canvases)
    ]
    shared = {key: value for key, value in intrinsics[0].items() if all(other[key] == value for other in intrinsics)}
    top = {key: value for key, value in source.items() if key not in intrinsics[0]} | shared
    if "camera_angle_x" in top:  # not for us, who take fl_x, but for loaders that know nothing else
        if "w" in shared:
            widened = canvases[0].size[0] / canvases[0].picture[0]
            top["camera_angle_x"] = 2 * math.atan(math.tan(top["camera_angle_x"] / 2) * widened)
        else:
            del top["camera_angle_x"]  # no one angle is true of all
    top.pop("camera_angle_y", None)
    del top["frames"]
    top["frames"] = [
        {key: value for key, value in frame.items() if key not in ANGLES}
        | {key: value for key, value in own.items() if key in frame or key not in shared}
        | {key: file for key, file in written.items() if not _is_kept(key, frame.get(key))}
        for frame, own, written in zip(source["frames"], intrinsics, files, strict=True)
    ]
    return top


def _is_kept(key: str, path: str | None) -> bool:
    """Whether a frame's file has the path in a copy that it is listed by, if it is."""
    return path is not None and listed_file(path).lower().endswith(".png") and not _is_inverted(key, path)


def _is_inverted(key: str, path: str) -> bool:
    """Whether a listed file is a mask of instant-ngp's, which is read the other way round by its name."""
    return key == "mask_path" and PurePosixPath(path).name.startswith(DYNAMIC_MASK)


def _write_view(folder: Path, files: dict[str, str], canvas: Canvas, image: np.ndarray, entry: Entry) -> None:
    """One view's picture into both copies and, where its frame has one, its mask, whose grays may be alpha."""
    background = plain_background(image)
    assert background is not None  # _plan_copies has checked that
    layers: dict[str, tuple[np.ndarray, np.ndarray]] = {files["file_path"]: (image, background)}
    if entry.mask is not None:
        layers[files["mask_path"]] = (read_mask(entry.mask, image), np.zeros((), np.uint8))
    for copy, corner in canvas.corners.items():
        for file, (layer, around) in layers.items():
            path = folder / copy / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(iio.imwrite("<bytes>", canvas.paste(layer, corner, around), extension=".png"))
