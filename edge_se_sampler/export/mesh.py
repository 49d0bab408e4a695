"""A run's surface as a mesh with colors."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.files import to_uint8, write_atomically
from edge_se_sampler.engine.pipeline import analyze_views
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.rendering import render_opaque
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.session import load_model, read_train_views
from edge_se_sampler.errors import InputError, check_value
from edge_se_sampler.export.density import find_density
from edge_se_sampler.export.picture import read_compared, write_comparison
from edge_se_sampler.export.ply import check_export, color_columns, describe_file, point_columns, write_ply
from edge_se_sampler.export.surface import find_surface, keep_largest, simplify
from edge_se_sampler.models.ray_model import RayModel
from edge_se_sampler.occupancy.bricks import BrickGrid

RAYS_AT_ONCE = 2**16
CELLS_BEFORE = 2
"""How far outside the surface the rays begin that its colors are rendered by, in cells."""


def export_mesh(
    run: RunFolder,
    config: TrainerConfig,
    output_path: Path,
    *,
    opacity_threshold: float,
    keep_components: int,
    tolerance: float,
    picture: Path | None,
    picture_view: int,
) -> str:
    """Write the surface at which a cell has that opacity across; returns what there is to say about it. InputError if a
    value is out of its range, a file cannot be written, or nothing is as opaque."""
    check_value("opacity-threshold", opacity_threshold, 0 < opacity_threshold < 1, "above 0 and below 1")
    check_value("keep-components", keep_components, keep_components >= 0, "at least 0")
    check_value("tolerance", tolerance, 0 <= tolerance < math.inf, "at least 0")
    check_export(output_path, ".ply", ".glb")
    if picture is None and picture_view:
        raise InputError("--picture-view has no effect without --picture")
    compared = None if picture is None else read_compared(config, picture, picture_view)
    import trimesh

    model, _ = load_model(run, config)
    grid, density = find_density(model, opacity_threshold, partial(analyze_box, config))
    cell_size = float(grid.cell_size)
    vertices, triangles = find_surface(grid, density)
    if not len(triangles):
        problem = f"--opacity-threshold is {opacity_threshold}: nothing is as opaque"
        raise InputError(f"{problem}; give less, or train for longer")
    vertices, triangles = keep_largest(vertices, triangles, keep_components)
    if tolerance:
        vertices, triangles = simplify(vertices, triangles, tolerance * cell_size)
        check_value("tolerance", tolerance, len(triangles) > 0, "less: the whole surface is no larger")
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    normals = np.array(mesh.vertex_normals)
    colors = render_colors(model, vertices, normals, CELLS_BEFORE * cell_size)
    if output_path.suffix.lower() == ".glb":
        write_atomically(output_path, to_glb(vertices, normals, colors, triangles))
    else:
        write_ply(output_path, point_columns(vertices, normals) | color_columns(to_uint8(colors)), triangles)
    closed = "watertight" if mesh.is_watertight else "not watertight"
    report = describe_file(output_path, f"{len(vertices):,} vertices, {len(triangles):,} faces, {closed}")
    if picture is None or compared is None:
        return report
    return f"{report}\n{write_comparison(picture, model, compared, mesh, colors)}"


def analyze_box(config: TrainerConfig) -> BrickGrid:
    """The cells that may hold something by a run's training views: a dense network without cells may have learned
    anything that looks like the background outside of silhouettes."""
    views = read_train_views(config, trains=False)
    return analyze_views(views, replace(config.pipeline.model, empty_space_skipping=True)).grid()


def render_colors(model: RayModel, positions: np.ndarray, normals: np.ndarray, before: float) -> np.ndarray:
    """Colors (n, 3) in [0, 1] of a surface: those of rays along its inward normals, which begin that far outside. For
    training fits the colors of rays: at the surface itself, where these have little weight yet, the network's color may
    be any."""
    near, far = model.config.depths
    origins = torch.from_numpy(positions + normals * (before + near))
    origins, directions = (x.to(model.device, model.dtype) for x in (origins, torch.from_numpy(-normals)))
    one = torch.ones_like(origins[:, :1])
    metadata = {"directions_norm": one, "pixel_axes": origins.new_zeros(len(origins), 2, 3)}
    metadata |= {"nears": near * one, "fars": far * one}  # however much is empty before the training views' cameras
    rays = RayBundle(origins, directions, torch.zeros_like(one, dtype=torch.int64), metadata)
    colors = []
    with Progress(len(rays), "rendering colors") as progress:
        for start in range(0, len(rays), RAYS_AT_ONCE):
            colors.append(render_opaque(model, rays[start : start + RAYS_AT_ONCE])[0])
            progress.update(min(start + RAYS_AT_ONCE, len(rays)))
    return torch.cat(colors).numpy()


def to_glb(vertices: np.ndarray, normals: np.ndarray, colors: np.ndarray, triangles: np.ndarray) -> bytes:
    """A mesh as binary glTF 2.0, whose y is up and whose vertex colors are linear: its y is the data's z, its z minus
    the data's y, and sRGB colors (n, 3) in [0, 1] are linearized, as floats: bytes are too coarse for dark ones. It is
    shown unlit, for the scene's light is in its colors."""
    from trimesh import Trimesh
    from trimesh.exchange.gltf import export_glb

    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)

    def turn(vectors: np.ndarray) -> np.ndarray:
        return vectors[:, [0, 2, 1]] * (1, 1, -1)

    def add_colors(tree: dict[str, Any]) -> None:
        primitive = tree["meshes"][0]["primitives"][0]
        primitive["attributes"]["COLOR_0"] = primitive["attributes"].pop("_color")
        primitive["material"] = 0
        tree["materials"] = [{"extensions": {"KHR_materials_unlit": {}}, "doubleSided": True}]
        tree["extensionsUsed"] = ["KHR_materials_unlit"]

    mesh = Trimesh(
        turn(vertices),
        triangles,
        vertex_normals=turn(normals),
        vertex_attributes={"_color": linear.astype(np.float32)},
        process=False,
    )
    return export_glb(mesh, include_normals=True, tree_postprocessor=add_colors)
