"""What the other views of an object say about a pixel: the share of them that show foreground where its ray passes.

Points of a grid around the object are looked up in the masks of all views. A ray meets the object if at one point of it
the others agree on foreground: a visual hull (Laurentini 1994), but one that some wrong masks do not spoil. The share
is the largest of all points whose projection is within the pixel's block.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.lens import Intrinsics, locate
from edge_se_sampler.occupancy.hull import find_focus

UNKNOWN = -1.0
"""The share where too few views see any point of a ray."""
MIN_SEEN = 0.5
"""Share of the views that must see a point: without, few would decide what is of the object."""
RESOLUTIONS = 32, 96
"""Points along the longest side of a grid: of all that is as far from the focus as the cameras, then of the object."""
MIN_OBJECT = 0.8
"""Share of the views that show foreground at the points that the second grid encloses."""
BLOCK = 1.5
"""Edge of a block, in projected distances between points: so that no block goes without."""


def count_votes(
    lenses: Sequence[Intrinsics], poses: Sequence[np.ndarray], masks: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """(H, W) float32 of each view, by the masks (H, W) bool of all as its camera, of pose (3, 4), took them: the share,
    in [0, 1], of the other views that show foreground at the best point of a pixel's ray; UNKNOWN where too few see any
    of it."""
    votes = [np.full(mask.shape, UNKNOWN, dtype=np.float32) for mask in masks]
    intrinsics = {key: [getattr(lens, key) for lens in lenses] for key in ("fx", "fy", "cx", "cy")}
    height, width = np.array([mask.shape for mask in masks]).T
    cameras = Cameras.of(np.stack(poses), **intrinsics, width=width, height=height)
    focus, depth = find_focus(cameras)
    distance = float(np.median(depth))
    if not distance > 0:
        return votes
    cameras = cameras.to(dtype=torch.float32)
    low, high = focus - distance, focus + distance
    for resolution in RESOLUTIONS:
        step = float((high - low).max()) / resolution
        axes = (torch.arange(a + step / 2, b, step) for a, b in zip(low.tolist(), high.tolist(), strict=True))
        points = torch.cartesian_prod(*axes)
        sizes = [max(1.0, step * lens.fx / distance) for lens in lenses]
        # whether there is foreground within what a point of the grid stands for
        kernels = [np.ones((round(size) | 1,) * 2) for size in sizes]
        widened = [cv2.dilate(mask.astype(np.uint8), kernel) for mask, kernel in zip(masks, kernels, strict=True)]
        foreground, seen = np.zeros((2, len(points)), dtype=np.int32)
        for i, image in enumerate(widened):
            rows, pixels = find_pixels(cameras, i, lenses[i], points)
            foreground[rows] += image[pixels]
            seen[rows] += 1
        often = seen >= max(2, MIN_SEEN * len(masks))
        points, foreground, seen = points[torch.from_numpy(often)], foreground[often], seen[often]
        for i, image in enumerate(widened):
            rows, pixels = find_pixels(cameras, i, lenses[i], points)
            share = (foreground[rows] - image[pixels].astype(np.float32)) / (seen[rows] - 1)
            votes[i] = _paint(votes[i], pixels, share, int(np.ceil(BLOCK * sizes[i])))
        of_object = points[torch.from_numpy(foreground >= MIN_OBJECT * seen)].numpy()
        if not len(of_object):
            break
        low, high = of_object.min(axis=0) - step, of_object.max(axis=0) + step
    return votes


def find_pixels(
    cameras: Cameras, camera: int, lens: Intrinsics, points: torch.Tensor
) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Which of points (n, 3) a camera sees: their m rows, and the rows and columns of their pixels, (m,) each."""
    size = torch.cat((cameras.height[camera], cameras.width[camera]))
    coords, depth = cameras.project(camera, points)
    if lens.lens is None:
        inside = (depth > 0) & ((coords >= 0) & (coords < size)).all(dim=1)
    else:
        inside = depth > 0
        if not lens.lens.fisheye:  # other lenses move nothing farther
            inside &= ((coords > -size) & (coords < 2 * size)).all(dim=1)
        y, x = coords[inside].double().numpy().T
        shown, kept = locate(lens, lens, int(size[1]), int(size[0]), x - 0.5, y - 0.5)
        coords[inside] = torch.from_numpy(shown[::-1].T + 0.5).float().clamp(min=0).minimum(size - 1)
        inside[inside.clone()] = torch.from_numpy(kept)
    return inside.nonzero()[:, 0].numpy(), tuple(coords[inside].long().T.numpy())


def _paint(votes: np.ndarray, pixels: tuple[np.ndarray, ...], share: np.ndarray, size: int) -> np.ndarray:
    """The votes (H, W), those of the blocks in which points lie replaced by the largest share."""
    height, width = votes.shape
    blocks = np.full((height // size + 1, width // size + 1), UNKNOWN, dtype=np.float32)
    np.maximum.at(blocks, (pixels[0] // size, pixels[1] // size), share)
    painted = blocks[np.arange(height)[:, None] // size, np.arange(width) // size]
    return np.where(painted == UNKNOWN, votes, painted)
