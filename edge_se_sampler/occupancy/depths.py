"""Between which depths the rays of a scene are sampled, where neither flags nor the format say.

focus  the point nearest to all optical axes
depth  along a camera's optical axis, world units

The best source there is decides: points that a reconstruction has seen, silhouettes that show all of an object,
features that images share, or the cameras alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.views import Views
from edge_se_sampler.errors import InputError
from edge_se_sampler.occupancy.hull import Box, Hull, carve, find_focus, find_silhouettes, show_whole_object
from edge_se_sampler.occupancy.triangulation import find_points

POINT_PERCENTILES = 0.5, 99.5
"""Of the depths of points: a few are matched wrongly, and lie anywhere."""
POINT_MARGIN = 0.1
"""By which the scene may reach beyond its points, as a share of their depth."""
FEATURE_MARGIN = 0.3
"""As that, behind features: what is far moves little from image to image, so that fewer of its are found."""
HULL_RESOLUTION = 64
"""Cells along the cube that silhouettes carve; it reaches from the focus to the middle camera."""
MIN_SEEN = 0.9
"""Share of the views that see a cell of the object, of the most that see any: the others are too few to carve what only
they see."""
CAMERA_FACTORS = 0.3, 2.0
"""Near and far of cameras alone, as multiples of their median distance from the focus: as far behind it as they are
before it; and nothing that only one or two of them see, for there a model can make up something for each image."""
MIN_AHEAD, MIN_MOVE = 0.9, 1e-6
"""Share of the cameras that must have the focus before them; and how far they must be from each other, as a share of
how far they are from the origin: less is rounding."""
NEAR_SHARE = 0.45
"""Part of the way from a camera to the focus in which nothing is that it sees, where neither masks nor points tell. A
camera that is close to what it shows is so to the focus, too."""


@dataclass(frozen=True)
class DepthRange:
    """Depths between which rays are sampled."""

    near: float
    far: float
    source: str
    """What they were derived from."""
    near_share: float = 0.0
    """Of the way from a camera to the focus, that share has nothing in it that it sees."""


def find_depths(views: Views) -> DepthRange:
    """The depths of a scene, from its training views; InputError if nothing tells."""
    if views.depths is not None:
        return DepthRange(*views.depths, "NeRF's Blender scenes")
    views = views.leave_out_far()
    found = (
        _depths_of_points(views)
        or _depths_of_silhouettes(views)
        or _depths_of_features(views)
        or _depths_of_cameras(views)
    )
    if found is None:
        raise InputError(
            "neither points, silhouettes nor cameras tell how deep the scene is: give --pipeline.model.near and "
            "--pipeline.model.far (of inspect: --near and --far)"
        )
    return found


def _depths_of_points(
    views: Views, source: str = "the points of the reconstruction", far_margin: float = POINT_MARGIN
) -> DepthRange | None:
    """The depths at which views see points, but for the most extreme ones."""
    reach = _reach(views)
    if reach is None:
        return None
    low, high, share = reach
    near, far, share = _rounded(low * (1 - POINT_MARGIN), high * (1 + far_margin), share * (1 - POINT_MARGIN))
    return DepthRange(near, far, source, share)


def _depths_of_features(views: Views) -> DepthRange | None:
    """Those of points that are seen in several images; too few of them tell what the closest cameras see: their rays
    begin at the same share of the way to the focus as others'."""
    views_with_points = find_points(views)
    if views_with_points is None:
        return None
    found = _depths_of_points(views_with_points, "features that several images show", FEATURE_MARGIN)
    if found is None or not found.near_share:
        return found
    (closest,) = _rounded(found.near_share * views.cameras.find_distances(find_focus(views.cameras)[0]).min())
    return replace(found, near=min(found.near, closest))


def _reach(views: Views) -> tuple[float, float, float] | None:
    """Of the points that views see, but for the most extreme ones: the least and the greatest depth, and the least
    share of the way to the focus, in [0, 1), 0 where there is no focus before all cameras."""
    seen = [_depth(views.cameras, i, points) for i, points in enumerate(views.points or ())]
    depths = np.concatenate(seen) if seen else np.empty(0)
    ahead = depths > 0
    if not ahead.any():
        return None
    low, high = np.percentile(depths[ahead], POINT_PERCENTILES)
    focus, focus_depth = find_focus(views.cameras)
    if not (focus_depth > 0).all():
        return low, high, 0.0
    shares = depths / np.repeat(views.cameras.find_distances(focus), [len(points) for points in seen])
    return low, high, min(float(np.percentile(shares[ahead], POINT_PERCENTILES[0])), 0.99)


def _depths_of_silhouettes(views: Views) -> DepthRange | None:
    """The depths of the visual hull, as far as enough views see it; None where the object leaves most images, which
    see less than all of it."""
    silhouettes = find_silhouettes(views)
    focus, depth = find_focus(views.cameras)
    distance = float(np.median(depth))
    if not show_whole_object(silhouettes) or distance <= 0:
        return None
    cell_size = 2 * distance / HULL_RESOLUTION
    hull = carve(views, silhouettes, Box(focus, distance, cell_size), cell_size)
    if hull is None:
        return None
    lowest, highest = _depths_of_hull(views.cameras, hull)
    reach = np.sqrt(3) / 2 * cell_size  # of a cell around its center
    least = CAMERA_FACTORS[0] * np.where(depth > 0, depth, distance)
    near, far = _rounded(np.maximum(lowest - reach, least).min(), highest.max() + reach)
    return DepthRange(near, far, "the silhouettes") if near < far else None


def _depths_of_hull(cameras: Cameras, hull: Hull) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest depth (n,), in each view, of the centers that it sees of cells that enough views see; infinite
    and minus infinite if it sees none."""
    centers = hull.aabb_min + (np.argwhere(hull.cells) + 0.5) * hull.cell_size
    depths = np.full((len(cameras), len(centers)), np.nan)
    for i in range(len(cameras)):
        coords, depth = (values.numpy() for values in cameras.project(i, torch.from_numpy(centers)))
        size = np.array((int(cameras.height[i]), int(cameras.width[i])))
        in_image = (depth > 0) & ((coords >= 0) & (coords <= size)).all(axis=1)
        depths[i, in_image] = depth[in_image]
    seen = (~np.isnan(depths)).sum(axis=0)
    depths = depths[:, (seen > 0) & (seen >= MIN_SEEN * seen.max())]
    return np.nanmin(depths, axis=1, initial=np.inf), np.nanmax(depths, axis=1, initial=-np.inf)


def _depths_of_cameras(views: Views) -> DepthRange | None:
    """Multiples of the distance between the cameras and what they look at; None if their axes do not meet there, as of
    cameras that turn about one point, or look outward from it."""
    _, depth = find_focus(views.cameras)
    distance = float(np.median(depth))
    position = views.cameras.camera_to_worlds[:, :, 3].numpy()
    moves = np.ptp(position, axis=0).max() > MIN_MOVE * np.abs(position).max()
    if len(views.cameras) < 2 or not moves or (depth > 0).mean() < MIN_AHEAD:
        return None
    near, far = _rounded(*(factor * distance for factor in CAMERA_FACTORS))
    return DepthRange(near, far, "the cameras: 0.3 to 2 times as far as what they look at", NEAR_SHARE)


def _depth(cameras: Cameras, camera: int, points: np.ndarray) -> np.ndarray:
    """(m,) depth of points (m, 3) in one camera."""
    return cameras.project(camera, torch.from_numpy(points))[1].numpy()


def _rounded(*values: float) -> tuple[float, ...]:
    """Four digits of each: what config.json and a flag can repeat."""
    return tuple(float(f"{value:.4g}") for value in values)
