"""One browser: its panel, what it sees of the scene, and the thread that renders for it."""

from __future__ import annotations

import shlex
import threading
import time
from typing import Any

import numpy as np
import viser

from edge_se_sampler.engine.files import write_json
from edge_se_sampler.errors import InputError
from edge_se_sampler.viewer.camera_path import View, camera_path
from edge_se_sampler.viewer.rendering import OUTPUTS, Renderer, choose_heights
from edge_se_sampler.viewer.viewed import Viewed

IDLE_SECONDS, IDLE_SHARE = 0.25, 4.0
"""Between two looks whether the weights have changed: at least so long, and so many times as long as the last picture
took, for they change all the time in training, which should not wait for someone who may have left."""
CLOSING_SECONDS = 10
"""In which a picture that is being rendered is done, or given up."""


class Panel:
    """What one browser shows. Of its camera, only the newest position is known: there is no queue that could grow, and
    viser sends only the newest picture to a browser that is slow."""

    def __init__(self, client: viser.ClientHandle, viewed: Viewed, scale: float) -> None:
        self.client, self.viewed, self.scale = client, viewed, scale
        self.renderer = Renderer(viewed)
        self.selected = 0
        self.keyframes: list[View] = []
        self._changed, self._closed = threading.Event(), False
        self._add_controls()
        self.frusta = [self._add_camera(k) for k in range(len(viewed.cameras))]
        client.camera.on_update(self._refresh)
        self._refresh()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, and wait for it: one that renders while the interpreter ends would abort the process."""
        self._closed = True
        self._changed.set()
        self._thread.join(CLOSING_SECONDS)

    def _refresh(self, _: Any = None) -> None:
        self._changed.set()

    def _add_controls(self) -> None:
        gui = self.client.gui
        self.status = gui.add_markdown("")
        self.output = gui.add_dropdown("Output", OUTPUTS)
        self.height = gui.add_slider("Height", 64, 2160, 8, 1080, hint="Most rows of the picture, once it is sharp")
        for control in (self.output, self.height):
            control.on_update(self._refresh)
        self._add_layer("Cameras", True)
        for name, find in (("Occupied cells", self.viewed.occupied_cells), ("Hull", self.viewed.hull_cells)):
            self._add_layer(name, False, find)
        with gui.add_folder("Training view"):
            self.title = gui.add_markdown("")
            self.kind = gui.add_dropdown("Beside", ("image", "error", "probability"))
            self.kind.on_update(self._refresh)
            self.image = gui.add_image(np.full((1, 1, 3), 255, np.uint8))
        with gui.add_folder("Camera path"):
            self.seconds = gui.add_number("Seconds", 4.0, min=0.1, max=600.0)
            for label, action in (("Add keyframe", self._add_keyframe), ("Clear", self._clear), ("Save", self._save)):
                gui.add_button(label).on_click(action)

    def _add_layer(self, name: str, visible: bool, find: Any = None) -> None:
        """A checkbox that shows part of the scene; of cells, those that `find` finds at that moment."""
        frame = self.client.scene.add_frame(f"/{name}", show_axes=False, visible=visible)
        box = self.client.gui.add_checkbox(name, visible)

        @box.on_update
        def _(_: Any) -> None:
            if find is not None and box.value and (cells := find()) is not None:
                points, size = cells
                low, high = points.min(axis=0), points.max(axis=0)
                colors = (255 * (points - low) / np.maximum(high - low, 1e-9)).astype(np.uint8)
                self.client.scene.add_point_cloud(
                    f"/{name}/cells", points, colors, point_size=0.7 * size, precision="float32"
                )
            frame.visible = box.value

    def _add_camera(self, k: int) -> Any:
        """A training camera's frustum, which can be clicked."""
        thumbnail = self.viewed.image(k, stride=-(-int(self.viewed.cameras.height[k]) // 64))
        view = View.of_training(self.viewed.cameras, k)
        frustum = view.draw(self.client.scene, f"/Cameras/{k}", self.scale, (60, 60, 60), thumbnail)
        frustum.on_click(lambda _: self._select(k))
        return frustum

    def _select(self, k: int) -> None:
        """Look from a training camera, and show its image beside."""
        self.selected = k
        view, camera = View.of_training(self.viewed.cameras, k), self.client.camera
        with self.client.atomic():
            camera.wxyz, camera.position, camera.fov = view.wxyz, view.pose[:, 3], view.fov
        self._refresh()

    def _add_keyframe(self, _: Any) -> None:
        self.keyframes.append(View.of(self.client.camera))
        name = f"/Keyframes/{len(self.keyframes)}"
        self.keyframes[-1].draw(self.client.scene, name, self.scale, (200, 10, 30))

    def _clear(self, _: Any) -> None:
        self.keyframes = []
        self.client.scene.remove_by_name("/Keyframes")

    def _save(self, _: Any) -> None:
        path = self.viewed.trainer.run.path / "camera_path.json"
        if not self.keyframes:
            self.client.add_notification("Nothing to save", "Add keyframes first.")
            return
        height = int(self.viewed.cameras.height.max())
        try:
            write_json(path, camera_path(self.keyframes, self.seconds.value, height))
            command = shlex.join(["edge-se", "render", str(path.parent), "--camera-path", str(path)])
            self.client.add_notification("Saved", command)
        except InputError as problem:
            self.client.add_notification("Not saved", str(problem), color="red")

    def _run(self) -> None:
        shown, pause = None, 0.0
        while not self._closed:
            moved = self._changed.wait(pause)
            if moved:  # or a move that came since the wait ended would be lost
                self._changed.clear()
            version = self.viewed.trainer.next_step
            if not self._closed and (moved or version != shown):
                shown, began = version, time.monotonic()
                self._show(moved)
                pause = max(IDLE_SECONDS, IDLE_SHARE * (time.monotonic() - began))

    def _show(self, moved: bool) -> None:
        """Show what the camera sees: if it has moved, at once, and then sharper and sharper until it moves again."""
        view, output = View.of(self.client.camera), self.output.value
        for frustum in self.frusta:  # not those that the camera is in, which would hide the picture
            frustum.visible = bool(np.linalg.norm(frustum.position - view.pose[:, 3]) > 0.05 * self.scale)
        full = max(1, min(int(self.height.value), self.client.camera.image_height))
        heights = choose_heights(self.renderer.frame.rays, view.aspect, full)
        for height in heights if moved else heights[-1:]:
            first = moved and height == heights[0]  # never interrupted: who keeps moving must see something, too
            began, camera = time.monotonic(), view.camera(height)
            picture = self.renderer.picture(camera, output, (lambda: False) if first else self._changed.is_set)
            if picture is None:
                return
            self.client.scene.set_background_image(picture, format="jpeg", jpeg_quality=75 if first else 95)
            size, seconds = f"{picture.shape[1]} x {height}", time.monotonic() - began
            self.status.content = f"step {self.viewed.trainer.next_step}, {size} in {seconds:.2f} s"
            if first or not moved:
                self._show_beside()

    def _show_beside(self) -> None:
        k, kind = self.selected, self.kind.value
        picture = self.renderer.beside(k, kind, self._changed.is_set)
        if picture is not None:
            strategy = f" under {self.viewed.strategy}" if kind == "probability" else ""
            self.image.image, self.title.content = picture, f"View {k}: {kind}{strategy}"
