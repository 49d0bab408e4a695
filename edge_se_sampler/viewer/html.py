"""A run as one html file that needs no server: its surface as points, its cameras, and a turntable."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import viser.transforms as tf

from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.files import check_output, to_uint8, write_atomically
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.export.points import find_positions
from edge_se_sampler.sampling.random_streams import Stream, stream
from edge_se_sampler.viewer.address import ViewerConfig, check_viser
from edge_se_sampler.viewer.camera_path import View
from edge_se_sampler.viewer.server import set_initial_camera, start_server
from edge_se_sampler.viewer.viewed import Viewed

NUM_POINTS = 100_000
TURN_SECONDS, TURN_STEPS = 12.0, 180
"""Of the turntable."""
DISTANCE = 1.5
"""From where it begins, as a multiple of the first training camera's: or others would pass close before the eyes."""


def write_html(run: RunFolder, config: TrainerConfig, path: Path) -> None:
    """Write a run as one html file; InputError for a bad run, data or output, or where nothing is opaque."""
    check_viser()
    check_output(path, ".html", flag="--html")
    viewed = Viewed.load(run, config)
    rng = stream(config.machine.seed, 0, Stream.PROBE)
    values = find_positions(viewed.model, viewed.cameras, viewed.masks, NUM_POINTS, rng)
    points, colors = values[:, :3], to_uint8(values[:, 6:9])
    with start_server(ViewerConfig(port=0)) as server:
        (focus, scale), start = set_initial_camera(server, viewed), server.initial_camera
        start.position = focus + DISTANCE * (np.asarray(start.position) - focus)
        table = server.scene.add_frame("/turntable", show_axes=False, position=focus)
        look: dict[str, Any] = {"point_shape": "circle", "point_shading": "flat", "precision": "float32"}
        size = scale / float(viewed.cameras.fy.max())  # of a pixel
        server.scene.add_point_cloud("/turntable/points", points - focus, colors, point_size=size, **look)
        for k in range(len(viewed.cameras)):
            view = View.of_training(viewed.cameras, k)
            view.pose[:, 3] -= focus
            view.draw(server.scene, f"/turntable/{k}", scale, (60, 60, 60))
        recording = server.get_scene_serializer()
        for step in range(TURN_STEPS):
            table.wxyz = tf.SO3.exp(viewed.up * 2 * math.pi * step / TURN_STEPS).wxyz
            recording.insert_sleep(TURN_SECONDS / TURN_STEPS)
        write_atomically(path, recording.as_html().encode())
