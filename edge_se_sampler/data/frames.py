"""From what a format's files list to views: images decoded, undistorted and downscaled one by one, many at a time.

No image but those at work is in memory at its full size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.config import Masks
from edge_se_sampler.data.downscale import average_pixels, shrink_mask
from edge_se_sampler.data.image_file import ImageHeader, read_header, read_image, turn_upright
from edge_se_sampler.data.lens import Intrinsics, find_pinhole, find_sources, undistort
from edge_se_sampler.data.memory import check_memory, num_workers
from edge_se_sampler.data.scene_file import SourceFile, SourceLocation
from edge_se_sampler.data.views import Views
from edge_se_sampler.errors import InputError

Progress = Callable[[int, int], None]
"""Called with the number of images read so far, and of all."""
MAX_MISFIT = 2**22
"""Pixels of a mask of another size than its image, up to which it is decoded: it may be damaged, too."""
MAX_REMAPPED = 2**15 - 2
"""Pixels, of a side: OpenCV undistorts no larger images."""


@dataclass(frozen=True)
class Frame:
    """A view whose image is still in its file."""

    name: str
    """As the scene lists it."""
    image: SourceFile
    mask: SourceFile | None
    pose: np.ndarray
    """(3, 4) float64, camera to world, OpenGL's axes."""
    header: ImageHeader
    """Its image's; turned upright, where that is to be done."""
    camera: Intrinsics
    """Of the image of that size."""

    @property
    def pinhole(self) -> Intrinsics:
        """Of the image once its lens is undone."""
        return find_pinhole(self.camera, self.header.width, self.header.height)


@dataclass(frozen=True)
class LoadSettings:
    """What becomes of a scene's images."""

    masks: Masks = "ignore"
    """What a mask file means: pixels outside are unknown and ignored, or not of the object, which is alpha."""
    downscale: int = 1
    """Every so many pixels along both axes become one."""


def read_headers(files: Sequence[SourceFile]) -> list[ImageHeader]:
    """The headers of all files, many at a time."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(read_header, files))


def choose_orientation(file: SourceFile, header: ImageHeader, matches: Callable[[ImageHeader], bool]) -> ImageHeader:
    """The header of the image as its camera saw it: stored, or upright; what fits the camera's size decides, for
    programs differ. InputError if both fit and are not the same picture."""
    upright, as_stored = header.upright(), replace(header, orientation=1)
    if header.orientation == 1 or (matches(as_stored) and not matches(upright)):
        return as_stored
    if matches(upright) and not matches(as_stored) and header.orientation >= 5:
        return upright
    if not matches(as_stored) and not matches(upright):
        return as_stored  # another size, which the format's reader reports
    problem = f"has EXIF orientation {header.orientation}: whether its camera is that of the turned image is unknown"
    raise file.error(problem, "turn the pixels themselves, or remove the tag if the camera is that of the stored ones")


def load_views(
    frames: Sequence[Frame],
    settings: LoadSettings = LoadSettings(),
    progress: Progress = lambda done, total: None,
) -> Views:
    """Decode the images of at least one frame. InputError for images and masks that cannot be used, for a mask of
    another size, and where they would not fit the machine's memory."""
    listing = SourceLocation(frames[0].image.location.file)
    for frame in frames:
        _check_size(frame, settings.downscale)
    check_memory(_sizes(frames), settings.downscale, listing)
    largest = max(frame.header.width * frame.header.height for frame in frames)
    images, masks = [], []
    with ThreadPoolExecutor(num_workers(largest)) as pool:  # decoders and numpy release Python's lock
        for image, mask in pool.map(partial(_load_frame, settings=settings), frames):
            images.append(image)
            masks.append(mask)
            progress(len(images), len(frames))
    if settings.masks == "object" and all(image.shape[2] == 3 for image in images):
        raise listing.error("has neither masks nor alpha for --masks object", "add masks, or leave the flag out")
    has_masks = any(mask is not None for mask in masks)
    if has_masks:
        masks = [np.ones(i.shape[:2], dtype=bool) if m is None else m for i, m in zip(images, masks, strict=True)]
        if not any(mask.any() for mask in masks):
            location = frames[0].image.location
            frames_field = replace(location, field=location.field.partition("[")[0])
            raise frames_field.error("all pixels of all views are masked", "masks are non-zero where to train")
    names = tuple(frame.name for frame in frames)
    return Views(names, tuple(images), tuple(masks) if has_masks else None, _cameras(frames, settings.downscale))


def _sizes(frames: Sequence[Frame]) -> np.ndarray:
    """(n, 3) int64: width, height, and bytes of a pixel."""
    masked = [frame.mask is not None or frame.camera.lens is not None for frame in frames]
    headers = [frame.header for frame in frames]
    return np.array([(h.width, h.height, h.channels + m) for h, m in zip(headers, masked, strict=True)], dtype=np.int64)


def _check_size(frame: Frame, downscale: int) -> None:
    header = frame.header
    if downscale > min(header.width, header.height):
        size = f"{header.width} x {header.height} pixels"
        raise InputError(f"--downscale is {downscale}, but {frame.name} has only {size}; give a smaller number")
    if frame.camera.lens is not None and max(header.width, header.height) > MAX_REMAPPED:
        problem = f"has {header.width} x {header.height} pixels, too many to be undistorted"
        raise frame.image.error(problem, f"make it at most {MAX_REMAPPED} pixels wide and high")


def _load_frame(frame: Frame, settings: LoadSettings) -> tuple[np.ndarray, np.ndarray | None]:
    """The image (H, W, 3|4) uint8 of a frame, and where it may be trained on, (H, W) bool; None: everywhere."""
    image = turn_upright(read_image(frame.image), frame.header.orientation)
    mask = None if frame.mask is None else _read_mask(frame.mask, image)
    if mask is not None and settings.masks == "object":
        alpha = np.minimum(mask, image[..., 3]) if image.shape[2] == 4 else mask
        image, mask = np.concatenate((image[..., :3], alpha[..., None]), axis=2), None
    if frame.camera.lens is not None:
        sources, inside = find_sources(frame.camera, frame.pinhole, frame.header.width, frame.header.height)
        if not inside.any():
            raise frame.image.error("shows nothing once its lens is undone", "correct the distortion coefficients")
        image = undistort(image, sources, inside)
        if mask is not None:  # of a pixel between masked and other ones, a part is unknown
            mask = undistort(np.where(mask > 0, np.uint8(255), np.uint8(0)), sources, inside) == 255
        elif not inside.all():
            mask = inside
    factor = settings.downscale
    mask = None if mask is None else mask > 0
    if factor == 1:
        return image, mask
    return average_pixels(image, factor), None if mask is None else shrink_mask(mask, factor)


def _read_mask(file: SourceFile, image: np.ndarray) -> np.ndarray:
    """(H, W) uint8: the largest color of the mask's pixels; it is turned as its image was."""
    (height, width), header = image.shape[:2], read_header(file)
    found = header.height, header.width
    if found == (height, width) or header.height * header.width <= MAX_MISFIT:
        colors = read_image(file)[..., :3]  # without alpha: an opaque black mask still masks
        found = colors.shape[:2]
        if found == (height, width):
            return colors.max(axis=2)
    problem = f"is {found[1]} x {found[0]} pixels, its image {width} x {height}"
    raise file.error(problem, "give the mask the size of its image")


def _cameras(frames: Sequence[Frame], downscale: int) -> Cameras:
    intrinsics = {key: [getattr(frame.pinhole, key) for frame in frames] for key in ("fx", "fy", "cx", "cy")}
    width, height = np.array([(frame.header.width, frame.header.height) for frame in frames]).T
    cameras = Cameras.of([frame.pose for frame in frames], **intrinsics, width=width, height=height)
    return cameras if downscale == 1 else cameras.downscale(downscale)
