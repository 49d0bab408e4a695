"""Smaller images: averages over squares of k x k pixels, and the cameras that would have taken them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

from edge_se_sampler.data.views import Views
from edge_se_sampler.errors import InputError


def downscale(views: Views, factor: int) -> Views:
    """The views with every k x k pixels made one, k being the factor; what is left over at the right and lower border
    is cut off. Colors are averaged premultiplied by alpha, so what is transparent does not show; a pixel may be trained
    on if all of its k x k may. InputError: k is larger than an image."""
    if factor == 1:
        return views
    for name, image in zip(views.names, views.images, strict=True):
        if factor > min(image.shape[:2]):
            size = f"{image.shape[1]} x {image.shape[0]} pixels"
            raise InputError(f"--downscale is {factor}, but {name} has only {size}; give a smaller number")
    with ThreadPoolExecutor() as pool:  # numpy releases Python's lock
        images = tuple(pool.map(partial(average_pixels, factor=factor), views.images))
    masks = None
    if views.masks is not None:
        masks = tuple(shrink_mask(mask, factor) for mask in views.masks)
    return replace(views, images=images, masks=masks, cameras=views.cameras.downscale(factor))


def average_pixels(image: np.ndarray, factor: int) -> np.ndarray:
    """(H, W, 3|4) uint8, straight alpha -> (H // factor, W // factor, 3|4) uint8, straight alpha."""
    if image.shape[2] == 3:
        return np.rint(_blocks(image, factor).mean(axis=(1, 3), dtype=np.float32)).astype(np.uint8)
    alpha = image[..., 3:].astype(np.float32)
    color = _blocks(image[..., :3] * alpha, factor).mean(axis=(1, 3))
    alpha = _blocks(alpha, factor).mean(axis=(1, 3))
    color = np.divide(color, alpha, out=np.zeros_like(color), where=alpha > 0)
    return np.rint(np.concatenate((color, alpha), axis=2)).astype(np.uint8)


def shrink_mask(mask: np.ndarray, factor: int) -> np.ndarray:
    """(H, W) bool -> (H // factor, W // factor) bool: where all are True."""
    return np.asarray(_blocks(mask, factor).all(axis=(1, 3)))


def _blocks(values: np.ndarray, factor: int) -> np.ndarray:
    """(H, W, ...) -> (H // factor, factor, W // factor, factor, ...)."""
    height, width = (size // factor for size in values.shape[:2])
    cropped = values[: height * factor, : width * factor]
    return cropped.reshape(height, factor, width, factor, *values.shape[2:])
