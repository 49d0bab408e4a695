"""Outputs: checked before the work, written completely or not at all; InputError if they cannot be written."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from edge_se_sampler.errors import InputError, os_errors_as_input_errors


def write_atomically(path: Path, content: bytes | Callable[[BinaryIO], None]) -> None:
    """Replace a file's content, by bytes or by what writes it, and flush it to the disk; on failure, and where another
    process has begun to write it meanwhile, leave the file as it was."""
    temporary, own = _temporary(path), None

    def is_own() -> bool:
        return own is not None and os.path.lexists(temporary) and os.path.samestat(own, os.lstat(temporary))

    with os_errors_as_input_errors(f"{path}: cannot be written, what was there before is untouched"):
        try:
            temporary.unlink(missing_ok=True)  # it may be a link that leads elsewhere
            with open(temporary, "xb") as file:
                own = os.fstat(file.fileno())
                file.write(content) if isinstance(content, bytes) else content(file)
                file.flush()
                os.fsync(file.fileno())
                if not is_own():
                    raise FileExistsError(errno.EEXIST, "another process writes it, too")
            os.replace(temporary, path)
        finally:
            with contextlib.suppress(OSError):
                if is_own():
                    temporary.unlink()
        with contextlib.suppress(PermissionError):  # a folder that cannot be opened cannot be flushed
            folder = os.open(path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)


def _temporary(path: Path) -> Path:
    """Where a file is written before it takes its place."""
    return path.parent / f".{path.name}.tmp"


def check_output(path: Path, *suffixes: str, flag: str = "--output-path") -> None:
    """Check that a file, named by a flag, can be written: it must end in one of the suffixes, and its folder exist."""
    if not path.name or os.path.isdir(path):
        raise InputError(f"{flag} {path}: must name a file, not a folder")
    if os.path.exists(path) and not os.path.isfile(path):
        raise InputError(f"{flag} {path}: is no regular file, and would be replaced by one; name another")
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{flag} {path}: must end in {' or '.join(suffixes)}")
    if not os.path.isdir(path.parent):
        raise InputError(f"{flag} {path}: no such folder {path.parent}")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{flag} {path}: {path.parent} cannot be written")
    with os_errors_as_input_errors(f"{flag} {path}: cannot be written"), contextlib.suppress(FileNotFoundError):
        os.lstat(_temporary(path))  # its name may be too long


def make_folder(path: Path, flag: str) -> None:
    """Create a folder, named by a flag, unless it exists."""
    with os_errors_as_input_errors(f"{flag} {path}: cannot be created"):
        path.mkdir(parents=True, exist_ok=True)
    if not os.access(path, os.W_OK):
        raise InputError(f"{flag} {path}: cannot be written")


def checksum(content: Any) -> str:
    """SHA-256 of a json value, whatever the order of its keys."""
    content = json.loads(json.dumps(content))  # keys that are numbers become strings
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def write_json(path: Path, content: Any) -> None:
    """Write valid json; a NaN is a ValueError, not a token."""
    write_atomically(path, json.dumps(content, indent=1, allow_nan=False).encode() + b"\n")


def write_image(path: Path, image: np.ndarray) -> None:
    """Write an image as PNG, see `encode_png`."""
    write_atomically(path, encode_png(image))


def encode_png(image: np.ndarray) -> bytes:
    """(H, W, 3) floats in [0, 1], or (H, W) or (H, W, 3|4) of unsigned integers, as a PNG."""
    import imageio.v3 as iio  # slow to load: not for --help

    pixels = image if image.dtype.kind == "u" else to_uint8(image)
    return iio.imwrite("<bytes>", pixels, extension=".png")


def to_uint8(image: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
