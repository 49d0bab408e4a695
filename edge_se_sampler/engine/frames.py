"""What `edge-se render` shows of a model at a camera, and folders of such frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from edge_se_sampler.data.cameras import Cameras, RayBundle
from edge_se_sampler.data.scene_file import read_json
from edge_se_sampler.engine.files import make_folder, to_uint8, write_image, write_json
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.rendering import CameraRays, find_surfaces, render_outputs
from edge_se_sampler.errors import InputError, check_value, os_errors_as_input_errors
from edge_se_sampler.models.ray_model import RayModel
from edge_se_sampler.occupancy.bricks import OFFSETS

FRAMES_ONLY = {"rgba": "is transparent", "raw-depth": "has 16 bits"}
"""Outputs that no video shows, and why."""
SEEN = 0.5
"""Accumulation above which there is something whose depth is known."""
MAX_16_BITS = 2**16 - 1


def render_frame(
    model: RayModel,
    cameras: Cameras,
    index: int,
    outputs: Sequence[str],
    depth_unit: float,
    depths: tuple[float, float] | None = None,
) -> dict[str, np.ndarray]:
    """Images of one camera, by output; of what is between near and far, or, with `depths`, which are nearest and
    farthest then, of all cells, see `meet_all_cells`.

    rgb           (H, W, 3) uint8
    rgba          (H, W, 4) uint8: straight alpha, the accumulation
    accumulation  (H, W) uint8: 255 where no light of the background passes
    depth         (H, W, 3) uint8: near is red, far is blue, nothing is the background
    raw-depth     (H, W) uint16: depth along the optical axis in depth_unit world units; 0 where nothing is
    """
    rays = CameraRays.of(model, cameras[[index]], everything=depths is not None)
    size = int(rays.camera.height), int(rays.camera.width)
    parts = []
    for some in model.chunks(math.prod(size)):  # all rays of a large frame would take many gigabytes
        rendered = _render_pixels(model, rays[some], depth_unit, depths or model.config.depths)
        parts.append([rendered[name] for name in outputs])
    images = map(np.concatenate, zip(*parts, strict=True))
    return {name: image.reshape(*size, *image.shape[1:]) for name, image in zip(outputs, images, strict=True)}


def _render_pixels(
    model: RayModel, rays: RayBundle, depth_unit: float, depths: tuple[float, float]
) -> dict[str, np.ndarray]:
    """The outputs of `render_frame` of n rays, (n, ...)."""
    near, far = depths
    keys = ("rgb_fine", "accumulation_fine", "depth_fine", "background")
    outputs = render_outputs(model, rays, keys)
    norm = rays.metadata["directions_norm"].cpu()
    colors, distance = (x.numpy() for x in find_surfaces(outputs, model.config.depths[1] * norm))
    rgb, alpha, background = (outputs[key].numpy() for key in (keys[0], keys[1], keys[3]))
    alpha = alpha.clip(0, 1)
    depth = (distance / norm.numpy()).astype(np.float64).clip(near, far)
    turbo = cv2.applyColorMap(to_uint8((far - depth) / (far - near)), cv2.COLORMAP_TURBO)[:, 0, ::-1] / 255
    steps = np.where(alpha > SEEN, np.rint(depth / depth_unit).clip(1, MAX_16_BITS), 0)
    return {
        "rgb": to_uint8(rgb),
        "rgba": to_uint8(np.concatenate((colors, alpha), axis=1)),
        "accumulation": to_uint8(alpha[:, 0]),
        "depth": to_uint8(alpha * turbo + (1 - alpha) * background),
        "raw-depth": steps[:, 0].astype(np.uint16),
    }


def find_depth_range(model: RayModel, cameras: Cameras) -> tuple[float, float]:
    """The model's near and far, moved to where cameras see all of its cells, if rays meet them all."""
    near, far = model.config.depths
    if not model.meets_all_cells or model.grid is None:
        return near, far
    poses = cameras.camera_to_worlds.cpu().double()
    box = (model.grid.size * model.grid.cell_size).cpu()
    corners = model.grid.aabb_min + OFFSETS * box
    depth = -((corners - poses[:, None, :, 3]) * poses[:, None, :, 2]).sum(dim=2)
    return min(near, max(float(depth.min()), 0.0)), max(far, float(depth.max()))


def choose_depth_unit(far: float, unit: float | None) -> float:
    """World units that 1 means in raw-depth: the power of ten that just lets 16 bits reach to the depth `far`, or the
    one of --depth-unit; InputError if that does not let them."""
    if unit is None:
        return 10.0 ** math.ceil(math.log10(far / MAX_16_BITS))
    check_value("depth-unit", unit, far / MAX_16_BITS <= unit < far, f"at least {far / MAX_16_BITS:.3g}, below {far:g}")
    return unit


def write_frames(
    folder: Path,
    model: RayModel,
    cameras: Cameras,
    outputs: Sequence[str],
    depth_unit: float,
    checkpoints: Sequence[str],
    depths: tuple[float, float] | None = None,
) -> None:
    """Write FOLDER/OUTPUT/00000.png, ... of all cameras, and frames.json, which says what they are, and of which
    checkpoints, by `name_checkpoint`; depths: as `render_frame`. What is there and whole is kept. InputError if the
    folder has other things, or frames of other checkpoints, cameras or units."""
    facts = {
        "checkpoint": "; ".join(checkpoints),
        "depth_unit": depth_unit,
        "depth": "raw-depth: value * depth_unit is the depth along the optical axis in the data's units, 0 is nothing",
        "frames": [_describe(cameras, i) for i in range(len(cameras))],
    }
    _claim(folder, facts)
    for name in outputs:
        make_folder(folder / name, "--output-path")
    frames = [{name: folder / name / f"{i:05d}.png" for name in outputs} for i in range(len(cameras))]
    missing = [[name for name, path in frame.items() if not _is_whole(path)] for frame in frames]
    done = missing.count([])
    with Progress(len(frames), "rendering", start=done) as progress:
        for i in (i for i, names in enumerate(missing) if names):
            for name, image in render_frame(model, cameras, i, missing[i], depth_unit, depths).items():
                write_image(frames[i][name], image)
            done += 1
            progress.update(done)


def name_checkpoint(path: Path) -> str:
    """Its step, and the checksum that tells it from another run's; InputError if it is gone."""
    with os_errors_as_input_errors(f"{path}: cannot be read"), open(path, "rb") as file:
        return f"{path.stem}, sha256 {file.readline().split()[-1].decode()}"  # every checkpoint begins with its own


def _describe(cameras: Cameras, index: int) -> dict[str, Any]:
    """A camera under nerfstudio's names, in nine digits: what rounding changes is no other camera."""
    names = {"fx": "fl_x", "fy": "fl_y", "cx": "cx", "cy": "cy", "width": "w", "height": "h"}
    numbers = {name: float(f"{float(getattr(cameras, key)[index]):.9g}") for key, name in names.items()}
    pose = [[float(f"{entry:.9g}") for entry in row] for row in cameras.camera_to_worlds[index].tolist()]
    return {"file": f"{index:05d}.png", "transform_matrix": [*pose, [0.0, 0.0, 0.0, 1.0]], **numbers}


def _claim(folder: Path, facts: dict[str, Any]) -> None:
    """Write a new folder's frames.json; InputError if the folder is not empty, and not of the same facts."""
    make_folder(folder, "--output-path")
    path = folder / "frames.json"
    if not path.exists():
        if any(entry.name != f".{path.name}.tmp" for entry in folder.iterdir()):  # which a killed process leaves
            raise InputError(f"--output-path {folder}: has other files, and no frames.json; name a new folder")
        write_json(path, facts)
        return
    found = read_json(path).object()
    for key, value in facts.items():
        if found.get(key) != value:
            raise InputError(f"--output-path {folder}: its frames are of other settings ({key}); name a new folder")


def _is_whole(path: Path) -> bool:
    """Whether a frame is there and can be read to its end."""
    try:
        with Image.open(path) as image:
            image.load()
    except Exception:  # OSError, SyntaxError, DecompressionBombError, ...
        return False
    return True
