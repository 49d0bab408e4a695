"""Mask files that no file of a scene lists: where they are looked for, and where `edge-se masks` writes them."""

from __future__ import annotations

import os
from pathlib import Path

from edge_se_sampler.data.scene_file import SourceFile, locate_file


def place_of_mask(folder: Path, image: Path) -> Path:
    """Where the mask of an image in the folder of a scene lies, as COLMAP has it: in `masks` for `images`, `masks_2`
    for `images_2` and so on, else under `masks`; with .png added to the image's name. ValueError: the image lies
    outside the folder."""
    parts = image.relative_to(os.path.realpath(folder)).parts
    if len(parts) > 1 and parts[0].split("_")[0] == "images":
        parts = parts[0].replace("images", "masks"), *parts[1:]
    else:
        parts = "masks", *parts
    place = folder.joinpath(*parts)
    return place.with_name(f"{place.name}.png")


def find_mask(folder: Path, image: SourceFile) -> SourceFile | None:
    """The mask of an image for which the scene lists none; None: there is none either. InputError if it lies outside
    the folder."""
    if not image.path.is_relative_to(os.path.realpath(folder)):
        return None
    place = place_of_mask(folder, image.path)
    return locate_file(folder, str(place.relative_to(folder)), image.location) if os.path.isfile(place) else None
