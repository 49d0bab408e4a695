"""Folders in the format of NeRF's Blender scenes (NeRF-synthetic): transforms_{train,val,test}.json and images."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from edge_se_sampler.data.capture import SPLITS, Split, keep_existing
from edge_se_sampler.data.frames import Frame, LoadSettings, Progress, check_scene, load_views
from edge_se_sampler.data.mask_files import describe_unused_masks
from edge_se_sampler.data.scene_file import JsonValue, SourceFile, SourceLocation, check_folder, quote, read_json
from edge_se_sampler.data.transforms_frames import read_entries, read_frames
from edge_se_sampler.data.views import NERF_SYNTHETIC_DEPTHS, NERF_SYNTHETIC_DISTANCES, Views

OF_PHOTOGRAPHS = {"k1", "k2", "k3", "k4", "p1", "p2", "aabb_scale"}
"""Keys of a json that nobody writes of rendered images."""


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
    return any(entry.image.is_there() for entry in read_entries(top, folder))


def is_left_out(folder: Path, split: str) -> bool:
    """Whether nothing is to be read of a split: it has no json, or none that is there of its images, which is said; but
    training images must be there. InputError as `has_views`."""
    if has_views(folder, split):
        return False
    if has_split(folder, split):
        if split == "train":
            return False
        print(f"{transforms_path(folder, split)}: none of its images exists: left out", file=sys.stderr)
    return True


def read_blender(
    folder: Path,
    split: Split,
    settings: LoadSettings = LoadSettings(),  # noqa: B008 (frozen)
    progress: Progress = lambda done, total: None,
) -> Views:
    """Read one split of a scene; files that no frame lists are ignored, but for masks (`mask_files`). Poses are
    returned as written (not moved, scaled or orthonormalized). A frame without a mask is trained on as a whole.
    Held-out images that do not exist are left out, if at least half of them do. InputError for anything that cannot be
    used: first of the folder, then of the json, then of the images."""
    frames, top = list_frames(Path(folder), split)
    depths = NERF_SYNTHETIC_DEPTHS if _is_of_nerf(top, frames) else None
    if split == "train":
        check_scene(frames)
        for line in describe_unused_masks(Path(folder), frames):
            print(line, file=sys.stderr)
    views = load_views(settings.choose(frames), settings, progress)
    return replace(views, depths=depths, data_format="blender")


def _is_of_nerf(top: JsonValue, frames: list[Frame]) -> bool:
    """Whether a scene is as large as NeRF's own. Others, whose units are their own, have cameras elsewhere, or state
    focal lengths in pixels alone, or what only photographs have: instant-ngp's tools bring those to the same size."""
    with np.errstate(over="ignore"):  # cameras may be absurdly far away, which is found out later
        distance = np.median([np.linalg.norm(frame.pose[:, 3]) for frame in frames])
    nearest, farthest = NERF_SYNTHETIC_DISTANCES
    is_photographed = not top.object().keys().isdisjoint(OF_PHOTOGRAPHS)
    return "camera_angle_x" in top.object() and not is_photographed and bool(nearest < distance < farthest)


def list_frames(folder: Path, split: str) -> tuple[list[Frame], JsonValue]:
    """The frames of one split, and the json that lists them; InputError as `read_blender`."""
    check_folder(folder)
    _check_split(folder, split)
    top = read_json(transforms_path(folder, split))
    entries = read_entries(top, folder)
    if split != "train":
        images = [entry.image for entry in entries]
        entries, left_out = keep_existing(entries, images, top.required("frames", "").location)
        for line in left_out + _find_trained_on(folder, images):
            print(line, file=sys.stderr)
    return read_frames(entries), top


def _find_trained_on(folder: Path, images: Sequence[SourceFile]) -> list[str]:
    """A line that says how many held-out images are training images, too, if any are."""
    if not has_split(folder, "train"):
        return []
    trained_on = {entry.image.path for entry in read_entries(read_json(transforms_path(folder, "train")), folder)}
    both = [image for image in images if image.path in trained_on]
    if not both:
        return []
    found = f"{len(both)} of {len(images)} images are in transforms_train.json, too, {quote(both[0].name)} for one"
    return [f"{both[0].location.file}: {found}: what they measure says nothing of new views"]


def _check_split(folder: Path, split: str) -> None:
    if has_split(folder, split):
        return
    found = ", ".join(transforms_path(folder, other).name for other in SPLITS if has_split(folder, other))
    others = f"only {found}" if found else "nor that of any other split"
    hint = "a Blender scene has transforms_train.json and, for other splits, transforms_val.json, transforms_test.json"
    if (folder / "transforms.json").exists():
        hint = "to train on its transforms.json add --data-format transforms"
    raise SourceLocation(folder).error(f"has no transforms_{split}.json, {others}", hint)
