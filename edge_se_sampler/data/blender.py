"""Folders in the format of NeRF's Blender scenes (NeRF-synthetic): transforms_{train,val,test}.json and images."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from edge_se_sampler.data.capture import SPLITS, Split
from edge_se_sampler.data.frames import Frame, LoadSettings, Progress, load_views
from edge_se_sampler.data.scene_file import JsonValue, SourceLocation, check_folder, read_json
from edge_se_sampler.data.transforms_frames import read_entries, read_frames
from edge_se_sampler.data.views import NERF_SYNTHETIC_DEPTHS, NERF_SYNTHETIC_DISTANCES, Views


def transforms_path(folder: Path, split: str) -> Path:
    return folder / f"transforms_{split}.json"


def has_split(folder: Path, split: str) -> bool:
    """Whether the folder has a transforms_<split>.json."""
    return os.path.exists(transforms_path(Path(folder), split))


def has_views(folder: Path, split: str) -> bool:
    """Whether the json of a split lists images of which some exist: add-ons list cameras that nobody renders.
    InputError as `read_blender`, of the json."""
    if not has_split(folder, split):
        return False
    top = read_json(transforms_path(folder, split))
    listed = top.optional("frames")
    if listed is not None and not listed.list():
        return False
    return any(os.path.exists(entry.image.path) for entry in read_entries(top, folder))


def read_blender(
    folder: Path,
    split: Split,
    settings: LoadSettings = LoadSettings(),  # noqa: B008 (frozen)
    progress: Progress = lambda done, total: None,
) -> Views:
    """Read one split of a scene; files that no frame lists are ignored, but for masks (`mask_files`). Poses are
    returned as written (not moved, scaled or orthonormalized). A frame without a mask is trained on as a whole.
    InputError for anything that cannot be used: first of the folder, then of the json, then of the images."""
    frames, top = list_frames(Path(folder), split)
    depths = NERF_SYNTHETIC_DEPTHS if _is_of_nerf(top, frames) else None
    views = load_views(settings.choose(frames), settings, progress)
    return replace(views, depths=depths, data_format="blender")


def _is_of_nerf(top: JsonValue, frames: list[Frame]) -> bool:
    """Whether a scene is as large as NeRF's own. Others, whose units are their own, have cameras elsewhere, or state
    focal lengths in pixels alone."""
    distance = np.median([np.linalg.norm(frame.pose[:, 3]) for frame in frames])
    nearest, farthest = NERF_SYNTHETIC_DISTANCES
    return "camera_angle_x" in top.object() and bool(nearest < distance < farthest)


def list_frames(folder: Path, split: str) -> tuple[list[Frame], JsonValue]:
    """The frames of one split, and the json that lists them; InputError as `read_blender`."""
    check_folder(folder)
    _check_split(folder, split)
    top = read_json(transforms_path(folder, split))
    return read_frames(read_entries(top, folder)), top


def _check_split(folder: Path, split: str) -> None:
    if has_split(folder, split):
        return
    found = ", ".join(transforms_path(folder, other).name for other in SPLITS if has_split(folder, other))
    others = f"only {found}" if found else "nor that of any other split"
    hint = "a Blender scene has transforms_train.json and, for other splits, transforms_val.json, transforms_test.json"
    raise SourceLocation(folder).error(f"has no transforms_{split}.json, {others}", hint)
