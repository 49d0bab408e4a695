"""What an empty scene would show at a pixel: the background, and how far a pixel's color is from it."""

from __future__ import annotations

import numpy as np

from edge_se_sampler.sampling.edges import unit_float
from edge_se_sampler.sampling.image_batch import ImageBatch

MIN_OBJECT_DISTANCE = 0.01
"""Squared distance from the background above which a pixel shows the object: a tenth of the full contrast in one
channel."""


def summarize_errors(
    error: np.ndarray, distance: np.ndarray, edge_ratio: np.ndarray, density_ratio: np.ndarray
) -> tuple[float, float, float, float]:
    """Means under both ways of drawing, by importance weights, from pixels drawn in any way; symbols as in `schedule`.

    Args:
        error: (n,) e.
        distance: (n,) b.
        edge_ratio: (n,) p/u.
        density_ratio: (n,) probability with which each pixel was really drawn, over u.

    Returns:
        how many pixels show the object, E[e], E[b], U[e].
    """
    as_edge, as_uniform = edge_ratio / density_ratio, 1 / density_ratio
    means = (float(np.mean(values)) for values in (error * as_edge, distance * as_edge, error * as_uniform))
    edge_error, edge_background, uniform_error = means
    return float(np.count_nonzero(distance > MIN_OBJECT_DISTANCE)), edge_error, edge_background, uniform_error


class PlainBackgrounds:
    """Backgrounds of images: for those with alpha the color the model is rendered on, for others their border's
    median."""

    def __init__(self) -> None:
        self._colors: dict[int, np.ndarray] = {}  # by image number

    def add(self, batch: ImageBatch) -> None:
        """Take up the borders of images that are new, unless they have alpha."""
        for k, number in enumerate(batch.numbers.tolist()):
            if number not in self._colors and batch.per_pixel["image"][k].shape[2] == 3:
                self._colors[number] = _border_color(batch.image(k))

    def squared_distance(
        self, image: np.ndarray, numbers: np.ndarray, background_color: tuple[float, float, float]
    ) -> np.ndarray:
        """b (n,) of pixels of images that were added.

        Args:
            image: (n, 3|4) pixels, uint8 or float in [0, 1].
            numbers: (n,) of their images.
            background_color: RGB in [0, 1] behind transparent pixels.
        """
        image = unit_float(image[None])[0]
        if image.shape[1] == 4:
            difference = image[:, 3:] * (image[:, :3] - np.array(background_color, dtype=np.float32))
        else:
            images, rows = np.unique(numbers, return_inverse=True)
            difference = image - np.stack([self._colors[number] for number in images.tolist()])[rows]
        return np.square(difference).sum(axis=1)


def _border_color(image: np.ndarray) -> np.ndarray:
    """(3,) median color of the outermost pixels."""
    image = unit_float(image)
    border = np.concatenate((image[0], image[-1], image[:, 0], image[:, -1]))
    return np.median(border, axis=0).astype(np.float32)
