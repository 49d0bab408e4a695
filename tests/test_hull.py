"""What alpha says of where a scene can be: nothing that is seen is carved away, whatever a mask has wrong."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from tiny import grid_of

from edge_se_sampler.data.cameras import Cameras, RayBundle
from edge_se_sampler.data.synthetic.cameras import poses
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.pipeline import analyze_views
from edge_se_sampler.errors import InputError
from edge_se_sampler.models.config import LeanModelConfig, NeRFModelConfig
from edge_se_sampler.occupancy import hull as hull_module
from edge_se_sampler.occupancy.hull import (
    BEHIND,
    IN_FRONT,
    STRADDLING,
    Box,
    Hull,
    carve,
    find_box,
    find_hit_pixels,
    find_silhouettes,
    project_cells,
)  # fmt: skip
from edge_se_sampler.occupancy.scene_analysis import MAX_INITIAL_CELLS

VIEWS = 12


def rods() -> np.ndarray:
    """(m, 3) points of thin rods, one of them slanting, and a ball: dense enough to leave no hole at 800 x 800."""
    along = np.linspace(-1, 1, 6000)[:, None]
    rod = along * (0.9, 0.3, 0.6)
    upright = along * (0, 0, 0.8) + (0.3, -0.4, 0)
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(40_000, 3))
    ball *= 0.25 / np.linalg.norm(ball, axis=1, keepdims=True)
    return np.concatenate((rod, upright, ball + np.array([-0.3, 0.4, 0.1])))


def views_of(points: np.ndarray, size: int = 100, count: int = VIEWS, focal: float = 1.37) -> Views:
    """Views whose alpha is 255 in every pixel that a point falls into, and 0 elsewhere."""
    matrices = poses("train", count)
    images = []
    for pose in matrices:
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        column, row = (
            np.floor(c).astype(int) for c in (-x / z * focal * size + size / 2, y / z * focal * size + size / 2)
        )
        image = np.zeros((size, size, 4), dtype=np.uint8)
        inside = (row >= 0) & (row < size) & (column >= 0) & (column < size)
        image[row[inside], column[inside]] = 255
        images.append(image)
    return Views(
        tuple(map(str, range(count))),
        tuple(images),
        None,
        Cameras.of(matrices, fx=focal * size, fy=focal * size, cx=size / 2, cy=size / 2, width=size, height=size),
    )


def with_cameras(views: Views, **changes: torch.Tensor) -> Views:
    """The views with other values of their cameras' fields."""
    return replace(views, cameras=replace(views.cameras, **changes))


def with_masks(views: Views, change: Callable[[int, np.ndarray], np.ndarray]) -> Views:
    """The views with other alpha."""
    images = []
    for i, image in enumerate(views.images):
        other = image.copy()
        other[..., 3] = change(i, image[..., 3])
        images.append(other)
    return replace(views, images=tuple(images))


def hull_of(views: Views, voxel_size_px: float = 1.6) -> Hull:
    box = find_box(views, 2, 6)
    hull = carve(views, find_silhouettes(views), box, voxel_size_px * box.pixel_footprint)
    assert hull is not None
    return hull


def meets(rays: RayBundle, hull: Hull, step: float) -> np.ndarray:
    """(n,) bool: whether one of a ray's points, that many sides of a cell apart, is in a cell."""
    grid, t = grid_of(hull), torch.arange(2, 6, step * hull.cell_size)
    points = rays.origins[:, None] + t[:, None] * rays.directions[:, None]
    return grid.contains(points.reshape(-1, 3)).reshape(points.shape[:2]).any(dim=1).numpy()


def missed(views: Views, hull: Hull) -> int:
    """Foreground pixels whose ray meets no cell of the hull."""
    cameras = views.cameras.to(dtype=torch.float32)
    pixels = np.concatenate(
        [np.insert(np.argwhere(image[..., 3] > 0), 0, i, axis=1) for i, image in enumerate(views.images)]
    )
    chunks = torch.from_numpy(pixels).split(2048)
    return sum(int((~meets(cameras.pixel_rays(chunk), hull, 1 / 8)).sum()) for chunk in chunks)


# -- the box, and what a cell covers


def test_the_box_is_where_the_cameras_look_and_as_large_as_their_depths() -> None:
    views = views_of(rods())
    moved = with_cameras(
        views,
        camera_to_worlds=views.cameras.camera_to_worlds + torch.tensor([[0, 0, 0, 5], [0, 0, 0, -2], [0, 0, 0, 1]]),
    )
    box = find_box(moved, 2.5, 6)
    distance = np.linalg.norm(views.cameras.camera_to_worlds[:, :, 3], axis=1)
    np.testing.assert_allclose(box.center, (5, -2, 1), atol=1e-9)
    assert box.half_extent == pytest.approx(max((6 - distance).max(), (distance - 2.5).max()))
    assert box.pixel_footprint == pytest.approx(np.median(distance) / 137)


@pytest.mark.parametrize("apart", [0.02, -0.005])
def test_cameras_side_by_side_look_at_what_is_before_them(apart: float) -> None:
    """Axes that run a little apart meet behind the cameras, or far beyond what is sampled: no center to use."""
    views = views_of(rods(), count=5)
    sine = np.sin(np.linspace(-apart, apart, 5))
    forward = np.stack((sine, np.zeros(5), -np.sqrt(1 - sine**2)), axis=1)
    right = np.cross(forward, (0, 1, 0))
    position = np.stack((np.linspace(-0.5, 0.5, 5), np.zeros(5), np.full(5, 3.0)), axis=1)
    poses = np.stack((right, np.broadcast_to((0.0, 1.0, 0.0), right.shape), -forward, position), axis=2)
    side = with_cameras(views, camera_to_worlds=torch.from_numpy(poses))
    box = find_box(side, 2, 6)
    np.testing.assert_allclose(box.center, (0, 0, -1), atol=0.01)  # 4 ahead of them
    assert box.half_extent == pytest.approx(2, abs=0.1)
    assert box.pixel_footprint == pytest.approx(4 / 137, rel=0.01)


def test_a_rectangle_holds_all_of_its_cell() -> None:
    views, rng = views_of(rods()), np.random.default_rng(1)
    centers, side = rng.uniform(-1.5, 1.5, (500, 3)), 0.4
    for number in range(VIEWS):
        low, high, side_of_plane = project_cells(views.cameras, number, centers, side)
        assert (side_of_plane == IN_FRONT).all()
        pose = views.cameras.camera_to_worlds[number].numpy()
        worst = []
        for corner in np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3):
            x, y, z = ((centers + corner * side / 2 - pose[:, 3]) @ pose[:, :3]).T
            pixel = np.stack((-x / z, y / z), axis=1) * 137 + 50
            assert (pixel >= low.T - 1e-4).all()
            assert (pixel <= high.T + 1e-4).all()
            worst.append(np.abs(pixel.T - (low + high) / 2) / (high - low))
        assert np.median(np.max(worst, axis=0)) > 0.3  # and is not much larger: 0.5 would touch it


def test_a_cell_around_a_camera_straddles_its_plane() -> None:
    views = views_of(rods())
    pose = views.cameras.camera_to_worlds[0].numpy()
    centers = pose[:, 3] - np.array([[0.0], [1.0], [-1.0]]) * pose[:, 2]
    assert project_cells(views.cameras, 0, centers, 0.5)[2].tolist() == [STRADDLING, IN_FRONT, BEHIND]


# -- nothing that is seen goes


@pytest.mark.parametrize("size", [100, pytest.param(800, marks=pytest.mark.slow)])
def test_no_foreground_pixel_loses_its_cells(size: int) -> None:
    views = views_of(rods(), size, 12 if size == 100 else 4)
    hull = hull_of(views, 1.6 if size == 100 else 6)
    assert missed(views, hull) == 0
    assert hull.cells.sum() * hull.cell_size**3 < (0.6 if size == 100 else 0.4)  # of 64: rods, a ball, and a margin


def eroded(_: int, alpha: np.ndarray) -> np.ndarray:
    # a rod of one pixel would be gone wholly: what is thick loses its outermost pixel
    thick = cv2.erode(alpha, np.ones((3, 3), np.uint8))
    thin = cv2.subtract(alpha, cv2.dilate(thick, np.ones((3, 3), np.uint8)))
    return cv2.max(thick, thin)


def noisy(i: int, alpha: np.ndarray) -> np.ndarray:
    flipped = np.random.default_rng(i).random(alpha.shape) < 0.02
    return np.where(flipped, 255 - alpha, alpha)


def shifted(i: int, alpha: np.ndarray) -> np.ndarray:
    return np.roll(alpha, ((-1) ** i, (-1) ** (i // 2)), axis=(0, 1))


def empty_in_one(i: int, alpha: np.ndarray) -> np.ndarray:
    return alpha * (i != 3)


def half_in_one(i: int, alpha: np.ndarray) -> np.ndarray:
    return alpha * (np.arange(len(alpha)) < 50) if i == 3 else alpha


DAMAGES: list[Callable[[int, np.ndarray], np.ndarray]] = [eroded, noisy, shifted, empty_in_one, half_in_one]


@pytest.mark.parametrize("damage", DAMAGES)
def test_wrong_masks_carve_nothing_away(damage: Callable[[int, np.ndarray], np.ndarray]) -> None:
    views = views_of(rods())
    wrong = with_masks(views, damage)
    assert any((one != other).any() for one, other in zip(views.images, wrong.images, strict=True))
    assert missed(views, hull_of(wrong)) == 0


@pytest.mark.parametrize(("damage", "name", "value"), [(shifted, "MARGIN", 0), (half_in_one, "MIN_EMPTY_VIEWS", 1)])
def test_without_margin_or_a_second_view_wrong_masks_carve(
    damage: Callable[[int, np.ndarray], np.ndarray], name: str, value: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = views_of(rods())
    monkeypatch.setattr(hull_module, name, value)
    assert missed(views, hull_of(with_masks(views, damage))) > 0


@pytest.mark.parametrize("fraction", [0.0, 2.0])
def test_cells_that_are_known_to_be_empty_may_be_dropped(fraction: float, monkeypatch: pytest.MonkeyPatch) -> None:
    views = views_of(rods(), 60)
    expected = hull_of(views)
    monkeypatch.setattr(hull_module, "MIN_CANDIDATES", fraction)  # never, always
    found = hull_of(views)
    np.testing.assert_array_equal(found.cells, expected.cells)
    np.testing.assert_array_equal(found.aabb_min, expected.aabb_min)


def test_hundreds_of_views_carve_as_a_few_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many as a byte cannot count."""
    views = views_of(rods(), 40, 4)
    often = views.subset([*range(4)] * 64)
    monkeypatch.setattr(hull_module, "MIN_CANDIDATES", 0.0)
    monkeypatch.setattr(hull_module, "MIN_EMPTY_VIEWS", 1)
    np.testing.assert_array_equal(hull_of(often).cells, hull_of(views).cells)


def test_what_is_masked_may_be_the_object() -> None:
    """Alpha is 0 where a mask forbids to look: nothing is carved there."""
    views = views_of(rods())
    left = np.arange(100) < 50
    hidden = with_masks(views, lambda _, alpha: alpha * ~left)
    masks = tuple(np.broadcast_to(~left, (100, 100)).copy() for _ in range(VIEWS))
    assert missed(views, hull_of(replace(hidden, masks=masks))) == 0
    assert missed(views, hull_of(hidden)) > 0


def test_what_one_view_alone_sees_it_carves() -> None:
    """Another view looks past half of the box, and knows nothing of what is outside of its image."""
    views = views_of(rods(), count=2)
    views = with_masks(views, lambda i, alpha: np.where((np.arange(100) < 3) & (i == 1), np.uint8(255), alpha))
    views = with_cameras(views, cx=views.cameras.cx + torch.tensor([[0.0], [60.0]]))
    silhouettes, box = find_silhouettes(views), find_box(views, 2, 6)
    assert not silhouettes[1].uncropped
    size = 3 * box.pixel_footprint

    def count_empty(hull: Hull | None) -> int:
        """Cells that only the first view sees, all of them, as background."""
        assert hull is not None
        centers = hull.aabb_min + (np.argwhere(hull.cells) + 0.5) * hull.cell_size
        low, high, _ = project_cells(views.cameras, 0, centers, hull.cell_size)
        *other, side = project_cells(views.cameras, 1, centers, hull.cell_size)
        unseen = (side == hull_module.IN_FRONT) & ((other[1] <= 0) | (other[0] >= 100)).any(axis=0)
        inside = ((low >= 0) & (high <= 100)).all(axis=0)
        return int(np.count_nonzero(inside & unseen & ~silhouettes[0].overlaps(low, high)))

    assert count_empty(carve(views, {}, box, size)) > 1000
    assert count_empty(carve(views, silhouettes, box, size)) == 0


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_cells_are_as_small_as_their_number_allows(factor: int) -> None:
    views = views_of(rods())
    silhouettes, box = find_silhouettes(views), find_box(views, 2, 6)
    size = 1.6 * box.pixel_footprint
    expected = carve(views, silhouettes, box, factor * size)
    assert expected is not None
    found = carve(views, silhouettes, box, size, max_cells=int(expected.cells.sum()))
    assert found is not None
    assert found.cell_size == pytest.approx(factor * size)
    np.testing.assert_array_equal(found.cells, expected.cells)
    np.testing.assert_allclose(found.aabb_min, expected.aabb_min)


def test_what_an_image_cuts_off_is_kept() -> None:
    """A long rod leaves every image: the views know nothing of what lies outside."""
    points = np.linspace(-1, 1, 8000)[:, None] * (0, 0, 1.9)
    views = views_of(points, focal=2.2)
    assert not any(shape.uncropped for shape in find_silhouettes(views).values())
    hull = hull_of(views)
    kept = grid_of(hull).contains(torch.from_numpy(points)).numpy()
    seen = np.zeros(len(points), dtype=bool)
    for number in range(VIEWS):
        low, high, _ = project_cells(views.cameras, number, points, 1e-6)
        seen |= ((low > 0) & (high < 100)).all(axis=0)
    assert 0.5 < seen.mean() < 1
    assert kept[seen].all()
    assert not analyze_views(views, LeanModelConfig()).grid().is_carved_close
    inside = views_of(points * 0.3, focal=2.2)
    assert all(shape.uncropped for shape in find_silhouettes(inside).values())
    assert analyze_views(inside, LeanModelConfig()).grid().is_carved_close


# -- without alpha, and how much there is


@pytest.mark.parametrize("opaque", [True, False])
def test_without_a_background_all_that_views_see_is_kept(opaque: bool) -> None:
    views = views_of(rods())
    images = tuple(image[..., :3] if opaque else np.full_like(image, 255) for image in views.images)
    plain = replace(views, images=images)
    analysis = analyze_views(plain, LeanModelConfig())
    assert analysis.num_silhouettes == 0
    middle = analysis.hull.aabb_min + np.array(analysis.hull.cells.shape) * analysis.hull.cell_size / 2
    np.testing.assert_allclose(middle, 0, atol=analysis.hull.cell_size)
    rng = np.random.default_rng(0)
    assert bool(analysis.grid().contains(torch.from_numpy(rng.uniform(-1, 1, (1000, 3)))).all())
    assert all(hit.all() for hit in analysis.hit_pixels)
    assert analysis.hull.cells.sum() <= MAX_INITIAL_CELLS


def test_a_cell_behind_a_camera_is_not_seen_by_it() -> None:
    """One camera at the side of a box far larger than its depths: half of the cells lie behind it."""
    views = views_of(rods(), count=1)
    pose = views.cameras.camera_to_worlds[0].numpy()
    hull = carve(views, {}, Box(pose[:, 3], 1.0, 0.1), 0.1)
    assert hull is not None
    centers = hull.aabb_min + (np.argwhere(hull.cells) + 0.5) * hull.cell_size
    depth = -(centers - pose[:, 3]) @ pose[:, 2]
    assert depth.min() > -0.1 * np.sqrt(3)
    assert depth.max() > 1


def test_cameras_that_see_nothing_are_refused_in_one_line() -> None:
    views = views_of(rods())
    aside = with_cameras(views, cx=views.cameras.cx + 4000, cy=views.cameras.cy + 4000)
    with pytest.raises(InputError, match=r"no training view sees anything.*principal points"):
        analyze_views(aside, LeanModelConfig())


def test_a_part_that_is_off_does_not_carve() -> None:
    views = views_of(rods())
    carved, whole = (analyze_views(views, LeanModelConfig(cull_by_alpha=on)) for on in (True, False))
    assert carved.num_silhouettes == VIEWS
    assert whole.num_silhouettes == 0
    assert carved.hull.cells.sum() * carved.hull.cell_size**3 < 0.02 * whole.hull.cells.sum() * whole.hull.cell_size**3
    assert analyze_views(views, NeRFModelConfig(empty_space_skipping=True)).num_silhouettes == VIEWS
    assert carved.grid().is_carved_close
    assert not whole.grid().is_carved_close


def test_the_grid_knows_what_views_look_at_and_from_how_far() -> None:
    views = views_of(rods())
    analysis = analyze_views(views, LeanModelConfig(near_share=0.3))
    *point, share, farthest = analysis.grid().focus.tolist()
    np.testing.assert_allclose(point, analysis.box.center, atol=1e-9)
    positions = views.cameras.camera_to_worlds[:, :, 3].numpy()
    assert share == 0.3
    assert farthest == pytest.approx(np.linalg.norm(positions - point, axis=1).max())
    assert analyze_views(views, LeanModelConfig()).grid().focus[3] == 0


@pytest.mark.parametrize("apart", [0, 60])
def test_masks_that_do_not_agree_carve_nothing(apart: int, capfd: pytest.CaptureFixture[str]) -> None:
    """Another object in every view, or each view's masks somewhere else: nothing, or little, is left of a hull."""
    views = views_of(rods(), 200)

    def moved(i: int, alpha: np.ndarray) -> np.ndarray:
        return np.roll(alpha, (apart * (-1) ** i, apart * (-1) ** (i // 2)), axis=(0, 1))

    analysis = analyze_views(with_masks(views, moved), LeanModelConfig())
    assert (analysis.num_silhouettes == 0) == bool(apart)
    assert capfd.readouterr().err.count("do not agree") == bool(apart)
    assert missed(views, analysis.hull) == 0


def test_training_begins_with_cells_that_are_subdivided_to_voxel_size_px() -> None:
    views = views_of(rods())
    carved = analyze_views(views, LeanModelConfig(voxel_size_px=0.4))
    assert carved.max_level == 2
    assert carved.hull.cell_size == pytest.approx(4 * 0.4 * carved.box.pixel_footprint)
    many = analyze_views(views_of(rods(), 800, 4), LeanModelConfig(voxel_size_px=0.1))
    assert many.max_level > 2
    assert many.hull.cell_size == pytest.approx(2**many.max_level * 0.1 * many.box.pixel_footprint)
    assert 0.05 * MAX_INITIAL_CELLS < many.hull.cells.sum() <= MAX_INITIAL_CELLS
    uncarved = analyze_views(views, LeanModelConfig(voxel_size_px=0.4, cull_by_alpha=False))
    assert uncarved.max_level > carved.max_level
    assert MAX_INITIAL_CELLS / 8 < uncarved.hull.cells.sum() <= MAX_INITIAL_CELLS


# -- pixels whose rays hit the hull


def test_every_pixel_whose_ray_hits_the_hull_is_found_and_few_others() -> None:
    views = views_of(rods())
    hull = hull_of(views)
    cameras = views.cameras.to(dtype=torch.float32)
    needless = 0
    for number, hit in enumerate(find_hit_pixels(views, hull)):
        rays = cameras.image_rays(number)
        met = np.concatenate([meets(rays[k : k + 2048], hull, 1 / 4) for k in range(0, len(rays), 2048)])
        assert not (met & ~hit.reshape(-1)).any()
        needless += (hit.reshape(-1) & ~met).mean()
    assert 0 < needless / VIEWS < 0.1


def test_cells_behind_the_camera_or_outside_its_image_hit_no_pixel() -> None:
    """A cell just before the camera's plane, far to the side, projects to a rectangle of thousands of pixels."""
    views = views_of(rods())
    pose = views.cameras.camera_to_worlds[0].numpy()
    aside = pose[:, 3] + 30 * pose[:, 0] - 0.2 * pose[:, 2]
    behind = pose[:, 3] + pose[:, 2]
    for center in (aside, behind):
        hull = Hull(center - 0.05, 0.1, np.ones((1, 1, 1), dtype=bool))
        assert not find_hit_pixels(views, hull)[0].any()
    close = Hull(pose[:, 3] - 0.08 * pose[:, 2] - 0.05, 0.1, np.ones((1, 1, 1), dtype=bool))
    assert find_hit_pixels(views, close)[0].all()


def test_all_pixels_of_a_camera_inside_the_hull_are_found() -> None:
    views = views_of(rods())
    around = Hull(np.full(3, -6.0), 12.0, np.ones((1, 1, 1), dtype=bool))
    assert all(hit.all() for hit in find_hit_pixels(views, around))


def test_cells_with_their_center_on_a_cameras_plane_have_no_rectangle() -> None:
    views = views_of(rods(), size=33)
    pose = np.eye(4)[None, :3]
    cameras = Cameras.of(pose, fx=33, fy=33, cx=16.5, cy=16.5, width=33, height=33)
    centers = np.array([(0.0, 0, 0), (1, 2, 0), (0, 0, -4), (0, 0, 4)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        low, high, side = project_cells(cameras, 0, centers, 0.5)
        find_silhouettes(views)[0].overlaps(low, high)
    assert side.tolist() == [STRADDLING, STRADDLING, IN_FRONT, BEHIND]
    assert np.isfinite(low).all()
    assert np.isfinite(high).all()


def test_only_pixels_that_are_trained_on_count_as_showing_something() -> None:
    views = views_of(rods())
    count = [int((image[..., 3] > 0).sum()) for image in views.images]

    def shown(views: Views) -> int:
        return analyze_views(views, LeanModelConfig(size="paper")).num_pixels

    masks = tuple(np.arange(100)[:, None] < np.full(100, 50) for _ in views.images)
    half = sum(int((image[:50, :, 3] > 0).sum()) for image in views.images)
    empty = tuple(image * np.uint8(i > 4) for i, image in enumerate(views.images))
    assert shown(views) == sum(count)
    assert shown(replace(views, masks=masks)) == half
    assert shown(replace(views, images=empty)) == sum(count[5:])
    opaque = tuple(image[..., :3] for image in views.images)
    assert shown(replace(views, images=opaque, masks=masks)) == 100 * 50 * len(masks)
