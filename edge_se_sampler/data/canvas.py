"""Pasting a picture onto a larger canvas, by whole pixels: every pixel that lands on it keeps its bytes.

W, H  size of a picture, pixels
p     padding on either side, pixels: the canvas is W + 2 p_x by H + 2 p_y
d     shift of the picture on its canvas, pixels, right and down positive

The picture's upper left corner goes to p in the centered copy and to p + d in the shifted one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

COPIES = ("centered", "shifted")

Pair = tuple[int, int]  # x, y


@dataclass(frozen=True)
class Canvas:
    """Where a picture is pasted; all in whole pixels (x, y)."""

    picture: Pair  # W, H
    pad: Pair  # p
    shift: Pair  # d, of at most a picture's size

    @classmethod
    def of(cls, image: np.ndarray, shift: tuple[float, float], pad: tuple[float, float] | None) -> Canvas:
        """The canvas of an (H, W, ...) image; `shift` and `pad` are fractions of W and H.

        Without `pad` the shifted picture just fits.
        """
        height, width = image.shape[:2]
        d = round(shift[0] * width), round(shift[1] * height)
        p = (abs(d[0]), abs(d[1])) if pad is None else (round(pad[0] * width), round(pad[1] * height))
        return cls((width, height), p, d)

    @property
    def size(self) -> Pair:
        """Columns and rows of the canvas."""
        return self.picture[0] + 2 * self.pad[0], self.picture[1] + 2 * self.pad[1]

    @property
    def corners(self) -> dict[str, Pair]:
        """The picture's upper left corner on the canvas, by copy."""
        return {"centered": self.pad, "shifted": (self.pad[0] + self.shift[0], self.pad[1] + self.shift[1])}

    def visible(self, corner: Pair) -> tuple[slice, slice]:
        """The rows and columns of the picture that land on the canvas."""
        (width, height), (x, y) = self.size, corner
        return slice(max(0, -y), min(self.picture[1], height - y)), slice(max(0, -x), min(self.picture[0], width - x))

    def paste(self, image: np.ndarray, corner: Pair, color: np.ndarray) -> np.ndarray:
        """The (H', W', ...) canvas that shows an (H, W, ...) image at `corner`, and `color` (...) around it."""
        x, y = corner
        rows, columns = self.visible(corner)
        canvas = np.full((self.size[1], self.size[0], *image.shape[2:]), color, image.dtype)
        canvas[rows.start + y : rows.stop + y, columns.start + x : columns.stop + x] = image[rows, columns]
        return canvas

    def count_cut_off(self, foreground: np.ndarray) -> int:
        """How many pixels of (H, W) bool `foreground` the shifted copy would cut off."""
        return int(np.count_nonzero(foreground) - np.count_nonzero(foreground[self.visible(self.corners["shifted"])]))

    def min_pad(self, foreground: np.ndarray) -> np.ndarray:
        """(2,) fractions of W and H: the least padding with which the shifted copy keeps (H, W) bool `foreground`."""
        positions = np.argwhere(foreground)[:, ::-1] + self.shift
        before, after = -positions.min(axis=0, initial=0), positions.max(axis=0, initial=0) + 1 - self.picture
        return np.maximum(before, after) / self.picture


def plain_background(image: np.ndarray) -> np.ndarray | None:
    """(C,) uint8, around the object: transparent black (RGBA), or the color of its border (RGB; None if of several)."""
    if image.shape[2] == 4:
        return np.zeros(4, np.uint8)
    border = np.concatenate((image[0], image[-1], image[:, 0], image[:, -1]))
    return border[0] if np.all(border == border[0]) else None


def object_mask(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """(H, W) bool: alpha above 0 for RGBA, other than the `background` color (3,) for RGB."""
    return image[..., 3] > 0 if image.shape[2] == 4 else np.any(image != background, axis=-1)
