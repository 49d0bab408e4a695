"""One image file of 8 bits a channel, read whole or refused."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from edge_se_sampler.data.source_location import Where, read_bytes, shown

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"
_AGAIN = "copy or download it again"

# pillow's mode of the file -> the mode to read it in; others (CMYK, 32 bits, float) have no plain 8-bit meaning
_MODES = {"1": "RGB", "L": "RGB", "P": "RGB", "RGB": "RGB", "LA": "RGBA", "PA": "RGBA", "RGBA": "RGBA"}


@dataclass(frozen=True)
class ImageFile:
    """An image that a field of a json file names."""

    where: Where  # the field
    name: str  # the path as listed, for messages
    path: Path  # the file, links resolved


def read_image(file: ImageFile) -> np.ndarray:
    """The stored pixels, (H, W, 3|4) uint8, straight alpha: no gamma, no EXIF turn.

    Grey becomes RGB, a palette its colours, transparency of any kind an alpha channel.
    Raises InputError for a file that is missing, unreadable, empty, neither PNG nor JPEG, cut short, damaged,
    of 16 bits, of no pixels, or of colours other than grey and RGB.
    """
    data = read_bytes(file.path, file.where, file.name)
    who = shown(file.name)
    if not data.startswith((_PNG, _JPEG)):
        raise file.where.error(f"{who} is not a PNG or JPEG image", "save the image as 8-bit PNG or JPEG")
    if data.startswith(_PNG):
        _check_png(data, file)
    try:
        pixels, mode = _decode(data)
    except MemoryError:
        raise
    except Exception as error:  # pillow raises OSError, SyntaxError, ValueError, struct.error, ... on bad files
        raise file.where.error(f"{who} cannot be decoded, truncated or damaged ({shown(str(error))})", _AGAIN) from None
    if pixels is None:
        raise file.where.error(f"{who} has colours of kind {mode}", "save it as 8-bit RGB or RGBA")
    return pixels


def _decode(data: bytes) -> tuple[np.ndarray | None, str]:
    """Pixels and pillow's mode of a file's bytes; no pixels if the mode is not one of ours."""
    with iio.imopen(data, "r", plugin="pillow") as opened:  # once: immeta() and imread() would each decode it
        image: Any = opened  # its plugin's read() has a mode that the declared base has not
        facts = image.metadata(index=0)
        stored = facts["mode"]
        if stored not in _MODES:
            return None, stored
        mode = "RGBA" if "transparency" in facts else _MODES[stored]
        return image.read(index=0, mode=mode), stored


def _check_png(data: bytes, file: ImageFile) -> None:
    """Raise InputError for what pillow would let pass, or not name."""
    who = shown(file.name)
    if not _whole_png(data):
        raise file.where.error(f"{who} is truncated or damaged", _AGAIN)
    width, height, depth = data[16:20], data[20:24], data[24:25]  # of IHDR, which is always the first chunk
    if not (any(width) and any(height)):
        raise file.where.error(f"{who} has zero size: no pixels", "save it again, with pixels")
    if depth == b"\x10":  # pillow would cut RGB to 8 bits and say nothing
        raise file.where.error(f"{who} is a 16-bit image", "save it with 8 bits a channel")


def _whole_png(data: bytes) -> bool:
    """Whether every chunk up to IEND is there and has the checksum it states: pillow does without the last ones."""
    start, view = len(_PNG), memoryview(data)
    while start + 12 <= len(data):  # a chunk: length, type, contents, checksum
        end = start + 8 + int.from_bytes(view[start : start + 4], "big")
        if zlib.crc32(view[start + 4 : end]).to_bytes(4, "big") != view[end : end + 4]:
            return False
        if view[start + 4 : start + 8] == b"IEND":
            return True
        start = end + 4
    return False
