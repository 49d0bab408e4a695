"""Outputs: checked before the work, written completely or not at all."""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from edge_se_sampler.errors import InputError


def write_atomically(path: Path, content: bytes) -> None:
    """Replace a file's content and flush it to the disk; on failure leave the file as it was.

    Raises:
        InputError: it cannot be written.
    """
    temporary = path.parent / f".{path.name}.tmp"
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        with contextlib.suppress(PermissionError):  # a folder that cannot be opened cannot be flushed
            folder = os.open(path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
    except OSError as problem:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        reason = problem.strerror or str(problem)
        raise InputError(f"{path}: cannot be written ({reason}); what was there before is untouched") from problem


def check_output(path: Path, flag: str = "--output-path") -> None:
    """Check that a file can be written.

    Args:
        flag: of the command line, which named it.

    Raises:
        InputError: it names no file, is a folder, or its folder does not exist or cannot be written.
    """
    if not path.name or path.is_dir():
        raise InputError(f"{flag} {path}: must name a file, not a folder")
    if not path.parent.is_dir():
        raise InputError(f"{flag} {path}: no such folder {path.parent}")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{flag} {path}: {path.parent} cannot be written")


def prepare_output(path: Path, flag: str = "--output-path") -> None:
    """Create the folder of a file, and check that the file can be written.

    Raises:
        InputError: as `make_folder` and `check_output`.
    """
    make_folder(path.parent, f"{flag}, folder")
    check_output(path, flag)


def make_folder(path: Path, flag: str) -> None:
    """Create a folder that can be written.

    Args:
        flag: of the command line, which named it.

    Raises:
        InputError: it cannot be created or written.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        writable = os.access(path, os.W_OK)
    except OSError as problem:
        raise InputError(f"{flag} {path}: cannot be created ({problem.strerror or problem})") from problem
    if not writable:
        raise InputError(f"{flag} {path}: cannot be written")


def write_json(path: Path, content: Any) -> None:
    """Write valid json (a NaN is an error, not a token).

    Raises:
        InputError: it cannot be written.
    """
    write_atomically(path, json.dumps(content, indent=1, allow_nan=False).encode() + b"\n")


def write_image(path: Path, image: np.ndarray) -> None:
    """Write an (H, W, 3) float image in [0, 1] as PNG.

    Raises:
        InputError: it cannot be written.
    """
    write_atomically(path, png_bytes(image))


def png_bytes(image: np.ndarray) -> bytes:
    """The content of a PNG file of an (H, W, 3) float image in [0, 1]."""
    return iio.imwrite("<bytes>", to_uint8(image), extension=".png")


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Floats, clipped to [0, 1], as uint8."""
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
