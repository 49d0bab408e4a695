"""Pictures for a browser: as large as there is time for, given up when they are not wanted any more."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.engine.files import to_uint8
from edge_se_sampler.engine.frames import SEEN
from edge_se_sampler.engine.rendering import meet_all_cells, render_outputs
from edge_se_sampler.models.rendering import remove_background
from edge_se_sampler.sampling.edges import unit_float
from edge_se_sampler.viewer.viewed import Viewed

FRAME_SECONDS, TURN_SECONDS = 0.15, 0.04
"""What a picture may take while the camera moves (7 a second), and a turn, which whoever trains the model waits for."""
OUTPUTS = "rgb", "depth", "accumulation"


class Pace:
    """How many rays are rendered in some time, as was measured."""

    def __init__(self, seconds: float) -> None:
        self.seconds, self._rate = seconds, 2e4

    def record(self, rays: int, seconds: float) -> None:
        """Rays were rendered in so many seconds: counts as much as all before."""
        self._rate = (self._rate + rays / max(seconds, 1e-6)) / 2

    @property
    def rays(self) -> int:
        return max(256, int(self._rate * self.seconds))


def choose_heights(rays: int, aspect: float, full: int) -> list[int]:
    """Heights of the pictures of a camera: at first one of about so many rays, then each twice as high, up to the full
    height."""
    heights = [min(full, max(16, int(math.sqrt(rays / aspect))))]
    while heights[-1] < full:
        heights.append(min(full, 2 * heights[-1]))
    if len(heights) > 2 and heights[-1] < 1.4 * heights[-2]:  # hardly sharper
        del heights[-2]
    return heights


class Renderer:
    """Renders for one browser."""

    def __init__(self, viewed: Viewed) -> None:
        self.viewed, self.frame, self.turn = viewed, Pace(FRAME_SECONDS), Pace(TURN_SECONDS)

    def render(
        self, camera: Cameras, keys: Sequence[str], interrupted: Callable[[], bool], *, everything: bool
    ) -> dict[str, Tensor] | None:
        """Some of the model's outputs (H, W, channels) for a camera, on the CPU; None: interrupted. A turn ends after
        some rays: training goes on, others look, and whether the picture is still wanted is asked again. `everything`:
        see `meet_all_cells`."""
        height, width = int(camera.height[0]), int(camera.width[0])
        count, first, turns, began = height * width, 0, [], time.monotonic()
        while first < count:
            if interrupted():
                return None
            last = min(first + self.turn.rays, count)
            with self.viewed.turns:
                turn_began, model = time.monotonic(), self.viewed.model
                rays = camera.to(model.device, torch.float32).image_rays(0, slice(first, last))
                if everything:
                    meet_all_cells(model, rays)
                turns.append(render_outputs(model, rays, keys))
                self.turn.record(last - first, time.monotonic() - turn_began)
            first = last
        self.frame.record(count, time.monotonic() - began)
        return {key: torch.cat([turn[key] for turn in turns]).reshape(height, width, -1) for key in keys}

    def picture(self, camera: Cameras, output: str, interrupted: Callable[[], bool]) -> np.ndarray | None:
        """One of OUTPUTS as (H, W, 3) uint8; None: interrupted."""
        keys = ["rgb_fine"] if output == "rgb" else ["accumulation_fine", "depth_fine"]
        found = self.render(camera, keys, interrupted, everything=True)
        if found is None:
            return None
        if output == "rgb":
            return to_uint8(found["rgb_fine"].numpy())
        opacity = found["accumulation_fine"]
        if output == "accumulation":
            return colored(opacity[..., 0].numpy())
        norm = camera.to("cpu", torch.float32).image_rays(0).metadata["directions_norm"].reshape(opacity.shape)
        depth = remove_background(found["depth_fine"], opacity, self.viewed.model.config.depths[1] * norm)
        depth, seen = depth[..., 0].numpy(), opacity[..., 0].numpy() > SEEN
        low, high = (depth[seen].min(), depth[seen].max()) if seen.any() else (0.0, 1.0)
        return colored(np.where(seen, (high - depth) / max(high - low, 1e-9), 0.0))

    def squared_error(self, k: int, interrupted: Callable[[], bool]) -> np.ndarray | None:
        """(H, W) squared error of every pixel of the kth training view, a mean over channels; None: interrupted."""
        found = self.render(self.viewed.cameras[[k]], ["rgb_fine"], interrupted, everything=False)
        if found is None:
            return None
        return np.square(found["rgb_fine"].numpy() - unit_float(self.viewed.image(k))).mean(axis=2)

    def beside(self, k: int, kind: str, interrupted: Callable[[], bool]) -> np.ndarray | None:
        """The kth training view as (H, W, 3) uint8: its "image", root mean squared "error" (brightest: 0.25 and more),
        or "probability" under the current strategy (brightest: four times as likely as uniform). None: there is none,
        or interrupted."""
        if kind == "image":
            return self.viewed.image(k)
        if kind == "error":
            error = self.squared_error(k, interrupted)
            return None if error is None else colored(np.sqrt(error) / 0.25)
        relative = self.viewed.probability(k, lambda: self.squared_error(k, interrupted))
        return None if relative is None else colored(relative / 4)


def colored(values: np.ndarray) -> np.ndarray:
    """(H, W) in [0, 1] -> (H, W, 3) uint8, from black over red to yellow."""
    return cv2.cvtColor(cv2.applyColorMap(to_uint8(values), cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
