"""Scenes for programs that read only folders: copies in which the images are as our readers give them, downscaled and
their lenses undone, so that every program trains and is tested on the same pixels, cameras and held-out views.

Scenes that are as NeRF's Blender scenes are become Blender folders. Others become one transforms.json as nerfstudio
reads it: intrinsics of every frame, and a list of the files of each split.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from edge_se_sampler.data.blender import transforms_path
from edge_se_sampler.data.capture import SPLITS, Split
from edge_se_sampler.data.dataset import DataSettings, read_split
from edge_se_sampler.data.new_folder import staged_folders, unless_made_meanwhile
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.progress import Progress


def copied_scene(workplace: Path, data: Path, downscale: int) -> Path:
    """The copy of a scene in workplace/scenes, written if it is not there. InputError if the scene cannot be used."""
    source = data.resolve()
    copy = workplace / "scenes" / f"downscale-{downscale}" / Path(*source.parts[1:])
    if not copy.exists():
        with unless_made_meanwhile(copy), Progress(0, f"copying {source.name}") as progress:
            settings = DataSettings(downscale=downscale)
            splits: dict[Split, Views] = {}
            for split in SPLITS:
                if views := read_split(source, split, settings, progress.update):
                    splits[split] = views
            with staged_folders(copy.parent, [copy]) as workspace:
                write_scene(workspace / copy.name, splits)
    return copy


def write_scene(folder: Path, splits: Mapping[Split, Views]) -> None:
    """Write splits, images as PNG and masks beside them, into a new folder."""
    splits = {split: views for split, views in splits.items() if split != "val" or views.eval_every is None}  # is test
    masked = any(views.masks is not None for views in splits.values())  # nerfstudio wants masks of all frames or none
    frames = {split: _write_views(folder, split, views, masked) for split, views in splits.items()}
    documents: dict[Path, dict[str, Any]] = {}
    if all(_is_nerfs(views) for views in splits.values()):
        for split, listed in frames.items():
            angle = 2 * math.atan(listed[0]["w"] / 2 / listed[0]["fl_x"])
            listed = [frame | {"file_path": frame["file_path"].removesuffix(".png")} for frame in listed]
            documents[transforms_path(folder, split)] = {"camera_angle_x": angle, "frames": listed}
    else:
        names = {f"{split}_filenames": [frame["file_path"] for frame in listed] for split, listed in frames.items()}
        documents[folder / "transforms.json"] = {**names, "frames": [*chain(*frames.values())]}
    for path, document in documents.items():
        path.write_text(json.dumps(document, indent=1), encoding="utf-8")


def _is_nerfs(views: Views) -> bool:
    """Whether one angle says all of the cameras' intrinsics, and near and far are those of NeRF's scenes."""
    cameras = views.cameras
    expected = {"fy": cameras.fx, "cx": cameras.width / 2, "cy": cameras.height / 2}
    centered = all(np.allclose(getattr(cameras, name), value) for name, value in expected.items())
    same = all(np.allclose(value, value[0]) for value in (cameras.fx, cameras.width, cameras.height))
    return views.depths is not None and centered and same


def _write_views(folder: Path, split: Split, views: Views, masked: bool) -> list[dict[str, Any]]:
    """The frames of a split, in the views' order, which is that of their files' names, too."""
    masks = views.masks or [np.ones(image.shape[:2], dtype=bool) for image in views.images]
    for part in ("images", "masks") if masked else ("images",):
        (folder / split / part).mkdir(parents=True)
    intrinsics = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "w": "width", "h": "height"}
    frames = []
    for i, image in enumerate(views.images):
        frame: dict[str, Any] = {"file_path": f"{split}/images/{i:04d}.png"}
        iio.imwrite(folder / frame["file_path"], image)
        if masked:
            frame["mask_path"] = f"{split}/masks/{i:04d}.png"
            iio.imwrite(folder / frame["mask_path"], masks[i] * np.uint8(255))
        frame |= {key: getattr(views.cameras, name)[i].item() for key, name in intrinsics.items()}
        frames.append(frame | {"transform_matrix": [*views.cameras.camera_to_worlds[i].tolist(), [0, 0, 0, 1]]})
    return frames
