"""One small capture, written in every format that is read: images whose colors are their pixels' coordinates."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from edge_se_sampler.data.dataset import DataSettings, read_split
from edge_se_sampler.data.views import Views

WIDTH, HEIGHT, COUNT = 48, 36, 9
FX, FY, CX, CY = 40.0, 42.0, 23.0, 19.5
NAMES = [f"view {i:02d}.png" for i in range(COUNT)]
COLUMN_STEP, ROW_STEP = 5, 7
"""Of red and green from pixel to pixel."""
COLMAP_MODELS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5}
SQUARE_PIXELS = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
"""Models with one focal length."""


@dataclass(frozen=True)
class Distortion:
    """What distorts: a COLMAP model, and its terms by their names in a transforms.json."""

    model: str = "PINHOLE"
    terms: dict[str, float] = field(default_factory=dict)

    @property
    def parameters(self) -> list[float]:
        """COLMAP's."""
        focal = [FX] if self.model in SQUARE_PIXELS else [FX, FY]
        return [*focal, CX, CY, *self.terms.values()]


PINHOLE = Distortion()
OPENCV = Distortion("OPENCV", {"k1": -0.12, "k2": 0.03, "p1": 0.004, "p2": -0.003})
FISHEYE = Distortion("OPENCV_FISHEYE", {"k1": 0.05, "k2": -0.02, "k3": 0.004, "k4": -0.001})


def poses() -> np.ndarray:
    """(COUNT, 4, 4) camera to world, around the origin and about 4 from it, OpenGL's axes."""
    rng = np.random.default_rng(2)
    result = np.zeros((COUNT, 4, 4))
    for pose in result:
        back = rng.normal(size=3)
        back /= np.linalg.norm(back)
        right = np.cross((0.1, 1.0, 0.3), back)
        right /= np.linalg.norm(right)
        pose[:3] = np.stack((right, np.cross(back, right), back, 4 * back + rng.normal(scale=0.2, size=3)), axis=1)
        pose[3, 3] = 1
    return result


def picture(i: int) -> np.ndarray:
    """(HEIGHT, WIDTH, 3): red is the column, green the row, blue the view."""
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack((COLUMN_STEP * column, ROW_STEP * row, np.full_like(row, 20 * i)), axis=2).astype(np.uint8)


def write_images(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(NAMES):
        iio.imwrite(folder / name, picture(i))


def turned_jpeg(image: np.ndarray, orientation: int) -> bytes:
    """A JPEG with an EXIF orientation."""
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0" + bytes([orientation]) + b"\0\0\0\0\0\0"
    data = iio.imwrite("<bytes>", image, extension=".jpg", quality=100)
    return data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]


def transforms(distortion: Distortion = PINHOLE) -> dict[str, Any]:
    """A transforms.json of images/."""
    frames = [{"file_path": f"images/{NAMES[i]}", "transform_matrix": p.tolist()} for i, p in enumerate(poses())]
    sizes = {"w": WIDTH, "h": HEIGHT, "fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "camera_model": distortion.model}
    return sizes | distortion.terms | {"frames": frames}


def write_transforms(folder: Path, distortion: Distortion = PINHOLE) -> dict[str, Any]:
    write_images(folder / "images")
    document = transforms(distortion)
    (folder / "transforms.json").write_text(json.dumps(document))
    return document


def write_blender(folder: Path) -> dict[str, Any]:
    write_images(folder / "images")
    document = transforms()
    (folder / "transforms_train.json").write_text(json.dumps(document))
    return document


def points() -> np.ndarray:
    """(30, 3) points around the origin."""
    return np.random.default_rng(4).uniform(-0.8, 0.8, (30, 3))


def motions() -> list[list[float]]:
    """Of each view: quaternion w, x, y, z and translation, world to camera, OpenCV's axes."""
    result = []
    for pose in poses():
        rotation = (pose[:3, :3] * (1, -1, -1)).T
        w = np.sqrt(max(0.0, 1 + np.trace(rotation))) / 2
        if w > 0.1:
            x = (rotation[2, 1] - rotation[1, 2]) / (4 * w)
            y = (rotation[0, 2] - rotation[2, 0]) / (4 * w)
            z = (rotation[1, 0] - rotation[0, 1]) / (4 * w)
        else:  # the axis is the rotation's eigenvector
            values, vectors = np.linalg.eigh((rotation + rotation.T) / 2)
            axis = vectors[:, np.argmax(values)]
            sine = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0]]) @ axis[:2]
            angle = np.arctan2(
                np.linalg.norm(_skew(rotation)) / 2 * (1 if sine >= 0 else -1), (np.trace(rotation) - 1) / 2
            )
            w, (x, y, z) = np.cos(angle / 2), np.sin(angle / 2) * axis
        result.append([w, x, y, z, *(-rotation @ pose[:3, 3])])
    return result


def _skew(rotation: np.ndarray) -> np.ndarray:
    return np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])


def colmap_files(distortion: Distortion = PINHOLE, text: bool = False) -> dict[str, bytes]:
    """The three files of a model by their names; every view sees every point, and a feature that is none."""
    ids = [*range(1, len(points()) + 1), -1]
    if text:
        numbers = " ".join(map(repr, distortion.parameters))
        cameras = f"# comment\n7 {distortion.model} {WIDTH} {HEIGHT} {numbers}\n"
        images, lines = [], []
        for i, motion in enumerate(motions()):
            images += [f"{i + 1} {' '.join(map(repr, map(float, motion)))} 7 {NAMES[i]}"]
            images += [" ".join(f"1.5 2.5 {number}" for number in ids) if i else ""]
        for number, xyz in enumerate(points().tolist(), 1):
            lines.append(f"{number} {' '.join(map(repr, xyz))} 1 2 3 0.5 1 0 2 0")
        texts = {"cameras": cameras, "images": "\n".join(images) + "\n", "points3D": "\n".join(lines) + "\n"}
        return {f"{name}.txt": value.encode() for name, value in texts.items()}
    parameters = distortion.parameters
    cameras = struct.pack("<QIiQQ", 1, 7, COLMAP_MODELS[distortion.model], WIDTH, HEIGHT)
    cameras += struct.pack(f"<{len(parameters)}d", *parameters)
    images = struct.pack("<Q", COUNT)
    for i, motion in enumerate(motions()):
        images += struct.pack("<I7dI", i + 1, *motion, 7) + NAMES[i].encode() + b"\0"
        seen = ids if i else []
        images += struct.pack("<Q", len(seen)) + b"".join(struct.pack("<2dq", 1.5, 2.5, number) for number in seen)
    binary = struct.pack("<Q", len(points()))
    for number, xyz in enumerate(points().tolist(), 1):
        binary += struct.pack("<Q3d3BdQ", number, *xyz, 1, 2, 3, 0.5, 2) + struct.pack("<4I", 1, 0, 2, 0)
    return {"cameras.bin": cameras, "images.bin": images, "points3D.bin": binary}


def write_colmap(
    folder: Path, distortion: Distortion = PINHOLE, text: bool = False, sparse: str = "sparse/0"
) -> dict[str, bytes]:
    write_images(folder / "images")
    (folder / sparse).mkdir(parents=True)
    files = colmap_files(distortion, text)
    for name, data in files.items():
        (folder / sparse / name).write_bytes(data)
    return files


def bounds(scale: float = 1.0) -> np.ndarray:
    """(COUNT, 17): LLFF's poses, found with images that were `scale` times as large, and depths from 2 to 8."""
    rows = []
    for pose in poses():
        right, up, back, position = pose[:3].T
        size = np.array([HEIGHT, WIDTH, FX]) * scale
        rows.append(np.concatenate((np.stack((-up, right, back, position, size), axis=1).reshape(-1), [2.0, 8.0])))
    return np.array(rows)


def write_llff(folder: Path, rows: np.ndarray) -> None:
    write_images(folder / "images")
    np.save(folder / "poses_bounds.npy", rows)


def read(folder: Path, split: Any = "train", **settings: Any) -> Views:
    views = read_split(folder, split, DataSettings(**settings))
    assert views is not None
    return views
