"""Points of a scene's surface, as its training views see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.files import to_uint8
from edge_se_sampler.engine.frames import SEEN
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.rendering import render_opaque
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.session import load_model, read_train_views
from edge_se_sampler.errors import InputError, check_value
from edge_se_sampler.export.ply import check_export, color_columns, describe_file, point_columns, write_ply
from edge_se_sampler.models.ray_model import RayModel

NEIGHBORS = 12
"""Points around each that its normal is found from."""
PIXELS_AT_ONCE = 2**15


@dataclass(frozen=True)
class PointCloud:
    """n points."""

    positions: np.ndarray
    """(n, 3) float64, world units."""
    normals: np.ndarray
    """(n, 3) unit vectors, towards the cameras."""
    colors: np.ndarray
    """(n, 3) in [0, 1], sRGB."""
    opacity: np.ndarray
    """(n,) in [0, 1]: accumulated along the rays that found the points."""
    spacing: np.ndarray
    """(n,) mean distance to the three nearest other points, world units."""


def export_points(run: RunFolder, config: TrainerConfig, path: Path, num_points: int, seed: int) -> str:
    """Write a run's points; returns a line about them. InputError as `load_points`."""
    cloud = load_points(run, config, path, num_points, seed)
    write_ply(path, point_columns(cloud.positions, cloud.normals) | color_columns(to_uint8(cloud.colors)))
    return describe_file(path, f"{len(cloud.positions):,} points")


def load_points(run: RunFolder, config: TrainerConfig, path: Path, num_points: int, seed: int) -> PointCloud:
    """A run's points, which are to be written as .ply; InputError if there can be no such number or seed, the file
    cannot be written, or nothing is opaque."""
    check_value("num-points", num_points, num_points > NEIGHBORS, f"above {NEIGHBORS}")
    check_value("seed", seed, seed >= 0, "at least 0")
    check_export(path, ".ply")
    model, _ = load_model(run, config)
    return find_points(model, read_train_views(config, trains=False), num_points, np.random.default_rng(seed))


def find_points(model: RayModel, views: Views, num_points: int, rng: np.random.Generator) -> PointCloud:
    """Points as `find_positions`, with normals."""
    values = find_positions(model, views.cameras, views.masks, num_points, rng)
    positions, directions, colors, opacity = np.split(values, (3, 6, 9), axis=1)
    normals, spacing = find_normals(positions, directions)
    return PointCloud(positions, normals, colors, opacity[:, 0], spacing)


def find_positions(
    model: RayModel,
    cameras: Cameras,
    masks: Sequence[np.ndarray] | None,
    num_points: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Where the rays of randomly chosen pixels, no one twice, meet something: at most so many rows (n, 10) of a
    position in world units, the ray's direction, color and opacity. A point between two surfaces, the mean of a ray
    that sees both, is left out where the model's cells are empty. InputError if there are hardly any.

    Args:
        masks: (H, W) bool of each camera: the pixels that are known; None: all.
    """
    sizes = torch.cat((cameras.height, cameras.width), dim=1).cpu().numpy()
    ends = np.cumsum(sizes.prod(axis=1))
    order = np.arange(ends[-1], dtype=np.int32 if ends[-1] < 2**31 else np.int64)
    if masks is not None:
        order = order[np.concatenate([mask.reshape(-1) for mask in masks])]
    rng.shuffle(order)
    cameras = cameras.to(model.device, model.dtype)
    found, count = [], 0
    with Progress(num_points, "finding points") as progress:
        for start in range(0, len(order), PIXELS_AT_ONCE):
            pixel = order[start : start + PIXELS_AT_ONCE].astype(np.int64)
            view = np.searchsorted(ends, pixel, side="right")
            row, column = np.divmod(pixel - (ends - sizes.prod(axis=1))[view], sizes[view, 1])
            rays = cameras.pixel_rays(torch.from_numpy(np.stack((view, row, column), axis=1)))
            colors, distance, opacity = render_opaque(model, rays)
            directions = rays.directions.cpu()
            positions = rays.origins.cpu() + distance * directions
            seen = opacity[:, 0] > SEEN
            if model.grid is not None:
                seen &= model.grid.contains(positions.to(model.device)).cpu()
            found.append(torch.cat((positions, directions, colors, opacity), dim=1)[seen])
            count += int(seen.sum())
            looked_at = min(1.0, (start + PIXELS_AT_ONCE) / len(order))
            progress.update(round(num_points * min(1.0, max(looked_at, count / num_points))))
            if count >= num_points:
                break
    if count <= NEIGHBORS:
        raise InputError("the model is opaque in no training view: it has learned nothing; train for longer")
    return torch.cat(found)[:num_points].double().numpy()


def find_normals(positions: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals (n, 3) of the planes through points and their neighbors, against the mean of the directions (n, 3) in
    which these are seen, and the mean distances (n,) to the three nearest."""
    from scipy.spatial import KDTree

    distance, number = map(np.asarray, KDTree(positions).query(positions, NEIGHBORS + 1))
    normals = np.empty_like(positions)
    for some in np.array_split(np.arange(len(positions)), len(positions) // 2**15 + 1):
        around = positions[number[some]]
        around = around - around.mean(axis=1, keepdims=True)
        normal = np.linalg.eigh(around.swapaxes(1, 2) @ around)[1][:, :, 0]
        away = (normal * directions[number[some]].mean(axis=1)).sum(axis=1, keepdims=True) > 0
        normals[some] = np.where(away, -normal, normal)
    return normals, distance[:, 1:4].mean(axis=1)
