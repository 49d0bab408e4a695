"""Cameras of the synthetic scenes: where they stand, and where in the image they show the object.

S  side of the square image (the canvas), pixels
d  offset of the object from the image's middle, whole pixels, right and down positive
s  = S - 2 max|d|: side of the frame the object would fill, were it centered; what it loses to make room for d
f  focal length, pixels: s / (2 tan(FIELD_OF_VIEW / 2))
(cx, cy)  principal point, pixels; pixel (i, j) has its center at (i + 1/2, j + 1/2)

A pose is a 4x4 camera-to-world matrix in NeRF's convention: x right, y up, the camera looks along -z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from edge_se_sampler.data.synthetic.linear import Array, around, compose, cross, unit, vector
from edge_se_sampler.errors import InputError

FIELD_OF_VIEW = 0.6911112070083618  # radians, as in NeRF's Blender scenes
DISTANCE = 4.031128874149275  # of the cameras from the origin, world units; likewise
MIN_FRAME = 8  # pixels; in less an object is a blot
MAX_FRAME = 8192

Placement = Literal["centered", "padded", "shifted", "rotated"]
Split = Literal["train", "val", "test"]


@dataclass(frozen=True)
class Camera:
    """One view: pose (4, 4), focal length and principal point (x, y) in pixels, image size in pixels."""

    to_world: Array
    focal: float
    principal: tuple[float, float]
    width: int
    height: int

    def sample_slopes(self, per_axis: int) -> tuple[Array, Array]:
        """x / -z of the sample columns (width * per_axis,) and y / -z of the sample rows (height * per_axis,)."""
        columns = np.arange(0.5, self.width * per_axis)
        rows = np.arange(0.5, self.height * per_axis)
        # Halves and whole numbers subtract exactly: shifting the principal point by whole pixels shifts the image.
        x = (columns - self.principal[0] * per_axis) / (self.focal * per_axis)
        y = (self.principal[1] * per_axis - rows) / (self.focal * per_axis)
        return x, y


@dataclass(frozen=True)
class Framing:
    """How every view of a scene shows the object: the part of a camera that does not depend on where it stands."""

    size: int
    placement: Placement
    shift: tuple[int, int]  # d, pixels
    focal: float

    @property
    def principal(self) -> tuple[float, float]:
        """(cx, cy)."""
        x, y = self.shift if self.placement == "shifted" else (0, 0)
        return self.size / 2 + x, self.size / 2 + y

    @property
    def intrinsics(self) -> dict[str, float]:
        """What the json says of the camera; a Blender loader assumes a principal point in the middle."""
        angle = FIELD_OF_VIEW if self.placement == "centered" else 2 * math.atan(self.size / (2 * self.focal))
        center = {"cx": self.principal[0], "cy": self.principal[1]} if self.placement == "shifted" else {}
        return {"camera_angle_x": angle} | center

    def camera(self, pose: Array) -> Camera:
        """The view from `pose` (4, 4), which looks at the origin; "rotated" rotates it in place."""
        if self.placement == "rotated":
            pose = _rotated_toward(pose, vector([self.shift[0] / self.focal, -self.shift[1] / self.focal, -1]))
        return Camera(pose, self.focal, self.principal, self.size, self.size)


def framing(size: int, placement: Placement = "centered", offset: tuple[float, float] = (0.0, 0.0)) -> Framing:
    """Places the object `offset` (right, down; fractions of the image's side) from the middle of size x size pixels.

    "centered" ignores the offset. "shifted" shows the centered picture of a smaller frame, pasted whole pixels away,
    by moving the principal point; "padded" pastes it in the middle, so that only the position differs. "rotated"
    rotates the cameras until the world's origin is at the shifted pixel: every loader reads that, but perspective
    stretches the object.

    InputError for an unknown placement, a size above 8192, or if the size or the offset leaves the object fewer than 8
    pixels.
    """
    if not MIN_FRAME <= size <= MAX_FRAME:
        raise InputError(f"size is {size} pixels: give at least {MIN_FRAME} and at most {MAX_FRAME}")
    if placement not in get_args(Placement):
        raise InputError(f"placement is {placement!r}: give one of {', '.join(get_args(Placement))}")
    if placement == "centered":
        offset = (0.0, 0.0)
    if not all(abs(fraction) <= 1 for fraction in offset):
        raise InputError(f"offset is {tuple(offset)}: give two numbers from -1 to 1, fractions of its side")
    shift = (round(offset[0] * size), round(offset[1] * size))
    frame = size - 2 * max(abs(shift[0]), abs(shift[1]))
    if frame < MIN_FRAME:
        problem = f"offset {tuple(offset)} at size {size} leaves the object {max(frame, 0)} pixels"
        raise InputError(f"{problem}: it needs {MIN_FRAME}, so give an offset nearer to zero or a larger size")
    return Framing(size, placement, shift, 0.5 * frame / math.tan(FIELD_OF_VIEW / 2))


def poses(split: Split, count: int, seed: int = 0) -> list[Array]:
    """Camera poses (4, 4) of one split; view i does not depend on `count`.

    train and val: uniform in area over the upper hemisphere, drawn from `seed` (0 to 2**31 - 1). test: fixed, a
    wavy ring at 15 to 45 degrees of elevation, walked in steps of the golden ratio so that any number is spread.
    """
    if split == "test":
        golden_ratio = (1 + math.sqrt(5)) / 2
        revolutions = [index / golden_ratio % 1 for index in range(count)]
        angles = [(r, math.radians(30 + 15 * math.sin(4 * math.pi * r))) for r in revolutions]
    else:
        offset = 2**31 if split == "val" else 0  # more than any seed, so no seed's val is another's train
        drawn = np.random.RandomState(seed + offset).rand(count, 2).tolist()
        # Short of the horizon, and of the pole, where "up" has no direction in the image.
        angles = [(revolution, math.asin(0.02 + 0.96 * height)) for revolution, height in drawn]
    return [_look_at_origin(2 * math.pi * revolution, elevation) for revolution, elevation in angles]


def _look_at_origin(azimuth: float, elevation: float) -> Array:
    back = around(math.cos(elevation), azimuth, math.sin(elevation))
    right = unit(cross(vector([0, 0, 1]), back))
    return _pose(np.stack([right, cross(back, right), back], axis=1), DISTANCE * back)


def _rotated_toward(pose: Array, toward: Array) -> Array:
    """`pose` rotated in place, by the smallest angle, until it sees along `toward` what it saw along -z."""
    x, y, z = unit(toward)
    k = 1 / (1 - z)
    # the smallest rotation that takes `toward` to -z
    to_axis = vector([[1 - k * x * x, -k * x * y, x], [-k * x * y, 1 - k * y * y, y], [-x, -y, -z]])
    return _pose(compose(pose[:3, :3], to_axis), pose[:3, 3])


def _pose(rotation: Array, eye: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = eye
    return np.round(pose, 12)  # the same number on every platform, and in the json
