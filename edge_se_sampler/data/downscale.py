"""Smaller images: averages over squares of k x k pixels; what is left over at the right and lower border is cut off."""

from __future__ import annotations

import numpy as np


def average_pixels(image: np.ndarray, factor: int) -> np.ndarray:
    """(H, W, 3|4) uint8, straight alpha -> (H // factor, W // factor, 3|4) uint8, straight alpha."""
    if image.shape[2] == 3:
        return np.rint(_average(image, factor)).astype(np.uint8)
    alpha = image[..., 3:].astype(np.float32)
    color, alpha = _average(image[..., :3] * alpha, factor), _average(alpha, factor)
    color = np.divide(color, alpha, out=np.zeros_like(color), where=alpha > 0)
    return np.rint(np.concatenate((color, alpha), axis=2)).astype(np.uint8)


def shrink_mask(mask: np.ndarray, factor: int) -> np.ndarray:
    """(H, W) bool -> (H // factor, W // factor) bool: where all are True."""
    return np.asarray(_blocks(mask, factor).all(axis=(1, 3)))


def _average(values: np.ndarray, factor: int) -> np.ndarray:
    """(H, W, C) of whole numbers -> (H // factor, W // factor, C) float64."""
    rows = _blocks(values, factor).sum(axis=1, dtype=np.float64)  # rows first: over both axes at once it is slow
    return rows.sum(axis=2) / factor**2


def _blocks(values: np.ndarray, factor: int) -> np.ndarray:
    """(H, W, ...) -> (H // factor, factor, W // factor, factor, ...)."""
    height, width = (size // factor for size in values.shape[:2])
    cropped = values[: height * factor, : width * factor]
    return cropped.reshape(height, factor, width, factor, *values.shape[2:])
