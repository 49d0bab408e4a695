"""Pixels become rays: against a second pinhole camera written in numpy, and against the synthetic scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.data.cameras import Cameras, RayBundle
from edge_se_sampler.data.synthetic.catalogue import synthetic_scene
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.data.synthetic.visibility import NOTHING, nearest_hits
from edge_se_sampler.models.rendering import stratified

SIZES = [(5, 7), (4, 6), (3, 8)]  # rows, columns


def some_cameras(seed: int = 0) -> Cameras:
    """Three that differ in everything: fx is not fy, and the principal point is not in the middle."""
    rng = np.random.default_rng(seed)
    poses = []
    for _ in SIZES:
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        rotation *= np.sign(np.linalg.det(rotation))
        poses.append(np.concatenate((rotation, rng.normal(size=(3, 1))), axis=1))
    return Cameras(
        camera_to_worlds=torch.tensor(np.array(poses)),
        fx=torch.tensor([[9.0], [7.5], [20.0]]).double(),
        fy=torch.tensor([[11.0], [7.0], [15.0]]).double(),
        cx=torch.tensor([[2.0], [9.5], [-1.0]]).double(),
        cy=torch.tensor([[3.25], [-2.0], [1.5]]).double(),
        width=torch.tensor([[columns] for _, columns in SIZES]),
        height=torch.tensor([[rows] for rows, _ in SIZES]),
    )


def project(cameras: Cameras, camera: int, points: np.ndarray) -> np.ndarray:
    """World points (n, 3) -> y, x in pixels and depth along the optical axis, (n, 3)."""
    pose = cameras.camera_to_worlds[camera].double().numpy()
    right, up, back = ((points - pose[:, 3]) @ pose[:, :3]).T
    fx, fy, cx, cy = (float(value[camera]) for value in (cameras.fx, cameras.fy, cameras.cx, cameras.cy))
    return np.stack((cy - fy * up / -back, cx + fx * right / -back, -back), axis=1)


def along(rays: RayBundle, distance: float) -> np.ndarray:
    return (rays.origins + distance * rays.directions).double().numpy()


def test_points_on_a_pixels_ray_project_to_its_center() -> None:
    cameras = some_cameras()
    for camera, (rows, columns) in enumerate(SIZES):
        for row in range(rows):
            for column in range(columns):
                rays = cameras.pixel_rays(torch.tensor([[camera, row, column]]))
                for distance in (0.5, 3.0, 40.0):
                    seen = project(cameras, camera, along(rays, distance))[0]
                    np.testing.assert_allclose(seen[:2], (row + 0.5, column + 0.5), atol=1e-9)
                    assert seen[2] > 0  # in front of the camera


def test_the_ray_of_a_projected_point_passes_through_it() -> None:
    cameras = some_cameras()
    rng = np.random.default_rng(1)
    for camera in range(3):
        pose = cameras.camera_to_worlds[camera].numpy()
        points = pose[:, 3] + rng.uniform((-2, -2, -6), (2, 2, -1), (50, 3)) @ pose[:, :3].T
        coords = torch.tensor(project(cameras, camera, points)[:, :2])
        rays = cameras.generate_rays(torch.full((50, 1), camera), coords)
        distance = np.linalg.norm(points - rays.origins.numpy(), axis=1, keepdims=True)
        np.testing.assert_allclose(rays.origins + torch.tensor(distance) * rays.directions, points, atol=1e-9)


def test_directions_norm_turns_depth_into_distance_along_the_ray() -> None:
    """A sample at distance depth * directions_norm lies at that depth: near and far are planes, not spheres."""
    cameras = some_cameras()
    for camera in range(3):
        rays = cameras.image_rays(camera)
        np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=1), 1, rtol=1e-12)
        norm = rays.metadata["directions_norm"]
        assert norm.shape == (len(rays), 1)
        t = stratified(2 * norm, 6 * norm, 5, None)
        for sample, depth in ((0, 2), (2, 4), (4, 6)):
            points = (rays.origins + t[:, sample : sample + 1] * rays.directions).numpy()
            np.testing.assert_allclose(project(cameras, camera, points)[:, 2], depth, rtol=1e-9)


def test_a_pixels_quarters_are_where_opencv_sees_them() -> None:
    quarters = np.array([[0.25, 0.25], [0.25, 0.75], [0.75, 0.25], [0.75, 0.75]])
    cameras = some_cameras()
    for camera, (rows, columns) in enumerate(SIZES):
        rays = cameras.image_rays(camera)
        directions, norm = rays.split_pixels()
        np.testing.assert_allclose(directions.norm(dim=2), 1, rtol=1e-12)
        points = (rays.origins[:, None] + 3 * norm * directions).reshape(-1, 3)
        seen = project(cameras, camera, points.numpy())
        corner = np.stack(np.divmod(np.arange(rows * columns), columns), axis=1)
        np.testing.assert_allclose(seen[:, :2], (corner[:, None] + quarters).reshape(-1, 2), atol=1e-9)
        np.testing.assert_allclose(seen[:, 2], 3, rtol=1e-9)


def test_projection_is_the_inverse_of_rays() -> None:
    cameras, rng = some_cameras(), np.random.default_rng(1)
    for camera in range(3):
        points = rng.normal(size=(50, 3))
        coords, depth = cameras.project(camera, torch.from_numpy(points))
        np.testing.assert_allclose(torch.cat((coords, depth[:, None]), dim=1), project(cameras, camera, points))
        ahead = points[depth > 0]
        rays = cameras.generate_rays(torch.full((len(ahead), 1), camera), coords[depth > 0])
        along_ray = depth[depth > 0, None] * rays.metadata["directions_norm"]
        np.testing.assert_allclose(rays.origins + along_ray * rays.directions, ahead, atol=1e-9)


def test_indexing_keeps_every_field_and_the_order() -> None:
    cameras = some_cameras()
    for chosen in (cameras[[2, 0]], cameras[[2, 1, 0]][::2]):
        assert len(chosen) == 2
        for key, values in vars(cameras).items():
            torch.testing.assert_close(getattr(chosen, key), values[[2, 0]])


def test_intrinsics_are_given_for_each_camera_or_as_one_number_for_all() -> None:
    poses = np.random.default_rng(0).normal(size=(3, 4, 4))
    cameras = Cameras.of(poses, fx=[10, 12, 14], fy=11, cx=2.5, cy=(1, 2, 3), width=6, height=[4, 5, 6])
    np.testing.assert_array_equal(cameras.camera_to_worlds, poses[:, :3])
    assert (cameras.fx.tolist(), cameras.fy.tolist()) == ([[10], [12], [14]], [[11]] * 3)
    assert (cameras.cx.tolist(), cameras.cy.tolist()) == ([[2.5]] * 3, [[1], [2], [3]])
    assert (cameras.width.tolist(), cameras.height.tolist()) == ([[6]] * 3, [[4], [5], [6]])
    assert (cameras.fx.dtype, cameras.width.dtype) == (torch.float64, torch.int64)


def test_conversion_leaves_sizes_integers() -> None:
    cameras = some_cameras().to("cpu", torch.float32)
    assert {value.dtype for value in vars(cameras).values()} == {torch.float32, torch.int64}


def test_an_image_is_row_major() -> None:
    cameras = some_cameras()
    for camera, (rows, columns) in enumerate(SIZES):
        rays = cameras.image_rays(camera)
        assert len(rays) == rows * columns
        assert rays.camera_indices.tolist() == [[camera]] * len(rays)
        seen = project(cameras, camera, along(rays, 2.0))[:, :2].reshape(rows, columns, 2)
        np.testing.assert_allclose(seen[..., 0], np.arange(rows)[:, None].repeat(columns, 1) + 0.5, atol=1e-9)
        np.testing.assert_allclose(seen[..., 1], np.arange(columns)[None].repeat(rows, 0) + 0.5, atol=1e-9)


def test_a_slice_of_rays_is_those_rays() -> None:
    cameras = some_cameras()
    indices = torch.tensor([[2, 1, 7], [0, 4, 0], [1, 0, 5], [0, 0, 0]])
    every = cameras.pixel_rays(indices)
    part, alone = every[1:3], cameras.pixel_rays(indices[1:3])
    assert len(part) == 2
    assert part.camera_indices[:, 0].tolist() == [0, 1]
    for one, other in ((part.origins, alone.origins), (part.directions, alone.directions)):
        torch.testing.assert_close(one, other)
    torch.testing.assert_close(part.metadata["directions_norm"], alone.metadata["directions_norm"])


@pytest.mark.parametrize("pixels", [slice(None), slice(3, 11), slice(5, 5)])
def test_an_images_rays_are_those_of_its_pixels(pixels: slice) -> None:
    for camera, (rows, columns) in enumerate(SIZES):
        indices = torch.cartesian_prod(torch.tensor([camera]), torch.arange(rows), torch.arange(columns))[pixels]
        found, expected = some_cameras().image_rays(camera, pixels), some_cameras().pixel_rays(indices)
        assert len(found) == len(indices)
        for name, value in {**vars(expected), **expected.metadata}.items():
            if name != "metadata":
                torch.testing.assert_close({**vars(found), **found.metadata}[name], value)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same three views: centered at 24 x 24, and with the object 8 right of and 4 above the middle of 40 x 40."""
    out = tmp_path_factory.mktemp("placed")
    counts: Any = {"num_train": 3, "num_val": 0, "num_test": 0}
    return {
        "centered": make_scenes(out / "c", ["bricks"], size=24, **counts)[0],
        "shifted": make_scenes(out / "s", ["bricks"], size=40, placement="shifted", offset=(0.2, -0.1), **counts)[0],
        "rotated": make_scenes(out / "r", ["bricks"], size=40, placement="rotated", offset=(0.2, -0.1), **counts)[0],
    }


def test_a_shifted_scene_has_the_rays_of_the_centered_one(folders: dict[str, Path]) -> None:
    """Its 24 x 24 pixels stand elsewhere on the larger image, with the same colors and rays."""
    centered, shifted = (read_blender(folders[name], "train") for name in ("centered", "shifted"))
    top, left = 20 - 12 - 4, 20 - 12 + 8
    for view in range(3):
        pasted = shifted.images[view][top : top + 24, left : left + 24]
        np.testing.assert_array_equal(pasted, centered.images[view])
        small = centered.cameras.image_rays(view)
        large = shifted.cameras.image_rays(view)
        for name in ("origins", "directions"):
            inside = getattr(large, name).reshape(40, 40, 3)[top : top + 24, left : left + 24]
            torch.testing.assert_close(inside, getattr(small, name).reshape(24, 24, 3), rtol=0, atol=2e-6)


@pytest.mark.parametrize("placement", ["centered", "shifted", "rotated"])
def test_rays_hit_the_scene_where_its_pictures_show_it(folders: dict[str, Path], placement: str) -> None:
    """A pixel's alpha is the fraction of 16 rays that hit; the ray of its center must agree where all or none do."""
    views = read_blender(folders[placement], "train")
    scene = synthetic_scene("bricks")
    for view in range(3):
        rays = views.cameras.image_rays(view)
        _, met = nearest_hits(scene, rays.origins.T.double().numpy(), rays.directions.T.double().numpy())
        alpha = views.images[view][..., 3].ravel()
        assert (alpha == 255).sum() > 50
        assert ((met != NOTHING)[alpha == 255]).mean() > 0.99  # thin gaps between the 16
        assert ((met == NOTHING)[alpha == 0]).mean() > 0.99
        one_off = np.roll(views.images[view][..., 3], 1, axis=1).ravel()
        assert ((met != NOTHING)[one_off == 255]).mean() < 0.99  # a camera one pixel off would be found out
