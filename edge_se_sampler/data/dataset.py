"""Any folder of images with cameras -> the views of one split, by the reader of its format."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from edge_se_sampler.data.blender import has_views, is_left_out, read_blender, transforms_path
from edge_se_sampler.data.blender import list_frames as list_blender_frames
from edge_se_sampler.data.capture import EVAL_EVERY, SPLITS, Capture, Split
from edge_se_sampler.data.colmap import read_colmap
from edge_se_sampler.data.colmap_model import find_models
from edge_se_sampler.data.config import DataFormat, Masks
from edge_se_sampler.data.frames import Frame, LoadSettings, Progress, Select, check_scene, load_views, select_all
from edge_se_sampler.data.llff import bounds_path, read_llff
from edge_se_sampler.data.mask_files import describe_unused_masks
from edge_se_sampler.data.memory import ModelMemory
from edge_se_sampler.data.scene_file import SourceLocation, check_folder, quote
from edge_se_sampler.data.transforms import read_transforms
from edge_se_sampler.data.views import Views
from edge_se_sampler.errors import InputError, check_value

READERS = {"transforms": read_transforms, "colmap": read_colmap, "llff": read_llff}
"""Of the formats whose images we may have to split."""
CONTENTS = {
    "blender": "transforms_train.json",
    "transforms": "transforms.json",
    "colmap": "sparse/0, sparse or colmap/sparse/0 with cameras, images and points3D",
    "llff": "poses_bounds.npy",
}
"""Files by which each format is recognized."""


@dataclass(frozen=True)
class DataSettings:
    """How a folder is read."""

    data_format: DataFormat = "auto"
    masks: Masks = "ignore"
    eval_every: int | None = None
    downscale: int = 1
    model_memory: ModelMemory | None = None
    """What training takes of memory beside the images; None: nothing is trained on them."""
    select: Select = select_all
    """Which of a split's views are read."""


def find_format(folder: Path, data_format: DataFormat = "auto") -> DataFormat:
    """The format of a folder by what it has, the first of CONTENTS if there are several, or the one that is insisted
    on; InputError if the folder has none, or not that one."""
    check_folder(folder)
    found = _list_formats(folder)
    if data_format in found or (data_format == "auto" and found):
        return found[0] if data_format == "auto" else data_format
    wanted = CONTENTS if data_format == "auto" else {data_format: CONTENTS[data_format]}
    problem = "has nothing that lists cameras: no transforms_train.json or the like"
    if data_format != "auto":
        problem = f"is no scene in the format {data_format}"
    hint = "give a folder with " + "; ".join(f"{name}: {content}" for name, content in wanted.items())
    inner = sorted(path for path in folder.iterdir() if os.access(path / ".", os.R_OK | os.X_OK))
    if scene := next((path.name for path in inner if set(wanted) & set(_list_formats(path))), None):
        hint = f"its folder {quote(scene)} has such: give that"
    raise SourceLocation(folder).error(problem, hint)


def _list_formats(folder: Path) -> list[DataFormat]:
    """The formats for which a folder has something, in the order of CONTENTS."""
    found: list[DataFormat] = []
    if any(transforms_path(folder, split).exists() for split in SPLITS):
        found.append("blender")
    if (folder / "transforms.json").exists():
        found.append("transforms")
    if find_models(folder):
        found.append("colmap")
    if bounds_path(folder).exists():
        found.append("llff")
    return found


def read_split(
    folder: Path,
    split: Split,
    settings: DataSettings = DataSettings(),
    progress: Progress = lambda done, total: None,
) -> Views | None:
    """The views of one split of a folder; None where val or test have none, or none of which a pixel is known.
    InputError for what cannot be used."""
    check_value("downscale", settings.downscale, settings.downscale >= 1, "at least 1")
    check_value(
        "eval-every", settings.eval_every, settings.eval_every is None or settings.eval_every >= 2, "at least 2"
    )
    data_format = find_format(folder, settings.data_format)
    load = LoadSettings(
        settings.masks, settings.downscale, settings.model_memory, settings.select, held_out=split != "train"
    )
    if data_format == "blender":
        _check_unsplit(settings, has_own_split=True)
        if split != "train" and is_left_out(folder, split):
            return None
        return _leave_out_unknown(read_blender(folder, split, load, progress), folder, split, settings)
    capture, rows, eval_every = _read_capture(folder, split, settings, data_format)
    if split == "train" and not rows:
        problem, hint = "has no images to train on", "add some, or correct its lists"
        if capture.splits is None:
            problem, hint = "its only image is held out", "add some, or list it in a transforms.json's train_filenames"
        raise SourceLocation(folder).error(problem, hint)
    if not rows:
        return None
    if split == "train":
        check_scene([capture.frames[i] for i in rows])
    rows = load.choose(rows)
    views = load_views([capture.frames[i] for i in rows], load, progress)
    points = None if capture.points is None else tuple(capture.points[i] for i in rows)
    views = replace(views, points=points, depths=None, data_format=data_format, eval_every=eval_every)
    return _leave_out_unknown(views, folder, split, settings)


def _leave_out_unknown(views: Views, folder: Path, split: Split, settings: DataSettings) -> Views | None:
    """The views, or None if masks leave nothing of all of them, and a line if these are all of the split."""
    if views.masks is None or any(mask.any() for mask in views.masks):
        return views
    if settings.select is select_all:
        problem = f"the {split} views are masked as a whole, {len(views.names)} of them: left out"
        print(f"{folder}: {problem}", file=sys.stderr)
    return None


def list_frames(folder: Path, split: Split, settings: DataSettings = DataSettings()) -> list[Frame]:
    """The frames of one split of a folder, whose images are not decoded; none where val or test have none. InputError
    for what cannot be used."""
    data_format = find_format(folder, settings.data_format)
    if data_format == "blender":
        return list_blender_frames(folder, split)[0] if split == "train" or has_views(folder, split) else []
    capture, rows, _ = _read_capture(folder, split, settings, data_format)
    return [capture.frames[i] for i in rows]


def _read_capture(
    folder: Path, split: Split, settings: DataSettings, data_format: DataFormat
) -> tuple[Capture, list[int], int | None]:
    """A capture, the indices of a split's frames, and every how many of them one is held out; None: the data says
    which. With the training split it is said what was left out."""
    capture = READERS[data_format](folder)
    _check_unsplit(settings, has_own_split=capture.splits is not None)
    if split == "train":
        for line in (*capture.left_out, *describe_unused_masks(folder, capture.frames)):
            print(line, file=sys.stderr)
    every = EVAL_EVERY if settings.eval_every is None else settings.eval_every
    return capture, capture.select(split, every), every if capture.splits is None else None


def _check_unsplit(settings: DataSettings, has_own_split: bool) -> None:
    if has_own_split and settings.eval_every is not None:
        raise InputError("--eval-every has no effect: the data says itself which images are held out; leave it out")
