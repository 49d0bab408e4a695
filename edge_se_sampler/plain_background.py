"""What an empty scene would show at a pixel: the background, and how far a pixel's colour is from it."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.edges import unit_float
from edge_se_sampler.image_batch import ImageBatch

VISIBLE = 0.01
"""A pixel farther than this from the background shows the object: a tenth of the full contrast in one channel."""


def summed_up(error: Tensor, distance: Tensor, relative: Tensor, by_edge: bool) -> tuple[float, float, float, float]:
    """What a step's pixels say of both ways of drawing, by importance weights (see `schedule`).

    Args:
        error: (n,) e.
        distance: (n,) b, see `PlainBackgrounds.squared_distance`.
        relative: (n,) p / u.
        by_edge: whether edge sampling drew them; else uniform sampling did.

    Returns:
        how many show the object, E[e], E[b], U[e].
    """
    error, distance, relative = (values.double().to(error.device) for values in (error, distance, relative))
    as_edge, as_uniform = (1, 1 / relative) if by_edge else (relative, 1)
    sums = torch.stack(((distance > VISIBLE).double(), error * as_edge, distance * as_edge, error * as_uniform))
    count, *totals = sums.sum(dim=1).tolist()
    edge_error, edge_background, uniform_error = (total / len(error) for total in totals)
    return count, edge_error, edge_background, uniform_error


class PlainBackgrounds:
    """The backgrounds of images: of those with alpha what the model is rendered on, of others their border's median."""

    def __init__(self) -> None:
        self._numbers = torch.zeros(0, dtype=torch.int64)
        self._colors = torch.zeros((0, 3))

    def look_at(self, batch: ImageBatch) -> None:
        """Remember the borders of images that are new, unless they have alpha."""
        if batch.channels == 4:
            return
        known = torch.isin(batch.numbers.cpu(), self._numbers)
        new = torch.nonzero(~known)[:, 0].tolist()
        if new:
            numbers = torch.cat((self._numbers, batch.numbers.cpu()[new]))
            colors = torch.cat((self._colors, torch.stack([_border(batch.image(k)) for k in new])))
            self._numbers, order = torch.sort(numbers)
            self._colors = colors[order]

    def squared_distance(self, pixels: dict[str, Any], behind: tuple[float, float, float]) -> Tensor:
        """b (n,) of pixels of images looked at.

        Args:
            pixels: `indices` (n, 3), `image` (n, 3|4).
            behind: what images with alpha are composited on, RGB in [0, 1].
        """
        image = pixels["image"]
        image = image.float() / 255 if image.dtype == torch.uint8 else image
        if image.shape[1] == 4:
            return (image[:, 3:] * (image[:, :3] - image.new_tensor(behind))).square().sum(dim=1)
        places = torch.searchsorted(self._numbers, pixels["indices"][:, 0].cpu().contiguous())
        return (image - self._colors[places].to(image)).square().sum(dim=1)


def _border(image: np.ndarray) -> Tensor:
    """(3,) median colour of the outermost pixels."""
    image = unit_float(image)
    border = np.concatenate((image[0], image[-1], image[:, 0], image[:, -1]))
    return torch.from_numpy(np.median(border, axis=0)).float()
