"""What an empty scene would show at a pixel: the background, and how far a pixel's colour is from it."""

from __future__ import annotations

import numpy as np

from edge_se_sampler.sampling.edges import unit_float
from edge_se_sampler.sampling.image_batch import ImageBatch

VISIBLE = 0.01
"""A pixel farther than this from the background shows the object: a tenth of the full contrast in one channel."""


def summed_up(
    error: np.ndarray, distance: np.ndarray, relative: np.ndarray, by_edge: bool, kept: np.ndarray | float = 1.0
) -> tuple[float, float, float, float]:
    """What a step's pixels say of both ways of drawing, by importance weights (see `schedule`).

    Args:
        error: (n,) e.
        distance: (n,) b, see `PlainBackgrounds.squared_distance`.
        relative: (n,) p / u.
        by_edge: whether edge sampling drew them; else uniform sampling did.
        kept: (n,) how much likelier than on average each was kept of what was drawn.

    Returns:
        how many show the object, E[e], E[b], U[e].
    """
    as_edge, as_uniform = (1.0, 1 / relative) if by_edge else (relative / kept, 1 / kept)
    means = (np.mean(values) for values in (error * as_edge, distance * as_edge, error * as_uniform))
    edge_error, edge_background, uniform_error = map(float, means)
    return float(np.count_nonzero(distance > VISIBLE)), edge_error, edge_background, uniform_error


class PlainBackgrounds:
    """The backgrounds of images: of those with alpha what the model is rendered on, of others their border's median."""

    def __init__(self) -> None:
        self._numbers = np.zeros(0, dtype=np.int64)
        self._colors = np.zeros((0, 3), dtype=np.float32)

    def look_at(self, batch: ImageBatch) -> None:
        """Remember the borders of images that are new, unless they have alpha."""
        if batch.channels == 4:
            return
        numbers = batch.numbers.cpu().numpy()
        new = np.flatnonzero(~np.isin(numbers, self._numbers)).tolist()
        if new:
            colors = np.concatenate((self._colors, [_border(batch.image(k)) for k in new]))
            self._numbers = np.concatenate((self._numbers, numbers[new]))
            order = np.argsort(self._numbers)
            self._numbers, self._colors = self._numbers[order], colors[order]

    def squared_distance(
        self, image: np.ndarray, numbers: np.ndarray, behind: tuple[float, float, float]
    ) -> np.ndarray:
        """b (n,) of pixels of images looked at.

        Args:
            image: (n, 3|4) pixels, uint8 or float in [0, 1].
            numbers: (n,) of their images.
            behind: what images with alpha are composited on, RGB in [0, 1].
        """
        image = unit_float(image[None])[0]
        if image.shape[1] == 4:
            away = image[:, 3:] * (image[:, :3] - np.array(behind, dtype=np.float32))
        else:
            away = image - self._colors[np.searchsorted(self._numbers, numbers)]
        return np.square(away).sum(axis=1)


def _border(image: np.ndarray) -> np.ndarray:
    """(3,) median colour of the outermost pixels."""
    image = unit_float(image)
    border = np.concatenate((image[0], image[-1], image[:, 0], image[:, -1]))
    return np.median(border, axis=0).astype(np.float32)
