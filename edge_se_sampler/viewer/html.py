"""A run as one html file that needs no server: its surface as points, its cameras, and a turntable."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
import viser.transforms as tf

from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.files import check_output, write_atomically
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.rendering import render_outputs
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.sampling.random_streams import Stream, stream
from edge_se_sampler.viewer.address import ViewerConfig, check_viser
from edge_se_sampler.viewer.camera_path import View
from edge_se_sampler.viewer.server import set_initial_camera, start_server
from edge_se_sampler.viewer.viewed import Viewed

NUM_POINTS, RAYS_PER_LOOK, MAX_LOOKS = 100_000, 2**14, 64
"""Points, and how many rays are rendered at once, and how often at most, until there are so many."""
TURN_SECONDS, TURN_STEPS = 12.0, 180
"""Of the turntable."""


def write_html(run: RunFolder, config: TrainerConfig, path: Path) -> None:
    """Write a run as one html file; InputError for a bad run, data or output."""
    check_viser()
    check_output(path, "--html")
    viewed = Viewed.load(run, config)
    points, colors = surface_points(viewed)
    with start_server(ViewerConfig(port=0)) as server:
        focus, scale = set_initial_camera(server, viewed)
        table = server.scene.add_frame("/turntable", show_axes=False, position=focus)
        size = 2 * scale / float(viewed.cameras.fy.max())
        server.scene.add_point_cloud(
            "/turntable/points", points - focus, colors, point_size=size, point_shape="circle", precision="float32"
        )
        for k in range(len(viewed.cameras)):
            view = View.of_training(viewed.cameras, k)
            lens = {"fov": view.fov, "aspect": view.aspect, "scale": 0.06 * scale}
            position = view.pose[:, 3] - focus
            server.scene.add_camera_frustum(f"/turntable/{k}", **lens, wxyz=view.wxyz, position=position)
        up = viewed.cameras.camera_to_worlds[:, :, 1].mean(dim=0).double().cpu().numpy()
        recording = server.get_scene_serializer()
        for step in range(TURN_STEPS):
            turned = tf.SO3.exp(up / np.linalg.norm(up) * 2 * math.pi * step / TURN_STEPS)
            table.wxyz = turned.wxyz
            recording.insert_sleep(TURN_SECONDS / TURN_STEPS)
        write_atomically(path, recording.as_html().encode())


def surface_points(viewed: Viewed) -> tuple[np.ndarray, np.ndarray]:
    """Points (m, 3), world units, and their colors (m, 3) uint8: where random rays of the training views see something
    with an accumulation above a half."""
    trainer, model, points, colors = viewed.trainer, viewed.model, [], []
    rng, far = stream(trainer.config.machine.seed, 0, Stream.PROBE), model.config.depths[1]
    with Progress(NUM_POINTS, "looking for points") as progress:
        for _ in range(MAX_LOOKS):
            rays = trainer.pipeline.datamanager.probe_rays(RAYS_PER_LOOK, rng)
            found = render_outputs(model, rays, ["rgb_fine", "accumulation_fine", "depth_fine"])
            opaque = found["accumulation_fine"].clamp(min=0.5)  # what is behind is at the far depth, on the background
            behind = 1 - found["accumulation_fine"]
            distance = (found["depth_fine"] - behind * far * rays.metadata["directions_norm"].cpu()) / opaque
            color = (found["rgb_fine"] - behind * model.config.background_level) / opaque
            seen = found["accumulation_fine"][:, 0] > 0.5
            points.append((rays.origins.cpu() + distance * rays.directions.cpu())[seen])
            colors.append((color[seen].clamp(0, 1) * 255).byte())
            progress.update(min(NUM_POINTS, sum(map(len, points))))
            if sum(map(len, points)) >= NUM_POINTS:
                break
    return torch.cat(points)[:NUM_POINTS].double().numpy(), torch.cat(colors)[:NUM_POINTS].numpy()
