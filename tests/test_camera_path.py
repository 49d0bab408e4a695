"""The spiral on which a trained scene is shown."""

from __future__ import annotations

import numpy as np
import torch

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.engine.camera_path import spiral

POSES = np.stack([np.eye(4)] * 3)
POSES[:, :3, 3] = [[0, 3, 4], [0, 0, 4], [0, 0, 4]]  # 5, 4 and 4 units away from the origin
LIKE = Cameras.of(POSES, fx=[7, 9, 11], fy=[8, 10, 12], cx=[3, 4, 5], cy=[4, 5, 6], width=[6, 5, 5], height=[8, 4, 4])


def test_poses_are_rigid_and_upright() -> None:
    poses = spiral(LIKE, 17).camera_to_worlds.double().numpy()
    assert poses.shape == (17, 3, 4)
    for pose in poses:
        rotation = pose[:, :3]
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-6)
        assert np.linalg.det(rotation) > 0
        assert abs(rotation[2, 0]) < 1e-6  # right is level
        assert rotation[2, 1] > 0  # up is up


def test_every_view_looks_at_the_origin_from_the_median_distance() -> None:
    cameras = spiral(LIKE, 12)
    eyes = cameras.camera_to_worlds[:, :, 3]
    np.testing.assert_allclose(eyes.norm(dim=1), 4, rtol=1e-6)
    middle = torch.stack((cameras.cy[:, 0], cameras.cx[:, 0]), dim=1)
    rays = cameras.generate_rays(torch.arange(12)[:, None], middle)
    np.testing.assert_allclose(rays.origins + 4 * rays.directions, np.zeros((12, 3)), atol=1e-5)


def test_azimuth_grows_evenly_and_elevation_stays_between_15_and_45_degrees() -> None:
    eyes = spiral(LIKE, 360).camera_to_worlds[:, :, 3].double().numpy()
    azimuth = np.unwrap(np.arctan2(eyes[:, 1], eyes[:, 0]))
    np.testing.assert_allclose(np.diff(azimuth), 2 * np.pi / 360, atol=1e-5)
    elevation = np.degrees(np.arcsin(eyes[:, 2] / 4))
    np.testing.assert_allclose((elevation.min(), elevation.max()), (15, 45), atol=0.01)


def test_intrinsics_and_size_are_the_first_cameras() -> None:
    cameras = spiral(LIKE, 5)
    assert len(cameras) == 5
    for key in ("fx", "fy", "cx", "cy", "width", "height"):
        assert getattr(cameras, key).tolist() == [getattr(LIKE, key)[0].tolist()] * 5
    assert len(cameras.image_rays(4)) == 8 * 6
