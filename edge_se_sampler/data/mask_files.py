"""Mask files that no file of a scene lists: where they are looked for, and where `edge-se masks` writes them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from edge_se_sampler.data.frames import DYNAMIC_MASK, Frame
from edge_se_sampler.data.scene_file import SourceFile, locate_file, quote


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


def find_mask(folder: Path, listed: str, image: SourceFile) -> SourceFile | None:
    """The mask of an image, listed under a path in the folder, for which the scene lists none: named as the image or,
    if that is a link, as its file, with .png added or in place of the suffix, or alike; or so with _mask behind the
    name, as Metashape writes them; or instant-ngp's, beside the image, with dynamic_mask_ before the name. None: there
    is none either. InputError if it lies outside the folder."""
    place = next((place for place in _places(folder, listed, image) if os.path.isfile(folder / place)), None)
    return None if place is None else locate_file(folder, str(place), image.location)


def _places(folder: Path, listed: str, image: SourceFile) -> Iterator[Path]:
    """Where in the folder the mask of an image may lie."""
    root = os.path.realpath(folder)
    own = [image.path.relative_to(root)] if image.path.is_relative_to(root) else []
    for path in dict.fromkeys((Path(os.path.normpath(listed)), *own)):
        first, *rest = path.parts
        inside = bool(rest) and first.split("_")[0] == "images"
        parts = rest if inside else path.parts
        for masks in dict.fromkeys((first.replace("images", "masks"), "masks") if inside else ("masks",)):
            place = Path(masks, *parts)
            yield from (place.with_name(f"{place.name}.png"), place.with_suffix(".png"), place)
            yield from (place.with_name(f"{place.stem}_mask{suffix}") for suffix in (".png", place.suffix))
        yield path.with_name(f"{DYNAMIC_MASK}{path.stem}.png")


def describe_unused_masks(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """A line if the folder has files where masks lie, but no frame has one."""
    if any(frame.mask is not None for frame in frames):
        return []
    files = [path for path in (folder / "masks").glob("**/*") if path.is_file() and not path.name.startswith(".")]
    if not files:
        return []
    found = f"has {len(files)} files, {quote(min(files).name)} for one, that are named after none of the images"
    return [f"{folder / 'masks'}: {found}: left out (masks/1.jpg.png would be the mask of images/1.jpg)"]
