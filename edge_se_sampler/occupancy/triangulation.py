"""Points of a scene, from images and cameras alone: where the rays through a feature that two images share meet.

Features are SIFT's (Lowe 2004, with his test of the second-best match), which OpenCV finds. As the cameras are known,
most wrong matches show: their rays miss each other. What is left tells how deep a scene is, and no more than that.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.views import Views
from edge_se_sampler.sampling.edges import luma, unit_float

MAX_VIEWS, LONGEST_SIDE, MAX_FEATURES = 64, 400, 1000
"""Views that are looked at, pixels along their images then, and features of each: depths need no more."""
NEIGHBORS = 1, 2, 4, 8
"""With which others a view is compared, by how near they stand: the nearest share most, farther ones tell more of
depth."""
MAX_RATIO = 0.75
"""Of the distances of a feature to the best match and to the second (Lowe 2004, section 7.1)."""
MAX_ERROR = 1 / 400
"""Of an image's longest side, between a feature and where its point is seen."""
MIN_ANGLE = math.radians(2)
"""Between the two rays: at less, such an error moves their point by more than a tenth of its depth."""
MIN_POINTS = 100
"""Fewer may be wrong matches."""


@dataclass(frozen=True)
class _Features:
    coords: np.ndarray
    """(m, 2) float64 y, x, pixels of the image as it is."""
    descriptors: np.ndarray
    """(m, 128) float32 of length 1."""
    max_error: float
    """Pixels of the image as it is."""


def find_points(views: Views) -> Views | None:
    """The views, or some of many, with points that they see; None: there are too few."""
    views = views.subset(np.unique(np.linspace(0, len(views.names) - 1, MAX_VIEWS).round().astype(int)).tolist())
    features = [_find_features(views, i) for i in range(len(views.names))]
    seen = [[np.empty((0, 3))] for _ in features]
    for first, second in _pairs(views.cameras):
        points = _triangulate(views.cameras, (first, second), (features[first], features[second]))
        seen[first].append(points)
        seen[second].append(points)
    found = replace(views, points=tuple(map(np.concatenate, seen)))
    return found if sum(map(len, found.points or ())) >= MIN_POINTS else None


def _find_features(views: Views, i: int) -> _Features:
    """Those of one view, where it may be trained on."""
    image, known = views.images[i], None if views.masks is None else views.masks[i]
    scale = min(1.0, LONGEST_SIDE / max(image.shape[:2]))
    gray = (255 * luma(unit_float(image))).round().astype(np.uint8)
    height, width = (max(1, round(scale * length)) for length in gray.shape)
    small = cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA)
    mask = None if known is None else cv2.resize(known.astype(np.uint8), (width, height))
    keypoints, descriptors = cv2.SIFT.create(MAX_FEATURES).detectAndCompute(small, mask)
    if descriptors is None:  # there are none
        return _Features(np.empty((0, 2)), np.empty((0, 128), np.float32), 0)
    stretch = np.divide(gray.shape, small.shape)
    coords = (np.array([keypoint.pt[::-1] for keypoint in keypoints]) + 0.5) * stretch
    descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1)
    return _Features(coords, descriptors, MAX_ERROR * max(gray.shape))


def _pairs(cameras: Cameras) -> Iterator[tuple[int, int]]:
    """The pairs of views that are compared, each once."""
    positions = cameras.camera_to_worlds[:, :, 3]
    nearest = torch.cdist(positions, positions).argsort(dim=1, stable=True)
    ranks = [rank for rank in NEIGHBORS if rank < len(positions)]
    pairs = {tuple(sorted((i, int(j)))) for i, row in enumerate(nearest) for j in row[ranks]}
    return ((i, j) for i, j in sorted(pairs) if i != j)  # a view may not be the nearest to itself: others stand there


def _triangulate(cameras: Cameras, pair: tuple[int, int], features: tuple[_Features, _Features]) -> np.ndarray:
    """(m, 3) points that both views of a pair see."""
    matches = _match(*(each.descriptors for each in features))
    coords = [torch.from_numpy(each.coords[rows]) for each, rows in zip(features, matches, strict=True)]
    rays = [cameras.generate_rays(torch.full((len(some), 1), i), some) for i, some in zip(pair, coords, strict=True)]
    one, other = (ray.directions for ray in rays)
    between = rays[1].origins - rays[0].origins
    cosine = (one * other).sum(dim=1)
    squared_sine = (1 - cosine**2).clamp(min=1e-12)
    along, across = (between * one).sum(dim=1), (between * other).sum(dim=1)
    distances = (along - cosine * across) / squared_sine, (cosine * along - across) / squared_sine
    ends = [ray.origins + distance[:, None] * ray.directions for ray, distance in zip(rays, distances, strict=True)]
    points = (ends[0] + ends[1]) / 2  # where the rays are nearest to each other
    good = squared_sine > math.sin(MIN_ANGLE) ** 2
    for i, some, each in zip(pair, coords, features, strict=True):
        seen_at, depth = cameras.project(i, points)
        good &= (depth > 0) & ((seen_at - some).norm(dim=1) < each.max_error)
    return points[good].numpy()


def _match(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of descriptors (m, 128) and (n, 128), all of length 1, that match: each other's best, and clearly so."""
    if len(first) == 0 or len(second) < 2:
        return np.empty(0, int), np.empty(0, int)
    likeness, rows = first @ second.T, np.arange(len(first))
    best = likeness.argmax(axis=1)
    mutual, most = likeness.argmax(axis=0)[best] == rows, likeness[rows, best]
    likeness[rows, best] = -1
    matched = mutual & (1 - most < MAX_RATIO**2 * (1 - likeness.max(axis=1)))  # 1 - likeness: half the distance squared
    return rows[matched], best[matched]
