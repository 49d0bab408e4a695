"""Image files of 8 bits a channel, PNG or JPEG, read as stored or refused."""

from __future__ import annotations

import warnings
import zlib
from dataclasses import dataclass, replace
from typing import Any

import imageio.v3 as iio
import numpy as np
from PIL import Image

from edge_se_sampler.data.scene_file import SourceFile, quote
from edge_se_sampler.errors import InputError

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"
_PNG_EXIF = b"eXIf", b"Raw profile type", b"com.adobe.xmp"
"""In a PNG that may have an orientation."""
_ORIENTATION = 274
"""EXIF's tag."""
warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # of half as many pixels as are refused
_COPY_AGAIN = "copy or download it again"

# pillow's mode of the file -> the mode to read it in; others (CMYK, 32 bits, float) have no plain 8-bit meaning
_MODES = {"1": "RGB", "L": "RGB", "P": "RGB", "RGB": "RGB", "LA": "RGBA", "PA": "RGBA", "RGBA": "RGBA"}


@dataclass(frozen=True)
class ImageHeader:
    """What an image file says before it is decoded."""

    width: int
    """Pixels, as stored."""
    height: int
    channels: int = 3
    """3 or 4, as `read_image` returns them."""
    orientation: int = 1
    """EXIF's: how programs that heed it turn the pixels; 1: not at all, 5 to 8: by a quarter (EXIF 2.3, tag 274)."""
    is_lossy: bool = False
    """Whether it is a JPEG, whose pixels are near those that were saved."""

    def upright(self) -> ImageHeader:
        """The header of the image that is turned as its orientation says."""
        return replace(self, width=self.height, height=self.width) if self.orientation >= 5 else self


def read_header(file: SourceFile) -> ImageHeader:
    """The header of an image file; InputError, as `read_image` raises, for one that has none."""
    try:
        file.check_regular()
        with file.path.open("rb") as stream, Image.open(stream) as image:
            width, height = image.size
            channels = 4 if "transparency" in image.info or _MODES.get(image.mode) == "RGBA" else 3
            # pillow decodes a PNG whole to look for EXIF behind the pixels
            may_be_turned = image.format != "PNG" or _may_have_exif(file.path.read_bytes())
            orientation = image.getexif().get(_ORIENTATION, 1) if may_be_turned else 1
            is_lossy = image.format != "PNG"
    except Image.DecompressionBombError:
        raise file.error(f"has more than {2 * (Image.MAX_IMAGE_PIXELS or 0):,} pixels", "make it smaller") from None
    except Exception:  # decoding says what is wrong
        height, width, channels = read_image(file).shape
        return ImageHeader(width, height, channels)
    return ImageHeader(width, height, channels, orientation if orientation in range(1, 9) else 1, is_lossy)


def _may_have_exif(png: bytes) -> bool:
    return any(name in png for name in _PNG_EXIF)


def turn_upright(image: np.ndarray, orientation: int) -> np.ndarray:
    """The pixels (H, W, ...) turned as an EXIF orientation of 5 to 8 says; others are left as they are."""
    if orientation < 5:
        return image
    image = image.swapaxes(0, 1)
    flips = {5: np.s_[:], 6: np.s_[:, ::-1], 7: np.s_[::-1, ::-1], 8: np.s_[::-1]}
    return np.ascontiguousarray(image[flips[orientation]])


def read_image(file: SourceFile) -> np.ndarray:
    """The stored pixels, (H, W, 3|4) uint8, straight alpha: no gamma, no EXIF rotation. Gray becomes RGB, a palette its
    colors, transparency of any kind an alpha channel. InputError for a file that is neither PNG nor JPEG, damaged, of
    16 bits, of no pixels, or of colors other than gray and RGB."""
    data = file.read_bytes()
    if not data.startswith((_PNG, _JPEG)):
        raise file.error("is not a PNG or JPEG image", "save the image as 8-bit PNG or JPEG")
    if data.startswith(_PNG):
        _check_png(data, file)
    try:
        with iio.imopen(data, "r", plugin="pillow") as opened:  # once: immeta() and imread() would each decode it
            image: Any = opened  # its plugin's read() has a mode that the declared base has not
            metadata = image.metadata(index=0)
            mode = metadata["mode"]
            if mode not in _MODES:
                raise file.error(f"has colors of kind {mode}", "save it as 8-bit RGB or RGBA")
            return image.read(index=0, mode="RGBA" if "transparency" in metadata else _MODES[mode])
    except (InputError, MemoryError):
        raise
    except Exception as error:  # pillow raises OSError, SyntaxError, ValueError, struct.error, ... on bad files
        raise file.error(f"cannot be decoded, truncated or damaged ({quote(str(error))})", _COPY_AGAIN) from None


def _check_png(data: bytes, file: SourceFile) -> None:
    if not _is_complete_png(data):
        raise file.error("is truncated or damaged", _COPY_AGAIN)
    width, height, depth = data[16:20], data[20:24], data[24:25]  # of IHDR, which is always the first chunk
    if not (any(width) and any(height)):
        raise file.error("has zero size: no pixels", "save it again, with pixels")
    if depth == b"\x10":  # pillow would cut RGB to 8 bits and say nothing
        raise file.error("is a 16-bit image", "save it with 8 bits a channel")


def _is_complete_png(data: bytes) -> bool:
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
