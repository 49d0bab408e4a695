"""Small Blender folders to read, good ones; a test then spoils what it is about."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from edge_se_sampler.data.views import Views

WIDTH, HEIGHT = 6, 4
ANGLE = 0.6911112070083618  # NeRF-synthetic's


def pixels(seed: int, width: int = WIDTH, height: int = HEIGHT, channels: int = 4) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)


def pose(seed: int) -> list[list[float]]:
    """A random rigid 4x4 matrix, as far from the origin as NeRF's cameras are."""
    rng = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    position = rng.normal(size=3)
    matrix[:3, 3] = 4 * position / np.linalg.norm(position)
    return matrix.tolist()


def focal_lengths(views: Views) -> np.ndarray:
    """(n, 2) fx, fy."""
    return np.hstack((views.cameras.fx, views.cameras.fy))


def principal_points(views: Views) -> np.ndarray:
    """(n, 2) cx, cy."""
    return np.hstack((views.cameras.cx, views.cameras.cy))


def write_scene(folder: Path, n: int = 3, split: str = "train") -> dict[str, Any]:
    """n views of random pixels as NeRF's folders have them; returns what the json holds."""
    (folder / split).mkdir(parents=True)
    for i in range(n):
        iio.imwrite(folder / split / f"r_{i}.png", pixels(i))
    frames = [
        {"file_path": f"./{split}/r_{i}", "rotation": 0.012566370614359171, "transform_matrix": pose(i)}
        for i in range(n)
    ]
    doc = {"camera_angle_x": ANGLE, "frames": frames}
    write_json(folder, doc, split)
    return doc


def write_json(folder: Path, doc: object, split: str = "train") -> None:
    (folder / f"transforms_{split}.json").write_text(json.dumps(doc), encoding="utf-8")


def png(width: int, height: int, depth: int, color: int, rows: bytes, extra: bytes = b"") -> bytes:
    """A PNG written by hand, for what imageio does not write: `color` is 0 gray, 2 RGB, 3 palette, 6 RGBA."""
    header = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    end = chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + extra + end


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
