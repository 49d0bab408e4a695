"""Image -> edge strength: E = |phi(G(I))|, equation 4 of the paper.

I    image, (H, W, 3|4), uint8 or float in [0, 1], sRGB, straight alpha
G    gray: the color composited on the background, BT.601 luma, in [0, 1]
phi  edge operator with replicated borders, scaled so that a full-contrast step edge along an axis answers 1
E    edge strength, (H, W) float32, finite, >= 0
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import cv2
import numpy as np

EdgeFilter = Literal["sobel", "laplacian", "canny"]
EdgeSource = Literal["color", "alpha", "both"]

WHITE = (1.0, 1.0, 1.0)
CANNY_THRESHOLDS = (100, 200)
"""Hysteresis thresholds on the 8-bit 3x3 Sobel magnitude; a full-contrast step answers 1020."""
CHANGE_STEP = np.float32(2**-16)


def unit_float(image: np.ndarray) -> np.ndarray:
    """The image as float32 in [0, 1]; uint8 is divided by 255. ValueError: not (H, W, 3|4), neither uint8 nor float, or
    a value that is not in [0, 1]."""
    if image.ndim != 3 or image.shape[2] not in (3, 4):
        raise ValueError(f"an image must be (H, W, 3) or (H, W, 4), not {image.shape}")
    if image.dtype == np.uint8:
        return image.astype(np.float32) * np.float32(1 / 255)
    if not np.issubdtype(image.dtype, np.floating):
        raise ValueError(f"an image must be uint8 or float, not {image.dtype}")
    if not (image.min() >= -1e-6 and image.max() <= 1 + 1e-6):  # false for nan, too
        raise ValueError("the image has values that are not finite, or not in [0, 1]")
    return image.astype(np.float32, copy=False)


def luma(image: np.ndarray, background: tuple[float, float, float] = WHITE) -> np.ndarray:
    """BT.601 luma of the image composited on the background, (H, W) float32.

    Under alpha 0 the stored color is arbitrary, so it never shows: luma is linear, and the background's share
    is added after the weighting.

    Args:
        image: (H, W, 3|4) float32 in [0, 1].
        background: RGB in [0, 1]; unused for three channels.
    """
    # not cv2.cvtColor: it rounds the ends of rows differently, and a flat image would have edges
    gray = image[..., 0] * np.float32(0.299) + image[..., 1] * np.float32(0.587) + image[..., 2] * np.float32(0.114)
    if image.shape[2] == 3:
        return gray
    background_gray = np.float32(np.dot(background, (0.299, 0.587, 0.114)))
    return background_gray + image[..., 3] * (gray - background_gray)


def _sobel(gray: np.ndarray) -> np.ndarray:
    gx = cv2.Sobel(gray, cv2.CV_32F, 1, 0, ksize=3, scale=0.25, borderType=cv2.BORDER_REPLICATE)
    gy = cv2.Sobel(gray, cv2.CV_32F, 0, 1, ksize=3, scale=0.25, borderType=cv2.BORDER_REPLICATE)
    # not cv2.magnitude: its rounding depends on where in memory its answer lies
    return np.sqrt(gx * gx + gy * gy)


def _laplacian(gray: np.ndarray) -> np.ndarray:
    return np.abs(cv2.Laplacian(gray, cv2.CV_32F, ksize=1, borderType=cv2.BORDER_REPLICATE))


def _canny(gray: np.ndarray) -> np.ndarray:
    eight_bit = np.clip(np.rint(gray * 255), 0, 255).astype(np.uint8)
    padded = cv2.copyMakeBorder(eight_bit, 2, 2, 2, 2, cv2.BORDER_REPLICATE)
    edges = cv2.Canny(padded, *CANNY_THRESHOLDS, apertureSize=3, L2gradient=True)
    return (edges[2:-2, 2:-2] > 0).astype(np.float32)


FILTERS: dict[EdgeFilter, Callable[[np.ndarray], np.ndarray]]
FILTERS = {"sobel": _sobel, "laplacian": _laplacian, "canny": _canny}


def edge_strength(
    image: np.ndarray,
    *,
    edge_filter: EdgeFilter = "sobel",
    source: EdgeSource = "color",
    background: tuple[float, float, float] = WHITE,
) -> np.ndarray:
    """How strong an edge every pixel lies on (paper, equation 4): (H, W) float32, finite, >= 0.

    Args:
        image: (H, W, 3|4), uint8 or float in [0, 1], straight alpha.
        edge_filter: "sobel" sqrt(Gx^2 + Gy^2), "laplacian" |4-neighbour Laplacian|, "canny" 0 or 1.
        source: edges of the composited color, of alpha, or the stronger of both (a white object on white has
            no color edge).
        background: RGB behind transparent pixels.

    Raises:
        ValueError: a malformed image, or alpha edges of an image without alpha.
    """
    image, phi = unit_float(image), FILTERS[edge_filter]
    if source == "color":
        return phi(luma(image, background))
    if image.shape[2] == 3:
        raise ValueError(f"edge source {source!r} needs images with an alpha channel; these have none: use 'color'")
    alpha = phi(np.ascontiguousarray(image[..., 3]))
    return alpha if source == "alpha" else np.maximum(phi(luma(image, background)), alpha)


def color_change(image: np.ndarray, background: tuple[float, float, float] = WHITE) -> np.ndarray:
    """How much the color changes around every pixel (Zhang et al. 2022, "Fast Learning Radiance Fields by Shooting Much
    Fewer Rays", arXiv 2208.06821): the standard deviation of its 3 x 3 neighborhood, here of 8-bit luma. (H, W) float32
    in [0, 0.5], exactly 0 where that is constant, multiples of CHANGE_STEP, so that sums in float64 are exact; borders
    are replicated. Arguments and errors as `edge_strength`.
    """
    levels = luma(unit_float(image), background)
    levels *= 255
    np.rint(levels, out=levels)
    total, squares = (
        cv2.boxFilter(values, cv2.CV_32F, (3, 3), normalize=False, borderType=cv2.BORDER_REPLICATE)
        for values in (levels, levels * levels)
    )  # of integers, exact
    total *= total
    squares *= 9
    squares -= total
    change = np.sqrt(squares, out=squares)  # in place throughout: new memory takes longer than the arithmetic
    change *= np.float32(1 / (9 * 255 * CHANGE_STEP))
    np.rint(change, out=change)
    change *= CHANGE_STEP
    return change
