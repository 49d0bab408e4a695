"""A viewed run, and a browser that is none."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
from lean_models import VIEWS, config_of
from tiny import tiny_trainer

from edge_se_sampler.viewer.camera_path import View
from edge_se_sampler.viewer.panel import Panel
from edge_se_sampler.viewer.viewed import Viewed


def view_tiny() -> Viewed:
    """A lean-nerf of three steps, without a folder."""
    trainer = tiny_trainer(config_of(3), VIEWS)
    for step in range(3):
        trainer.train_iteration(step)
    return Viewed(trainer)


def wait_until(condition: Callable[[], Any], seconds: float = 20) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.005)


def keyframe(angle: float, fov: float = 0.7) -> View:
    """On a circle of radius 4 around the z axis, looking at the origin."""
    back = np.array([math.cos(angle), math.sin(angle), 0.0])
    right, up = np.array([-back[1], back[0], 0.0]), np.array([0.0, 0.0, 1.0])
    return View(np.column_stack((right, up, back, 4 * back)), fov, 1.5)


class FakeClient:
    """A browser that remembers the pictures that it is sent."""

    def __init__(self, send: Callable[[np.ndarray], None] = lambda _: None) -> None:
        self.pictures: list[np.ndarray] = []
        self.callbacks: list[Callable[[Any], None]] = []
        self.gui, self.scene = MagicMock(), MagicMock()
        self.gui.add_dropdown.side_effect = lambda _, options: MagicMock(value=options[0])
        self.gui.add_slider.side_effect = lambda *_, **__: MagicMock(value=128)
        self.gui.add_number.side_effect = lambda _, value, **__: MagicMock(value=value)
        self.scene.add_camera_frustum.side_effect = lambda *_, **kwargs: MagicMock(position=kwargs["position"])

        def show(picture: np.ndarray, **_: Any) -> None:
            self.pictures.append(picture)
            send(picture)

        self.scene.set_background_image.side_effect = show
        self.camera = SimpleNamespace(image_height=128, on_update=self.callbacks.append)
        self.move(0.0)

    def move(self, angle: float) -> None:
        view = keyframe(angle)
        vars(self.camera).update(wxyz=view.wxyz, position=view.pose[:, 3], fov=view.fov, aspect=view.aspect)
        for callback in self.callbacks:
            callback(self.camera)

    def panel(self, viewed: Viewed) -> Panel:
        return Panel(self, viewed, scale=4.0)  # type: ignore[arg-type]
