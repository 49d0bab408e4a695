"""The map's object, as large in the image and where a point wants it, in front of its background.

f   share of the pixels with any alpha, a mean over the training views; it grows with the square of the focal length
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.bench.stability.settings import Background
from edge_se_sampler.data.cameras import Cameras, RayBundle
from edge_se_sampler.data.synthetic.cameras import poses
from edge_se_sampler.data.synthetic.render import render_view
from edge_se_sampler.data.views import Views

SCENE = "materials"
"""Compact: it fits into the image at f = 30 %, and at 10 % off centre."""
SIZE = 48
SHIFT = (10, 7)
"""Pixels, right and down: as far from the middle as the demo's."""
TEST_VIEWS = 4
COLORS: dict[str, tuple[float, float, float]] = {
    "white": (1.0, 1.0, 1.0),
    "black": (0.0, 0.0, 0.0),
    "grey": (0.5, 0.5, 0.5),
    "green": (0.1, 0.75, 0.2),
}


@lru_cache(maxsize=4)
def views(foreground: float, shifted: bool, count: int) -> tuple[Views, Views]:
    """Training views and held-out ones of the object covering that share of an image."""
    first = _focal(foreground, SIZE, count)
    return _rendered("train", first, shifted, count), _rendered("test", first, shifted, TEST_VIEWS)


@lru_cache(maxsize=16)
def _focal(foreground: float, start: float, count: int, steps: int = 3) -> float:
    """The focal length, pixels, at which f is what is asked for: the square root's rule, applied until it is true."""
    focal = start
    for _ in range(steps):
        found = np.mean(
            [(image[..., 3] > 0).mean() for image in _rendered("train", focal, False, min(count, 8)).images]
        )
        focal *= math.sqrt(foreground / float(found))
    return focal


def _rendered(split: str, focal: float, shifted: bool, count: int) -> Views:
    dx, dy = SHIFT if shifted else (0, 0)
    principal = (SIZE / 2 + dx, SIZE / 2 + dy)
    matrices = poses("test" if split == "test" else "train", count)
    images = tuple(render_view(SCENE, pose, focal, principal, SIZE, SIZE) for pose in matrices)
    return Views(
        tuple(f"{split}/r_{i}" for i in range(count)),
        images,
        None,
        Cameras.of(matrices, fx=focal, fy=focal, cx=principal[0], cy=principal[1], width=SIZE, height=SIZE),
    )


def background_of(background: Background) -> Callable[[RayBundle], Tensor] | None:
    """What a model sees behind a ray, (n, 3); None: a random colour for each, which its config has."""
    if background == "random":
        return None
    if background == "textured":
        return _texture
    color = torch.tensor(COLORS[background])
    return lambda rays: color.to(rays.origins).expand(len(rays), 3)


def _texture(rays: RayBundle) -> Tensor:
    """Coloured stripes at infinity, each some four pixels wide: no plain colour to fall back on."""
    tilt = rays.directions.new_tensor([[31.0, 17.0, 9.0], [-13.0, 29.0, 21.0], [19.0, -11.0, 33.0]])
    return 0.5 + 0.4 * torch.sin(rays.directions @ tilt.T)
