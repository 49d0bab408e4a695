"""The sweep's images: an object, as large and where a setting wants it, in front of the setting's background."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.bench.stability.settings import Background
from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.data.cameras import Cameras, RayBundle
from edge_se_sampler.data.downscale import average_pixels
from edge_se_sampler.data.synthetic.cameras import Camera, Split, poses
from edge_se_sampler.data.synthetic.catalogue import synthetic_scene
from edge_se_sampler.data.synthetic.render import render
from edge_se_sampler.data.views import Views

SCENE = "materials"
"""Compact: it fits into the image when it covers 30 % of it, and off centre when it covers 10 %."""
SIZE = 48
NUM_TRAIN, NUM_TEST = 40, 4
SHIFT = (10, 7)
"""Pixels, right and down, off centre: about as far from the middle, as a share of the image, as in the demo."""
COLORS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "grey": (0.5, 0.5, 0.5), "green": (0.1, 0.75, 0.2)}


@lru_cache(maxsize=4)
def render_splits(foreground: float, shifted: bool, num_train: int) -> tuple[Views, Views]:
    """Training and held-out views; foreground: share of the training views' pixels that show the object (any alpha)."""
    focal = _find_focal(foreground, num_train)
    return _render("train", focal, shifted, num_train), _render("test", focal, shifted, NUM_TEST)


@lru_cache(maxsize=16)
def read_real_splits(folder: Path, foreground: float | None, shifted: bool, num_train: int) -> tuple[Views, Views]:
    """Training and held-out views of a real scene, evenly spread, each in the middle of a transparent canvas: made
    smaller by the whole factor with which the object covers about that share of it (None: the whole image just fits).
    InputError as `read_blender`."""
    train, test = _spread(read_blender(folder, "train"), num_train), _spread(read_blender(folder, "test"), NUM_TEST)
    factor = math.ceil(train.longest_side / SIZE)
    if foreground is not None:
        for _ in range(3):
            images = [average_pixels(image, factor) for image in train.images[:8]]
            covered = float(np.mean([(image[..., 3] > 0).sum() for image in images])) / SIZE**2
            factor = round(factor * math.sqrt(covered / foreground))
    return _paste(train, factor, shifted), _paste(test, factor, shifted)


def _spread(views: Views, count: int) -> Views:
    return views.subset(np.linspace(0, len(views.names) - 1, count).astype(int).tolist())


def _paste(views: Views, factor: int, shifted: bool) -> Views:
    """The views, all of one size, made smaller by a factor, on canvases of SIZE x SIZE."""
    images, cameras = [average_pixels(image, factor) for image in views.images], views.cameras.downscale(factor)
    height, width = images[0].shape[:2]
    x, y = ((SIZE - side) // 2 + shifted * shift for side, shift in zip((width, height), SHIFT, strict=True))
    border = ((y, SIZE - height - y), (x, SIZE - width - x), (0, 0))
    size = torch.full_like(cameras.width, SIZE)
    cameras = replace(cameras, cx=cameras.cx + x, cy=cameras.cy + y, width=size, height=size)
    return replace(views, images=tuple(np.pad(image, border) for image in images), cameras=cameras)


def _find_focal(foreground: float, num_train: int) -> float:
    """Focal length in pixels at which the object covers that share; the share grows with its square, nearly."""
    focal = float(SIZE)
    for _ in range(3):
        images = _render("train", focal, False, min(num_train, 8)).images
        covered = np.mean([(image[..., 3] > 0).mean() for image in images])
        focal *= math.sqrt(foreground / float(covered))
    return focal


def _render(split: Split, focal: float, shifted: bool, count: int) -> Views:
    cx, cy = (SIZE / 2 + (shift if shifted else 0) for shift in SHIFT)
    matrices, scene = poses(split, count), synthetic_scene(SCENE)
    images = tuple(render(scene, Camera(pose, focal, (cx, cy), SIZE, SIZE)) for pose in matrices)
    cameras = Cameras.of(matrices, fx=focal, fy=focal, cx=cx, cy=cy, width=SIZE, height=SIZE)
    return Views(tuple(f"{split}/r_{i}" for i in range(count)), images, None, cameras)


def background_of(background: Background) -> Callable[[RayBundle], Tensor] | None:
    """Rays -> (n, 3) colors behind them; None: random ones, which the model's config has."""
    if background == "random":
        return None
    if background == "textured":
        return _stripes
    return lambda rays: rays.origins.new_tensor(COLORS[background]).expand(len(rays), 3)


def _stripes(rays: RayBundle) -> Tensor:
    """Colored stripes at infinity, each some four pixels wide: no plain color explains them."""
    wave_vectors = rays.directions.new_tensor([[31.0, 17.0, 9.0], [-13.0, 29.0, 21.0], [19.0, -11.0, 33.0]])
    return 0.5 + 0.4 * torch.sin(rays.directions @ wave_vectors.T)
