"""A lean-nerf that is a ball whose surface and colors are known, and what exports of it are read back with."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from blender_folder import write_json
from tiny import ball_views

from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.engine.checkpoint import save_checkpoint
from edge_se_sampler.engine.config import MODEL, override
from edge_se_sampler.engine.run_folder import RunFolder, config_digest
from edge_se_sampler.engine.session import resolve_config
from edge_se_sampler.export.density import find_density
from edge_se_sampler.export.surface import find_surface
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models.config import LeanModelConfig
from edge_se_sampler.models.lean import LeanModel
from edge_se_sampler.occupancy.bricks import BrickGrid

RADIUS, CELL = 0.7, 0.05
OPACITY = 0.1
"""Across a cell at RADIUS."""


def ball_model(scale: float = 1.0, hollow: bool = False, speck: bool = False) -> LeanModel:
    """A ball around the origin, whose cells have an opacity of OPACITY at RADIUS, and the colors of `color_at`.

    Args:
        scale: of the scene.
        hollow: without cells inside, as training prunes what no ray sees.
        speck: with a small ball of its own in a corner of the box.
    """
    cells = torch.ones((40, 40, 40), dtype=torch.bool)
    centers = (torch.stack(torch.meshgrid(*[torch.arange(40)] * 3, indexing="ij"), dim=3) - 19.5) * CELL
    distance = centers.norm(dim=3)
    cells &= distance < RADIUS + 3 * CELL
    if hollow:
        cells &= distance > RADIUS - 4 * CELL
    if speck:
        cells[:5, :5, :5] = True
    grid = BrickGrid.from_cells(torch.full((3,), -20 * CELL * scale), CELL * scale, cells)
    config = LeanModelConfig(size="tiny", near=0.5 * scale, far=6.0 * scale, max_memory=1.0)
    model = LeanModel(config, np.random.default_rng(0), grid)
    within = torch.cartesian_prod(*[torch.arange(4)] * 3)
    positions = ((4 * grid.bricks[:, None] + within).reshape(-1, 3) - 20) * CELL
    depth = RADIUS - positions.norm(dim=1)
    if speck:
        depth = torch.maximum(depth, 1.2 * CELL - (positions + 18 * CELL).norm(dim=1))
    with torch.no_grad():
        for weight in model.fine.parameters():
            weight.zero_()
        model.density[:, 0] = 2 * depth / CELL + np.log(-np.log(1 - OPACITY))
        # three features pass through the network as they are
        model.features[:, :3] = torch.logit(torch.from_numpy(color_at(positions.double().numpy()))).float() + 3
        model.fine.hidden[:3, :3] = model.fine.color[:, :3] = torch.eye(3)
        model.fine.color_bias.fill_(-3)
        model.supersampled.fill_(True)  # as training leaves it
    return model.eval()


def ball_run(folder: Path, scale: float = 1.0, size: int = 48, empty: bool = False) -> Path:
    """The folder of a run whose model is `ball_model`, or has nothing in it, of images of that many pixels a side in
    folder/scene."""
    model = ball_model(scale)
    if empty:
        model.density.data.fill_(-20)
    views, data = ball_views(6, size, RADIUS), folder / "scene"
    data.mkdir()
    frames = []
    for i, image in enumerate(views.images):
        iio.imwrite(data / f"{i}.png", image)
        pose = np.vstack((views.cameras.camera_to_worlds[i].numpy(), (0, 0, 0, 1)))
        pose[:3, 3] *= scale
        frames.append({"file_path": f"{i}.png", "transform_matrix": pose.tolist()})
    write_json(data, {"fl_x": 1.4 * size, "frames": frames})
    changes = {"data": data, "output_dir": folder, f"{MODEL}.near": 0.5 * scale, f"{MODEL}.far": 6.0 * scale}
    config = override(method_configs()["lean-nerf"], changes | {"machine.device_type": "cpu"})
    config = resolve_config(config, read_blender(data, "train"))
    run = RunFolder.create(config)
    state = {"config_digest": config_digest(config), "model": model.state_dict(), "step": 0, "elapsed": 0.0}
    state |= {"plan": {}, "scheduler": {}, "sampler": {}, "optimizer": None, "dead_network_reset": None}
    save_checkpoint(run.checkpoints, 0, state)
    return run.path


def surface_of(model: LeanModel, opacity: float = OPACITY) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles at which a cell has that opacity."""
    return find_surface(*find_density(model, opacity, find_box=lambda: model.grid))


def color_at(positions: np.ndarray) -> np.ndarray:
    """(n, 3) colors in (0, 1) of positions (n, 3), in the ball's units."""
    return 0.5 + 0.4 * np.tanh(positions)


def read_ply(path: Path) -> dict[str, np.ndarray]:
    """The vertices' properties, by a reader that knows nothing of the writer but the format's text."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = next(int(line.split()[-1]) for line in lines if line.startswith("element vertex"))
    kinds = {"float": "<f4", "uchar": "u1"}
    properties = [line.split()[1:] for line in lines if line.startswith("property") and "list" not in line]
    table = np.frombuffer(body, np.dtype([(name, kinds[kind]) for kind, name in properties]), count)
    return {name: table[name] for _, name in properties}
