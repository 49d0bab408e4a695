"""A mesh as a camera sees it, beside the image that was taken there and what the model renders."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.files import check_output, write_image
from edge_se_sampler.engine.frames import SEEN
from edge_se_sampler.engine.metrics import composite_on
from edge_se_sampler.engine.rendering import CameraRays, Picture, render_opaque, to_pictures
from edge_se_sampler.engine.session import read_test_views
from edge_se_sampler.errors import check_value
from edge_se_sampler.models.ray_model import RayModel

PIXELS_AT_ONCE = 2**22
AMBIENT = 0.15
"""Light on what is seen edge-on; 1 is on what faces the camera."""


def read_compared(config: TrainerConfig, path: Path, view: int) -> Picture:
    """The held-out view of that number; InputError if there is none, or the file cannot be written."""
    check_output(path, ".png", flag="--picture")
    pictures = to_pictures(read_test_views(config))
    check_value("picture-view", view, 0 <= view < len(pictures), f"between 0 and {len(pictures) - 1}")
    return pictures[view]


def write_comparison(path: Path, model: RayModel, picture: Picture, mesh: Any, colors: np.ndarray) -> str:
    """Write a row of four images: a view, its rendering, and the mesh there, in its vertices' colors (v, 3) in [0, 1]
    and shaded in gray by a light at the camera. Returns a line with the mesh's distance from the rendered depth."""
    camera, background = picture.camera, model.config.background_level
    rendered, depth = _render_with_depth(model, camera)
    face, shares, mesh_depth = rasterize(mesh.vertices, mesh.faces, camera)
    hit = face >= 0
    corners, shares = mesh.faces[face[hit]], shares[hit, :, None]
    directions = camera.image_rays(0).directions.numpy()[hit.reshape(-1)]
    lit = np.abs(((shares * mesh.vertex_normals[corners]).sum(axis=1) * directions).sum(axis=1, keepdims=True))
    row = [composite_on(image, background) for image in (picture.image, rendered)]
    for values in ((shares * colors[corners]).sum(axis=1), AMBIENT + (1 - AMBIENT) * lit):
        row.append(np.full_like(row[0], background))
        row[-1][hit] = values
    write_image(path, np.concatenate(row, axis=1))
    both = hit & (rendered[..., 3] > SEEN)
    pixels = np.abs(mesh_depth[both] - depth[both]) * float(camera.fx) / depth[both]
    median, most = np.quantile(pixels, (0.5, 0.9)) if both.any() else (np.nan, np.nan)
    return f"{path}: the mesh is {median:.2f} pixels from the rendered depth (median; 90 %: {most:.2f})"


def _render_with_depth(model: RayModel, camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """What a camera sees: (H, W, 4), straight alpha, and depths along the optical axis (H, W), world units."""
    rays, parts = CameraRays.of(model, camera), []
    size = int(camera.height), int(camera.width)
    for some in model.chunks(math.prod(size)):
        chunk = rays[some]
        colors, distance, opacity = render_opaque(model, chunk)
        parts.append(torch.cat((colors, opacity, distance / chunk.metadata["directions_norm"].cpu()), dim=1))
    rendered = torch.cat(parts).numpy().reshape(*size, 5)
    return rendered[..., :4], rendered[..., 4]


def rasterize(vertices: np.ndarray, triangles: np.ndarray, camera: Cameras) -> tuple[np.ndarray, ...]:
    """What a camera sees of a mesh with vertices (v, 3), world units, in front of it: at each pixel's center the number
    of the nearest triangle (H, W), -1 where there is none; the shares (H, W, 3) of its corners there; and its depth
    along the optical axis (H, W), world units."""
    height, width = int(camera.height), int(camera.width)
    coords, depth = (x.numpy() for x in camera.project(0, torch.from_numpy(np.array(vertices))))
    corners = coords[triangles] - 0.5  # (f, 3, 2) y, x; whole at the centers of pixels
    limits = np.array([height - 1, width - 1])
    first = np.ceil(corners.min(axis=1)).clip(0, limits + 1).astype(np.int64)
    last = np.floor(corners.max(axis=1)).clip(-1, limits).astype(np.int64)
    counts = (last - first + 1).clip(0)
    counts[depth[triangles].min(axis=1) <= 0] = 0  # what is not in front of the camera
    counts = counts.prod(axis=1)
    ends, columns = np.cumsum(counts), last[:, 1] - first[:, 1] + 1
    nearest, face = np.full(height * width, np.inf), np.full(height * width, -1)
    shares = np.zeros((height * width, 3))
    starts = np.searchsorted(ends, np.arange(PIXELS_AT_ONCE, ends[-1], PIXELS_AT_ONCE))
    for some in np.split(np.arange(len(triangles)), starts):
        number = np.repeat(some, counts[some])
        within = np.arange(len(number)) - np.repeat(np.cumsum(counts[some]) - counts[some], counts[some])
        y, x = first[number, 0] + within // columns[number], first[number, 1] + within % columns[number]
        share = find_shares(np.stack((y, x), axis=1), corners[number])
        inside = np.flatnonzero((share >= 0).all(axis=1))
        weights = share[inside] / depth[triangles[number[inside]]]  # what is linear in the image is divided by depth
        z = 1 / weights.sum(axis=1)
        pixel = y[inside] * width + x[inside]
        order = np.argsort(-z)  # of several values for a pixel the last one is kept
        order = order[z[order] < nearest[pixel[order]]]
        kept = pixel[order]
        nearest[kept], face[kept] = z[order], number[inside[order]]
        shares[kept] = weights[order] * z[order, None]
    return face.reshape(height, width), shares.reshape(height, width, 3), nearest.reshape(height, width)


def find_shares(positions: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (m, 3) of positions (m, 2) by triangles' corners (m, 3, 2): below 0 outside, NaN if the
    corners are on a line."""

    def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]

    one, other, here = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], positions - corners[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        second, third = cross(here, other) / cross(one, other), cross(one, here) / cross(one, other)
    return np.stack((1 - second - third, second, third), axis=1)
