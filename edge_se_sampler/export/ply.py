"""Binary PLY files (Turk 1994), and what all exports check before they begin."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import BinaryIO

import numpy as np

from edge_se_sampler.engine.files import check_output, write_atomically
from edge_se_sampler.errors import InputError

TYPES = {"f4": "float", "u1": "uchar"}


def check_export(path: Path, *suffixes: str) -> None:
    """InputError if no file with one of these suffixes can be written there, or the extra's packages are missing."""
    check_output(path, *suffixes)
    if any(find_spec(name) is None for name in ("manifold3d", "scipy", "skimage", "trimesh")):
        raise InputError("this needs the [export] extra: pip install 'edge-se-sampler[export]'")


def write_ply(path: Path, columns: dict[str, np.ndarray], faces: np.ndarray | None = None) -> None:
    """Write vertices, and triangles between them; InputError if the file cannot be written.

    Args:
        columns: by their names, in the file's order, values (n,): uint8 ones as uchar, others as float.
        faces: (f, 3) numbers of vertices.
    """
    kinds = {name: "u1" if values.dtype == np.uint8 else "f4" for name, values in columns.items()}
    vertices = np.empty(len(next(iter(columns.values()))), dtype=[(name, f"<{kind}") for name, kind in kinds.items()])
    for name, values in columns.items():
        vertices[name] = values
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {TYPES[kind]} {name}" for name, kind in kinds.items()]
    triangles = np.empty(0 if faces is None else len(faces), dtype=[("count", "u1"), ("vertices", "<i4", 3)])
    if faces is not None:
        triangles["count"], triangles["vertices"] = 3, faces
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]

    def write(file: BinaryIO) -> None:
        file.write("\n".join([*header, "end_header", ""]).encode())
        file.write(vertices.tobytes())
        file.write(triangles.tobytes())

    write_atomically(path, write)


def describe_file(path: Path, contents: str) -> str:
    """A line about a file that has been written."""
    return f"{path}: {contents}, {path.stat().st_size / 1e6:.1f} MB"


def point_columns(positions: np.ndarray, normals: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of positions and normals (n, 3), under the names that all programs know."""
    return dict(zip(("x", "y", "z", "nx", "ny", "nz"), np.concatenate((positions, normals), axis=1).T, strict=True))


def color_columns(colors: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of colors (n, 3) uint8."""
    return dict(zip(("red", "green", "blue"), colors.T, strict=True))
