"""From what a format's files list to views: images decoded, undistorted and downscaled one by one, many at a time.

No image but those at work is in memory at its full size.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import TypeVar

import numpy as np

from edge_se_sampler.data.cameras import Cameras, find_far
from edge_se_sampler.data.config import Masks
from edge_se_sampler.data.downscale import average_pixels, shrink_mask
from edge_se_sampler.data.image_file import ImageHeader, read_header, read_image, turn_upright
from edge_se_sampler.data.lens import Intrinsics, find_pinhole, find_sources, undistort
from edge_se_sampler.data.memory import ModelMemory, check_memory, num_workers
from edge_se_sampler.data.scene_file import SourceFile, SourceLocation, quote
from edge_se_sampler.data.views import Views
from edge_se_sampler.errors import InputError

Progress = Callable[[int, int], None]
"""Called with the number of images read so far, and of all."""
Select = Callable[[int], Sequence[int] | None]
"""Of so many views the indices of some, in an order; None: all."""
T = TypeVar("T")
DYNAMIC_MASK = "dynamic_mask_"
"""How the names of instant-ngp's masks begin."""


def select_all(_: int) -> None:
    """A `Select` of all views."""


MAX_MISFIT = 2**22
"""Pixels of a mask of another size than its image, up to which it is decoded: it may be damaged, too."""
MAX_REMAPPED = 2**15 - 2
"""Pixels, of a side: OpenCV undistorts no larger images."""
MIN_FOCAL, MAX_FOCAL = 0.01, 1e4
"""Focal lengths of cameras, in longer sides of their images: fields of view of 178 degrees, and of 20 arc seconds."""
MAX_OFFSET = 100.0
"""Of a principal point from the center, in the larger of the image's longer side and the focal length."""
MAX_POSITION, MAX_REMOVAL = 1e15, 1e4
"""Coordinates of a camera, world units; and how far all are from the origin, in their distances from each other, beyond
which numbers of 32 bits move them by more than a pixel."""


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
    model_memory: ModelMemory | None = None
    """What training takes of memory beside them; None: nothing is trained on them."""
    select: Select = select_all
    """Which of a split's views are read."""
    held_out: bool = False
    """Whether renderings are to be compared with them: masks may then leave nothing of all."""

    def choose(self, views: Sequence[T]) -> Sequence[T]:
        """The views that are read, of all of a split."""
        indices = self.select(len(views))
        return views if indices is None else [views[i] for i in indices]


def read_headers(files: Sequence[SourceFile]) -> list[ImageHeader]:
    """The headers of all files, many at a time."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(read_header, files))


def choose_orientation(
    file: SourceFile, header: ImageHeader, matches: Callable[[ImageHeader], bool], prefers_stored: bool = False
) -> ImageHeader:
    """The header of the image as its camera saw it: stored, or upright; what fits the camera's size decides, for
    programs differ. If both fit and are not the same picture, it is as stored where that is preferred, else
    InputError."""
    upright, as_stored = header.upright(), replace(header, orientation=1)
    if header.orientation == 1 or (matches(as_stored) and (prefers_stored or not matches(upright))):
        return as_stored
    if matches(upright) and not matches(as_stored) and header.orientation >= 5:
        return upright
    if not matches(as_stored) and not matches(upright):
        return as_stored  # another size, which the format's reader reports
    problem = f"has EXIF orientation {header.orientation}: whether its camera is that of the turned image is unknown"
    raise file.error(problem, "turn the pixels themselves, or remove the tag if the camera is that of the stored ones")


def check_cameras(frames: Sequence[Frame]) -> None:
    """InputError for cameras that cannot have taken the images of the frames."""
    for frame in frames:
        width, height, camera = frame.header.width, frame.header.height, frame.camera
        longest = max(width, height)
        for focal in (camera.fx, camera.fy):
            if not MIN_FOCAL * longest <= focal <= MAX_FOCAL * longest:
                problem = f"is of {width} x {height} pixels, and its camera's focal length is {focal:g}"
                raise frame.image.error(problem, "write the focal length in pixels")
        offset = max(abs(camera.cx - width / 2), abs(camera.cy - height / 2))
        if not offset <= MAX_OFFSET * max(longest, camera.fx, camera.fy):
            problem = f"has its camera's principal point at {camera.cx:g}, {camera.cy:g}, far outside of it"
            raise frame.image.error(problem, "write the principal point in pixels from the upper left corner")
        if not np.abs(frame.pose[:, 3]).max() <= MAX_POSITION:
            problem = f"has its camera at {', '.join(f'{x:g}' for x in frame.pose[:, 3])}"
            raise frame.image.error(problem, f"write coordinates of at most {MAX_POSITION:g}")


def check_scene(frames: Sequence[Frame]) -> None:
    """As `check_cameras`, of all of a scene's training images, at least one; InputError, too, if they are too far from
    the origin. One that is far from all others is named in a line."""
    check_cameras(frames)
    positions = np.array([frame.pose[:, 3] for frame in frames])
    center = np.median(positions, axis=0)
    distances = np.linalg.norm(positions - center, axis=1)
    spread, removal = distances.max(), np.linalg.norm(center)
    if spread > 0 and removal > MAX_REMOVAL * spread:
        problem = f"its cameras are {removal:.3g} from the origin, but only {spread:.3g} from each other"
        remedy = "subtract the same position from all poses, so that the origin is among them"
        raise SourceLocation(frames[0].image.location.file).error(problem, remedy)
    far, most = find_far(positions)
    if far.any():
        problem = (
            f"has its camera {spread:.3g} from the middle of all cameras, nine of ten of which are within {most:.3g}"
        )
        farthest = frames[int(distances.argmax())].image
        print(farthest.error(problem, "if that pose is wrong, leave the image out"), file=sys.stderr)


def load_views(
    frames: Sequence[Frame],
    settings: LoadSettings = LoadSettings(),
    progress: Progress = lambda done, total: None,
) -> Views:
    """Decode the images of at least one frame. InputError for images, masks and cameras that cannot be used, for a mask
    of another size, where they would not fit the machine's memory, and for masks that leave nothing to train on."""
    listing = SourceLocation(frames[0].image.location.file)
    check_cameras(frames)
    for frame in frames:
        _check_size(frame, settings.downscale)
    has_alpha = settings.masks == "object" or all(frame.header.channels == 4 for frame in frames)
    of_model = None if settings.model_memory is None else partial(settings.model_memory, has_alpha)
    memory = check_memory(_sizes(frames), settings.downscale, of_model, listing)
    largest = max(frame.header.width * frame.header.height for frame in frames)
    images, masks = [], []
    with ThreadPoolExecutor(num_workers(largest)) as pool:  # decoders and numpy release Python's lock
        for image, mask in pool.map(partial(_load_frame, settings=settings), frames):
            images.append(image)
            masks.append(mask)
            progress(len(images), len(frames))
    find_sources.cache_clear()
    if settings.masks == "object" and all(image.shape[2] == 3 for image in images):
        those = f"{quote(frames[0].name)} and the {len(frames) - 1} other views of its split"
        problem = f"{those} have neither masks nor alpha for --masks object"
        raise listing.error(problem, "add masks (masks/1.jpg.png for images/1.jpg), or leave the flag out")
    _check_alpha(frames, images, settings)
    has_masks = any(mask is not None for mask in masks)
    if has_masks:
        masks = [np.ones(i.shape[:2], dtype=bool) if m is None else m for i, m in zip(images, masks, strict=True)]
        if not (settings.held_out or any(mask.any() for mask in masks)):
            location = frames[0].image.location
            frames_field = replace(location, field=location.field.partition("[")[0])
            raise frames_field.error("all pixels of all views are masked", "masks are non-zero where to train")
    names = tuple(frame.name for frame in frames)
    cameras = _cameras(frames, settings.downscale)
    return Views(names, tuple(images), tuple(masks) if has_masks else None, cameras, memory=memory)


def _check_alpha(frames: Sequence[Frame], images: Sequence[np.ndarray], settings: LoadSettings) -> None:
    """InputError if there is no object in any view to train on; says so if only some views tell where it is."""
    by_masks = settings.masks == "object"
    if not settings.held_out and not any(image.shape[2] == 3 or image[..., 3].any() for image in images):
        problem = "masked" if by_masks else "transparent"
        remedy = "masks are non-zero on the object" if by_masks else "alpha is above 0 on the object"
        raise frames[0].image.error(f"and all other views are {problem} as a whole", remedy)
    whole = [frame for frame, image in zip(frames, images, strict=True) if image.shape[2] == 3]
    if 0 < len(whole) < len(frames):
        lacking = "neither mask nor alpha" if by_masks else "no alpha"
        found = f"{len(whole)} of {len(frames)} views have {lacking}, {quote(whole[0].name)} for one"
        print(f"{frames[0].image.location.file}: {found}: all of them counts as the object", file=sys.stderr)


def _sizes(frames: Sequence[Frame]) -> np.ndarray:
    """(n, 3) int64: width, height, and bytes of a pixel."""
    masked = [frame.mask is not None or frame.camera.lens is not None for frame in frames]
    headers = [frame.header for frame in frames]
    return np.array([(h.width, h.height, h.channels + m) for h, m in zip(headers, masked, strict=True)], dtype=np.int64)


def _check_size(frame: Frame, downscale: int) -> None:
    header = frame.header
    if downscale > min(header.width, header.height):
        size = f"{header.width} x {header.height} pixels"
        raise InputError(f"--downscale is {downscale}, but {quote(frame.name)} has only {size}; give a smaller number")
    if frame.camera.lens is not None and max(header.width, header.height) > MAX_REMAPPED:
        problem = f"has {header.width} x {header.height} pixels, too many to be undistorted"
        raise frame.image.error(problem, f"make it at most {MAX_REMAPPED} pixels wide and high")


def _load_frame(frame: Frame, settings: LoadSettings) -> tuple[np.ndarray, np.ndarray | None]:
    """The image (H, W, 3|4) uint8 of a frame, and where it may be trained on, (H, W) bool; None: everywhere."""
    image = turn_upright(read_image(frame.image), frame.header.orientation)
    mask = None if frame.mask is None else read_mask(frame.mask, image)
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


def read_mask(file: SourceFile, image: np.ndarray) -> np.ndarray:
    """(H, W) uint8: the largest color of the pixels of an image's mask or, where that is the same everywhere, their
    alpha; 255 in place of the one number that a mask may have beside 0. A JPEG's, in which black need not be 0, is 0
    or 255, whichever half it is in. It is turned as its own orientation says if that gives it the image's size. One of
    instant-ngp's, by its name, says what is not to be trained on: its black is 255, all else 0."""
    height, width = size = image.shape[:2]
    header = choose_orientation(
        file, read_header(file), lambda header: (header.width, header.height) == (width, height)
    )
    found = header.height, header.width
    if found == size or header.height * header.width <= MAX_MISFIT:
        pixels = turn_upright(read_image(file), header.orientation)
        found = pixels.shape[:2]
        if found == size:
            values = reduce(np.maximum, np.moveaxis(pixels[..., :3], 2, 0))  # max(axis=2) is slow
            if pixels.shape[2] == 4 and values.min() == values.max() and (pixels[..., 3] != pixels[0, 0, 3]).any():
                values = pixels[..., 3]
            if header.is_lossy:
                values = values & np.uint8(128)
            if os.path.basename(file.name).startswith(DYNAMIC_MASK):
                return np.where(values > 0, np.uint8(0), np.uint8(255))
            is_binary = ((values == 0) | (values == values.max())).all()
            return np.where(values > 0, np.uint8(255), np.uint8(0)) if is_binary else values
    problem = f"is {found[1]} x {found[0]} pixels, its image {width} x {height}"
    raise file.error(problem, "give the mask the size of its image")


def _cameras(frames: Sequence[Frame], downscale: int) -> Cameras:
    intrinsics = {key: [getattr(frame.pinhole, key) for frame in frames] for key in ("fx", "fy", "cx", "cy")}
    width, height = np.array([(frame.header.width, frame.header.height) for frame in frames]).T
    cameras = Cameras.of([frame.pose for frame in frames], **intrinsics, width=width, height=height)
    return cameras if downscale == 1 else cameras.downscale(downscale)
