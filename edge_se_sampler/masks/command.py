"""edge-se masks: object masks for a folder of images, where its reader finds them, and a picture to judge them by."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import imageio.v3 as iio
import numpy as np

from edge_se_sampler.data.capture import SPLITS
from edge_se_sampler.data.dataset import DataSettings, list_frames
from edge_se_sampler.data.frames import Frame, check_scene
from edge_se_sampler.data.image_file import read_image, turn_upright
from edge_se_sampler.data.lens import Intrinsics
from edge_se_sampler.data.mask_files import place_of_mask
from edge_se_sampler.data.memory import num_workers
from edge_se_sampler.data.new_folder import staged_folders
from edge_se_sampler.data.scene_file import SourceLocation, quote
from edge_se_sampler.engine.files import check_output, write_atomically
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.masks.segmentation import segment

MAX_SIDE = 400
"""Pixels of the longer side of an image whose mask is looked for; the mask is enlarged to the image's own size."""
MIN_VIEWS = 3
"""Of fewer, two agree on anything."""
NUM_SHOWN, SHOWN_SIDE = 8, 300
OUTLINE = (230, 40, 40)


def make_masks(folder: Path, settings: DataSettings, picture: Path, out: Path | None = None) -> str:
    """Write a mask for each image of a folder, 255 on the object, into `out`, by default the folder itself, and the
    picture; returns lines about them.

    Raises:
        InputError: too few images, some have masks or alpha already, in none is there an object, or masks cannot be
            written.
    """
    check_output(picture, ".png")
    out = folder if out is None else out
    frames = _frames(folder, settings)
    places = [_place(folder, frame) for frame in frames]
    for place, count in Counter(places).items():
        if count > 1:
            problem = f"{count} images would have the mask {place.relative_to(folder)}"
            raise SourceLocation(folder).error(problem, "give images that lie in different folders names of their own")
    targets = sorted({out / place.relative_to(folder).parts[0] for place in places})
    with staged_folders(out, targets) as workspace:
        images = _read_images(frames)
        lenses = [_scaled_camera(frame, image) for frame, image in zip(frames, images, strict=True)]
        with Progress(0, "masks") as progress:
            masks = segment(images, lenses, [frame.pose for frame in frames], progress.update)
        shares = np.array([mask.mean() for mask in masks])
        if not shares.any() or shares.min() == 1:
            problem = "no object stands out from the background" if not shares.any() else "the object fills all images"
            raise SourceLocation(folder).error(problem, "masks are found in front of a plain background alone")
        for frame, place, mask in zip(frames, places, masks, strict=True):
            file = workspace / place.relative_to(folder)
            file.parent.mkdir(parents=True, exist_ok=True)
            iio.imwrite(file, _enlarge(mask, frame.header.width, frame.header.height))
        write_atomically(picture, iio.imwrite("<bytes>", _draw(images, masks), extension=".png"))
    odd = [frame.name for frame, share in zip(frames, shares, strict=True) if share in (0, 1)]
    lines = [f"{len(masks)} masks in {', '.join(map(str, targets))}: the object covers {np.median(shares):.0%} of the "
             f"median image ({shares.min():.0%} to {shares.max():.0%})"]  # fmt: skip
    lines += [f"of {len(odd)} images all or nothing is object, {quote(odd[0])} for one"] if odd else []
    then = f"edge-se train lean-nerf --data {shlex.quote(str(folder))} --masks object"
    then += "" if settings.data_format == "auto" else f" --data-format {settings.data_format}"
    if out != folder:
        then = f"copy what is in {out} into {folder}, or into a copy of it; then: {then}"
    return "\n".join([*lines, f"look at {picture}; then: {then}"])


def _frames(folder: Path, settings: DataSettings) -> list[Frame]:
    """The frames of all splits, once each."""
    found = {frame.image.path: frame for split in SPLITS for frame in list_frames(folder, split, settings)}
    frames = [found[path] for path in sorted(found)]
    if len(frames) < MIN_VIEWS:
        problem = f"has {len(frames)} images, of which masks cannot be refined across views"
        raise SourceLocation(folder).error(problem, f"give at least {MIN_VIEWS}")
    check_scene(frames)
    for frame in frames:
        if frame.mask is not None:
            raise frame.image.error(f"has a mask already: {frame.mask.path}", "use it, or remove all masks")
    return frames


def _place(folder: Path, frame: Frame) -> Path:
    try:
        return place_of_mask(folder, frame.image.path)
    except ValueError:
        raise frame.image.error("lies outside of the scene's folder", "copy the images into it") from None


def _read_images(frames: Sequence[Frame]) -> list[np.ndarray]:
    """`_read_small` of all frames, many at a time."""
    images: list[np.ndarray] = []
    pixels = max(frame.header.width * frame.header.height for frame in frames)
    with ThreadPoolExecutor(num_workers(pixels)) as pool, Progress(len(frames), "reading images") as progress:
        for image in pool.map(_read_small, frames):
            images.append(image)
            progress.update(len(images))
    return images


def _read_small(frame: Frame) -> np.ndarray:
    """(h, w, 3) uint8: a frame's image, upright and at most MAX_SIDE pixels wide and high."""
    image = turn_upright(read_image(frame.image), frame.header.orientation)
    if image.shape[2] == 4 and (image[..., 3] < 255).any():
        raise frame.image.error("has alpha, which is a mask already", "train on it as it is")
    scale = min(1.0, MAX_SIDE / max(image.shape[:2]))
    width, height = (max(1, round(scale * side)) for side in image.shape[1::-1])
    return cv2.resize(np.ascontiguousarray(image[..., :3]), (width, height), interpolation=cv2.INTER_AREA)


def _scaled_camera(frame: Frame, image: np.ndarray) -> Intrinsics:
    """The camera of a frame's image at another size."""
    return frame.camera.scaled(image.shape[1] / frame.header.width, image.shape[0] / frame.header.height)


def _enlarge(mask: np.ndarray, width: int, height: int) -> np.ndarray:
    """(height, width) uint8, 255 where a mask (h, w) is True, its outline smooth."""
    enlarged = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(enlarged >= 0.5, np.uint8(255), np.uint8(0))


def _draw(images: Sequence[np.ndarray], masks: Sequence[np.ndarray]) -> np.ndarray:
    """Some of the images in two rows, what is outside of the masks faded, and outlined."""
    tiles = []
    for i in np.unique(np.linspace(0, len(images) - 1, NUM_SHOWN).round().astype(int)).tolist():
        scale = SHOWN_SIDE / max(images[i].shape[:2])
        width, height = (max(1, round(scale * side)) for side in images[i].shape[1::-1])
        image, mask = cv2.resize(images[i], (width, height)), _enlarge(masks[i], width, height)
        shown = np.where(mask[..., None] > 0, image, (0.3 * image + 0.7 * 255).astype(np.uint8))
        shown[cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((3, 3))) > 0] = OUTLINE
        tile = np.full((SHOWN_SIDE, SHOWN_SIDE, 3), 255, dtype=np.uint8)
        tile[:height, :width] = shown
        tiles.append(tile)
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % 2)
    half = len(tiles) // 2
    return np.concatenate([np.concatenate(row, axis=1) for row in (tiles[:half], tiles[half:])])
