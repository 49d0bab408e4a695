"""A point cloud as flat Gaussians, in the format of 3D Gaussian Splatting's reference code (Kerbl et al. 2023)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.export.ply import describe_file, point_columns, write_ply
from edge_se_sampler.export.points import PointCloud, load_points

HARMONIC = 0.28209479177387814
"""The spherical harmonic of degree 0."""
NUM_REST = 45
"""Coefficients of degrees 1 to 3, which readers expect; all 0: a splat has the same color from everywhere."""
EXTENT = 0.5
"""Standard deviation along the surface, in distances to the nearest others: more of it blurs."""
FLATNESS = 0.1
"""Extent along the normal, as a part of that along the surface."""
MAX_OPACITY = 0.99


def export_splats(run: RunFolder, config: TrainerConfig, path: Path, num_points: int, seed: int) -> str:
    """Write a Gaussian for each of a run's points; returns a line about them. InputError as `load_points`."""
    cloud = load_points(run, config, path, num_points, seed)
    write_ply(path, splat_columns(cloud))
    return describe_file(path, f"{len(cloud.positions):,} Gaussians")


def splat_columns(cloud: PointCloud) -> dict[str, np.ndarray]:
    """The properties of Gaussians: color as a spherical harmonic, opacity before the sigmoid, logarithms of standard
    deviations, and the rotation (w, x, y, z) that turns z to the normal."""
    opacity = np.minimum(cloud.opacity, MAX_OPACITY)
    extent = np.log(EXTENT * cloud.spacing)
    up = np.where(cloud.normals[:, 2:] < 0, -1, 1) * cloud.normals  # a flat Gaussian is the same upside down
    rotation = np.stack((1 + up[:, 2], -up[:, 1], up[:, 0], np.zeros(len(up))), axis=1)
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    dc = (cloud.colors - 0.5) / HARMONIC
    columns = point_columns(cloud.positions, cloud.normals)
    columns |= {f"f_dc_{i}": dc[:, i] for i in range(3)}
    columns |= {f"f_rest_{i}": np.zeros(len(up)) for i in range(NUM_REST)}
    columns |= {"opacity": np.log(opacity / (1 - opacity))}
    columns |= {"scale_0": extent, "scale_1": extent, "scale_2": extent + np.log(FLATNESS)}
    return columns | {f"rot_{i}": rotation[:, i] for i in range(4)}
