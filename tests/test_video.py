"""Videos: their frames, and what is refused before anything is rendered."""

from __future__ import annotations

import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from edge_se_sampler.engine.video import check_video, write_video
from edge_se_sampler.errors import InputError

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
