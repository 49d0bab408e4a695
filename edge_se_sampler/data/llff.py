"""Folders with images and poses_bounds.npy, as LLFF writes them (Mildenhall et al. 2019).

A row of the file is an image, in the order of the images' names: 3 x 5 numbers, of which the first four columns are the
camera's axes (down, right, back) and its position, and the last is height, width and focal length in pixels, of the
image that the poses were found with; then the nearest and the farthest depth at which it sees something.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from edge_se_sampler.data.capture import Capture
from edge_se_sampler.data.colmap import find_images, is_scaled, list_visible
from edge_se_sampler.data.frames import DYNAMIC_MASK, MAX_POSITION, Frame, choose_orientation, read_headers
from edge_se_sampler.data.image_file import ImageHeader
from edge_se_sampler.data.lens import Intrinsics
from edge_se_sampler.data.mask_files import find_mask
from edge_se_sampler.data.scene_file import SourceFile, SourceLocation, locate_file

SUFFIXES = (".png", ".jpg", ".jpeg")
COLUMNS = 17


def bounds_path(folder: Path) -> Path:
    return folder / "poses_bounds.npy"


def read_llff(folder: Path) -> Capture:
    """All images of a folder, in the order of their names; the depths that each sees count as points.
    InputError for files that cannot be used, or if there is not one image for each pose."""
    rows, location = _read_rows(bounds_path(folder)), SourceLocation(bounds_path(folder))
    images = find_images(folder)
    found = [name for name in list_visible(images) if not name.startswith(DYNAMIC_MASK)]
    names = sorted(name for name in found if Path(name).suffix.lower() in SUFFIXES)
    if len(names) != len(rows):
        problem = f"has {len(rows)} poses, {images.name} has {len(names)} images"
        raise location.error(problem, "put the images there that the poses were found with, and no others")
    files = [locate_file(images, name, location.item(i)) for i, name in enumerate(names)]
    items = zip(files, read_headers(files), rows, strict=True)
    frames = [
        _frame(file, find_mask(folder, f"{images.name}/{file.name}", file), header, row) for file, header, row in items
    ]
    points = [_points(frame.pose, row[15:]) for frame, row in zip(frames, rows, strict=True)]
    return Capture(frames, [], points=points)


def _read_rows(path: Path) -> np.ndarray:
    """(n, 17) float64."""
    location = SourceLocation(path)
    data = SourceFile(path, location).read_bytes()
    try:
        rows = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False).astype(np.float64, casting="safe")
    except Exception:  # numpy raises ValueError, TypeError, MemoryError, tokenize.TokenError, ... on bad files
        raise location.error(
            "is not a file of numbers as numpy saves them", "write it again with LLFF's tools"
        ) from None
    if rows.ndim != 2 or rows.shape[1] != COLUMNS or not len(rows):
        raise location.error(f"has the shape {rows.shape}, not (n, {COLUMNS})", "write it again with LLFF's tools")
    for i, row in enumerate(rows):
        _check_row(row, location.item(i))
    return rows


def _check_row(row: np.ndarray, location: SourceLocation) -> None:
    hint = "write it again with LLFF's tools"
    if not np.isfinite(row).all():
        raise location.error("is not finite", hint)
    matrix, (near, far) = row[:15].reshape(3, 5), row[15:]
    rotation = matrix[:, :3].clip(-2, 2)
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise location.error("its pose is no rotation", hint)
    if (matrix[:, 4] <= 0).any():
        raise location.error("its height, width or focal length is not above 0", hint)
    if not 0 < near < far <= MAX_POSITION:
        raise location.error(f"its depths are {near:g} and {far:g}, not 0 < near < far", hint)


def _frame(file: SourceFile, mask: SourceFile | None, header: ImageHeader, row: np.ndarray) -> Frame:
    matrix = row[:15].reshape(3, 5)
    height, width, focal = matrix[:, 4].tolist()

    def matches(header: ImageHeader) -> bool:
        return is_scaled(header, width, height)

    header = choose_orientation(file, header, matches)
    if not matches(header):
        problem = f"is {header.width} x {header.height} pixels, its camera's images {width:g} x {height:g}"
        raise file.error(problem, "use the images that the poses were found with, or scaled ones")
    pose = np.stack((matrix[:, 1], -matrix[:, 0], matrix[:, 2], matrix[:, 3]), axis=1)
    camera = Intrinsics(focal, focal, width / 2, height / 2).scaled(header.width / width, header.height / height)
    return Frame(file.name, file, mask, pose, header, camera)


def _points(pose: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """(2, 3): points on the optical axis."""
    return pose[:, 3] - depths[:, None] * pose[:, 2]
