"""Videos: the spiral of their cameras, their frames, and what is refused before anything is rendered."""

from __future__ import annotations

import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.engine.video import check_video, spiral, write_video
from edge_se_sampler.errors import InputError

POSES = np.stack([np.eye(4)] * 3)
POSES[:, :3, 3] = [[0, 3, 4], [0, 0, 4], [0, 0, 4]]  # 5, 4 and 4 units away from the origin
LIKE = Cameras.of(POSES, fx=[7, 9, 11], fy=[8, 10, 12], cx=[3, 4, 5], cy=[4, 5, 6], width=[6, 5, 5], height=[8, 4, 4])
FRAMES = [np.full((10, 15, 3), i / 6) for i in range(7)]


def test_a_gif_has_every_frame_in_order(tmp_path: Path) -> None:
    path = tmp_path / "turn.gif"
    write_video(path, FRAMES, 20)
    frames = iio.imread(path, index=None)
    assert frames.shape == (7, 10, 15, 3)
    np.testing.assert_allclose(frames.mean(axis=(1, 2, 3)) / 255, np.arange(7) / 6, atol=0.02)
    assert iio.immeta(path)["duration"] == 50  # milliseconds
    assert iio.immeta(path)["loop"] == 0  # for ever
    assert [file.name for file in tmp_path.iterdir()] == ["turn.gif"]


def test_an_mp4_has_every_frame(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "turn.mp4"
    check_video(path, 20)
    write_video(path, [np.full((32, 33, 3), i / 6) for i in range(7)], 10)  # the codec takes even sides alone
    frames = iio.imread(path, plugin="FFMPEG")
    assert frames.shape == (7, 32, 32, 3)
    np.testing.assert_allclose(frames.mean(axis=(1, 2, 3)) / 255, np.arange(7) / 6, atol=0.05)
    assert [file.name for file in tmp_path.iterdir()] == ["turn.mp4"]


def test_without_the_video_extra_an_mp4_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(InputError, match=r"edge-se-sampler\[video\]"):
        check_video(tmp_path / "turn.mp4", 20)
    check_video(tmp_path / "turn.GIF", 20)  # which needs none


def test_a_gif_rounds_the_duration_of_frames_to_hundredths_of_a_second(tmp_path: Path) -> None:
    for rate, milliseconds in ((30, 30), (45, 20), (24, 40), (15, 70)):
        write_video(tmp_path / "turn.gif", FRAMES, rate)
        assert iio.immeta(tmp_path / "turn.gif")["duration"] == milliseconds


@pytest.mark.parametrize("name", ["turn.avi", "turn", "turn.gif.png"])
def test_other_endings_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"must end in \.gif or \.mp4"):
        check_video(tmp_path / name, 20)


@pytest.mark.parametrize("name", ["nowhere/turn.gif", "nowhere/turn.mp4"])
def test_a_folder_that_is_not_there_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="no such folder"):
        check_video(tmp_path / name, 20)


def test_a_video_that_cannot_be_written_is_an_input_error(tmp_path: Path) -> None:
    (tmp_path / "turn.gif").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        write_video(tmp_path / "turn.gif", FRAMES, 10)


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
