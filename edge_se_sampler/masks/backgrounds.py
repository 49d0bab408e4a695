"""The plain background of photographs: smooth surfaces of color, found along the border of each image.

A wall or a table cloth has one color, which light and lens change smoothly over the image: a quadratic polynomial of
x and y in each channel of CIE Lab. Several may meet (a wall and a table). What the object shows of itself at the border
is distinguished from them by its colors, which are more frequent at the center of the images.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

BORDER = 0.03
"""Width of the border, as a share of an image's longer side; its center is the middle half of its rows and columns."""
BINS = 16
"""Of each channel's histogram."""
MAX_SURFACES = 2
MIN_SEEDS = 0.1
"""Share of the border that has the color from which a surface grows, at least."""
DEVIATIONS = 1.0, 8.0
"""Standard deviation of a channel, of 255: what rounding and compression make of any image, and what is still plain."""
MIN_SHARE = 0.5
"""Of what the first surface leaves of the border, explained by the next one: it is none, but of the object, else."""
MAX_DISTANCE = 3.5
"""Standard deviations from a surface up to which a pixel is explained."""
COEFFICIENTS = 1, 1, 3, 3, 6, 6, 6, 6
"""In each step of a fit: a color, then a plane, then a quadratic surface."""
SAMPLES = 4000
"""Pixels that a surface is fitted to."""


def measure_distances(images: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Of the pixels of images (H, W, 3) uint8: (H, W) float32, standard deviations from the nearest surface of the
    image's background, infinite where it has none; above MAX_DISTANCE no background explains a pixel."""
    bins = [_find_bins(image) for image in images]
    borders = [_border(image.shape[:2]) for image in images]
    frequency = np.zeros((2, BINS**3))
    for colors, border in zip(bins, borders, strict=True):
        height, width = colors.shape
        center = colors[height // 4 : height - height // 4, width // 4 : width - width // 4]
        frequency += [np.bincount(part, minlength=BINS**3) for part in (colors[border], center.ravel())]
    at_border, at_center = frequency / frequency.sum(axis=1, keepdims=True)
    return [
        _measure(image, colors, border, (at_border > at_center)[colors])
        for image, colors, border in zip(images, bins, borders, strict=True)
    ]


def _find_bins(image: np.ndarray) -> np.ndarray:
    """(H, W) uint16: the bin of each color."""
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB) // (256 // BINS)
    return (lab.astype(np.uint16) @ np.array((BINS**2, BINS, 1), dtype=np.uint16)).astype(np.uint16)


def _border(shape: tuple[int, ...]) -> np.ndarray:
    """(H, W) bool."""
    margin = max(2, round(BORDER * max(shape)))
    border = np.ones(shape, dtype=bool)
    border[margin:-margin, margin:-margin] = False
    return border


def _measure(image: np.ndarray, bins: np.ndarray, border: np.ndarray, typical: np.ndarray) -> np.ndarray:
    """`measure_distances` of one image; of each pixel (H, W): its color's bin, and whether that is one of borders."""
    height, width = bins.shape
    y, x = (np.mgrid[:height, :width] * 2 - np.array((height, width)).reshape(2, 1, 1)) / max(height, width)
    terms = np.stack((np.ones_like(x), x, y, x * x, x * y, y * y), axis=2)
    colors = cv2.cvtColor(image, cv2.COLOR_RGB2LAB).astype(np.float64)
    distance, left = np.full(bins.shape, np.inf, dtype=np.float32), border
    for _ in range(MAX_SURFACES):
        seeds = left & typical
        seeds &= bins == np.bincount(bins[seeds], minlength=1).argmax()
        if seeds.sum() < MIN_SEEDS * border.sum():
            break
        found = _fit_surface(terms, colors, seeds)
        explained = left & (found < MAX_DISTANCE)
        if left is not border and explained.sum() < MIN_SHARE * left.sum():
            break
        distance = np.minimum(distance, found)
        left = left & ~(cv2.dilate((found < MAX_DISTANCE).astype(np.uint8), np.ones((3, 3))) > 0)
    return cv2.medianBlur(distance, 3)


def _fit_surface(terms: np.ndarray, colors: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The distances (H, W) of all pixels, of terms (H, W, 6) and colors (H, W, 3), from the surface that grows from the
    seeds, (H, W) bool: what a step explains, the next is fitted to. They are infinite if it is not plain."""
    rng, explained = np.random.default_rng(0), seeds
    distance, deviation = np.full(seeds.shape, np.inf, dtype=np.float32), np.zeros(3)
    for count in COEFFICIENTS:
        a, b = terms[explained][:, :count], colors[explained]
        rows = rng.choice(len(a), min(SAMPLES, len(a)), replace=False)
        coefficients = np.linalg.lstsq(a[rows], b[rows], rcond=None)[0]
        # that of Gaussian noise, by its median
        deviation = 1.4826 * np.median(np.abs(b[rows] - a[rows] @ coefficients), axis=0)
        offset = (colors - terms[..., :count] @ coefficients) / deviation.clip(min=DEVIATIONS[0])
        distance = np.sqrt((offset**2).sum(axis=2)).astype(np.float32)
        explained = distance < MAX_DISTANCE
    return distance if deviation.max() <= DEVIATIONS[1] else np.full_like(distance, np.inf)
