"""Masks of the object that all views show in front of a plain background.

The first masks are what a plain background does not explain. Then, in rounds, the views vote on each other, and GrabCut
(Rother et al. 2004) follows the edges of each image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from edge_se_sampler.data.lens import Intrinsics
from edge_se_sampler.errors import InputError
from edge_se_sampler.masks.backgrounds import MAX_DISTANCE, measure_distances
from edge_se_sampler.masks.votes import UNKNOWN, count_votes

ROUNDS = 2
EMPTY, LIKELY, CERTAIN, SOLID = 0.5, 0.8, 0.9, 0.99
"""Shares of the other views: below EMPTY there is background; where less than LIKELY show foreground, a mask's is
doubted; from CERTAIN on what is clearly no background stays foreground; what looks like background is of the object
(a white window in front of a white wall) only if SOLID, else it shows through a hole."""
CLEAR_DISTANCE = 10.0
"""Standard deviations from the background from which on a pixel is clearly none of it; and half of the most around it:
at an edge, at least half of such a pixel is of the object."""


def segment(
    images: Sequence[np.ndarray],
    lenses: Sequence[Intrinsics],
    poses: Sequence[np.ndarray],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[np.ndarray]:
    """Masks (H, W) bool of images (H, W, 3) uint8, True on the object, by the cameras that took them, poses (3, 4).
    InputError if most images have no plain background."""
    distances = measure_distances(images)
    plain = sum(not np.isinf(distance).all() for distance in distances)
    if 2 * plain < len(images):
        problem = f"only {plain} of {len(images)} images have a plain background along their border"
        raise InputError(f"{problem}: masks need one in at least half of them")
    masks = [distance >= MAX_DISTANCE for distance in distances]
    with ThreadPoolExecutor() as pool:
        for number in range(ROUNDS):
            votes, cut = count_votes(lenses, poses, masks), []
            for mask in pool.map(_cut, images, distances, masks, votes):
                cut.append(mask)
                progress(number * len(images) + len(cut), ROUNDS * len(images))
            masks = cut
        return list(pool.map(_fill, masks, count_votes(lenses, poses, masks)))


def _cut(image: np.ndarray, distance: np.ndarray, mask: np.ndarray, votes: np.ndarray) -> np.ndarray:
    """One iteration of GrabCut, begun with a mask (H, W) as the votes correct it."""
    known = votes != UNKNOWN
    if np.isinf(distance).all():  # no plain background: only the other views know
        return mask & (~known | (votes >= CERTAIN))
    labels = np.where(mask & (~known | (votes >= LIKELY)), np.uint8(cv2.GC_PR_FGD), np.uint8(cv2.GC_PR_BGD))
    most = cv2.dilate(np.minimum(distance, np.float32(1e3)), np.ones((5, 5)))
    labels[mask & (distance >= np.maximum(CLEAR_DISTANCE, most / 2)) & (votes >= CERTAIN)] = cv2.GC_FGD
    plain = ~mask & (distance < MAX_DISTANCE)
    labels[known & (votes < np.where(plain, SOLID, EMPTY))] = cv2.GC_BGD
    foreground = labels & 1  # GC_FGD and GC_PR_FGD
    if foreground.all() or not foreground.any():
        return foreground > 0
    cv2.setRNGSeed(0)  # of this thread
    background, object_ = np.zeros((2, 1, 65))
    # typed as if the rectangle, which a mask replaces, could not be left out
    cv2.grabCut(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), labels, None, background, object_, 1, cv2.GC_INIT_WITH_MASK)  # pyright: ignore
    return (labels & 1) > 0


def _fill(mask: np.ndarray, votes: np.ndarray) -> np.ndarray:
    """The mask (H, W) with those of its holes that the other views show to be of the object."""
    count, holes = cv2.connectedComponents((~mask).astype(np.uint8), connectivity=4)
    holes = np.asarray(holes, dtype=np.int64)
    share = np.bincount(holes.ravel(), votes.ravel(), count) / np.bincount(holes.ravel(), minlength=count).clip(min=1)
    share[np.concatenate((holes[0], holes[-1], holes[:, 0], holes[:, -1]))] = 0  # open to the border
    return mask | (~mask & (share >= SOLID)[holes])
