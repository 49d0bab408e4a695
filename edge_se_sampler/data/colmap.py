"""Folders with images and a sparse model of COLMAP."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from edge_se_sampler.data.capture import Capture, keep_existing
from edge_se_sampler.data.colmap_model import (
    ColmapCamera,
    ColmapImage,
    find_models,
    read_cameras,
    read_images,
    read_points,
)
from edge_se_sampler.data.frames import Frame, choose_orientation, read_headers
from edge_se_sampler.data.image_file import ImageHeader
from edge_se_sampler.data.mask_files import find_mask
from edge_se_sampler.data.scene_file import SourceFile, SourceLocation, check_listed_once, locate_file

FOLDERS = ("images", "images_2", "images_4", "images_8")
"""Where the images may be: the largest ones that there are."""
ROUNDING = 1.5
"""Pixels by which a side of a scaled image may be off what the other says."""


def read_colmap(folder: Path) -> Capture:
    """The registered images of a scene that exist, in the order of their names, with the points that each sees.
    InputError for files that cannot be used, or if fewer than half of the images exist."""
    model, *others = find_models(folder)
    cameras, listed = read_cameras(model), read_images(model)
    images_folder = find_images(folder)
    listed.sort(key=lambda image: image.name)
    files = [_locate(images_folder, image) for image in listed]
    check_listed_once(files)
    for image in listed:
        if image.camera_id not in cameras:
            raise image.location.error(f"there is no camera {image.camera_id}", "copy the whole model")
    pairs, left_out = keep_existing(
        list(zip(listed, files, strict=True)), files, SourceLocation(files[0].location.file)
    )
    headers = read_headers([file for _, file in pairs])
    masks = [find_mask(folder, f"{images_folder.name}/{image.name}", file) for image, file in pairs]
    frames = [
        _frame(image, cameras[image.camera_id], file, header, mask)
        for (image, file), header, mask in zip(pairs, headers, masks, strict=True)
    ]
    if others:
        left_out.append(f"{model}: the largest of {1 + len(others)} models, of which the others are left out")
    return Capture(frames, left_out, points=_points_of(model, [image for image, _ in pairs]))


def find_images(folder: Path) -> Path:
    """The first of FOLDERS that has something; InputError if there is none."""
    for name in FOLDERS:
        if os.path.isdir(folder / name) and list_visible(folder / name):
            locate_file(folder, name, SourceLocation(folder))
            return folder / name
    raise SourceLocation(folder).error("has no images", f"put them into {', '.join(FOLDERS[:-1])} or {FOLDERS[-1]}")


def list_visible(folder: Path) -> list[str]:
    """Names in a folder without those that begin with a dot, which macOS puts beside images."""
    return [name for name in os.listdir(folder) if not name.startswith(".")]


def is_scaled(header: ImageHeader, width: float, height: float) -> bool:
    """Whether an image can be one of that size, scaled: one of its sides says the other, but for `ROUNDING`."""
    misfits = header.height - header.width * height / width, header.width - header.height * width / height
    return min(map(abs, misfits)) <= ROUNDING


def _locate(images_folder: Path, image: ColmapImage) -> SourceFile:
    if not image.name.strip():
        raise image.location.error("has no name", "write the model again")
    return locate_file(images_folder, image.name, image.location)


def _frame(
    image: ColmapImage, camera: ColmapCamera, file: SourceFile, header: ImageHeader, mask: SourceFile | None
) -> Frame:
    def matches(header: ImageHeader) -> bool:
        return is_scaled(header, camera.width, camera.height)

    header = choose_orientation(file, header, matches, prefers_stored=True)  # COLMAP itself turns none
    if not matches(header):
        problem = f"is {header.width} x {header.height} pixels, its camera's images {camera.width} x {camera.height}"
        raise file.error(problem, "use the images that the model was made of, or scaled ones")
    scaled = camera.intrinsics.scaled(header.width / camera.width, header.height / camera.height)
    return Frame(image.name, file, mask, image.pose, header, scaled)


def _points_of(model: Path, images: list[ColmapImage]) -> list[np.ndarray] | None:
    """Of each image the positions of the points that it sees; None if the model has no points."""
    points = read_points(model)
    if points is None or not len(points[0]):
        return None
    ids, positions = points
    rows = [np.searchsorted(ids, image.point_ids).clip(max=len(ids) - 1) for image in images]
    return [positions[row[ids[row] == image.point_ids]] for row, image in zip(rows, images, strict=True)]
