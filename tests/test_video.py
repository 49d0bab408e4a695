"""Videos: their frames, and what is refused before anything is rendered."""

from __future__ import annotations

import os
import sys
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.engine import video
from edge_se_sampler.engine.video import check_video, write_video
from edge_se_sampler.errors import InputError

RGB = ("rgb",)


def shades(height: int = 10, width: int = 15) -> list[np.ndarray]:
    """Seven, from black to white."""
    return [np.full((height, width, 3), round(255 * i / 6), dtype=np.uint8) for i in range(7)]


def test_a_gif_has_every_frame_in_order(tmp_path: Path) -> None:
    path = tmp_path / "turn.gif"
    write_video(path, shades(), 20)
    frames = iio.imread(path, index=None)
    assert frames.shape == (7, 10, 15, 3)
    np.testing.assert_allclose(frames.mean(axis=(1, 2, 3)) / 255, np.arange(7) / 6, atol=0.02)
    assert iio.immeta(path)["duration"] == 50  # milliseconds
    assert iio.immeta(path)["loop"] == 0  # for ever
    assert [file.name for file in tmp_path.iterdir()] == ["turn.gif"]


def test_an_mp4_has_every_frame(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "turn.mp4"
    check_video(path, RGB, 20)
    write_video(path, shades(32, 33), 10)  # the codec takes even sides alone
    frames = iio.imread(path, plugin="FFMPEG")
    assert frames.shape == (7, 32, 32, 3)
    np.testing.assert_allclose(frames.mean(axis=(1, 2, 3)) / 255, np.arange(7) / 6, atol=0.05)
    assert [file.name for file in tmp_path.iterdir()] == ["turn.mp4"]


def test_an_mp4_that_ffmpeg_has_not_finished_replaces_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where its disk is full: it says so to nobody once it has all frames."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    write_frames = ffmpeg.write_frames

    def write_in_part(name: str, *arguments: Any, **options: Any) -> Iterator[Any]:
        try:
            yield from write_frames(name, *arguments, **options)
        finally:
            os.truncate(name, path.stat().st_size)

    monkeypatch.setattr(ffmpeg, "write_frames", write_in_part)
    path = tmp_path / "turn.mp4"
    for before in (b"", b"1" * 1000):
        path.write_bytes(before)
        with pytest.raises(InputError, match=r"turn\.mp4: cannot be written, .*ffmpeg") as refusal:
            write_video(path, shades(32, 32), 10)
        assert "\n" not in str(refusal.value)
        assert path.read_bytes() == before
        assert list(tmp_path.iterdir()) == [path]


def test_without_the_video_extra_an_mp4_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(InputError, match=r"edge-se-sampler\[video\]"):
        check_video(tmp_path / "turn.mp4", RGB, 20)
    check_video(tmp_path / "turn.GIF", RGB, 20)  # which needs none


def test_a_gif_rounds_the_duration_of_frames_to_hundredths_of_a_second(tmp_path: Path) -> None:
    for rate, milliseconds in ((30, 30), (45, 20), (24, 40), (15, 70)):
        write_video(tmp_path / "turn.gif", shades(), rate)
        assert iio.immeta(tmp_path / "turn.gif")["duration"] == milliseconds


@pytest.mark.parametrize("name", ["turn.avi", "turn.gif.png"])
def test_other_endings_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"must end in \.gif or \.mp4"):
        check_video(tmp_path / name, RGB, 20)


@pytest.mark.parametrize("name", ["nowhere/turn.gif", "nowhere/turn.mp4"])
def test_a_folder_that_is_not_there_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="no such folder"):
        check_video(tmp_path / name, RGB, 20)


def test_a_video_that_cannot_be_written_is_an_input_error(tmp_path: Path) -> None:
    (tmp_path / "turn.gif").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        write_video(tmp_path / "turn.gif", shades(), 10)


@pytest.mark.parametrize("name", ["turn.gif", "turn.mp4"])
def test_outputs_that_no_video_shows_are_refused(name: str, tmp_path: Path) -> None:
    for output in ("rgba", "raw-depth"):
        with pytest.raises(InputError, match=f"--outputs {output} .* a folder"):
            check_video(tmp_path / name, ("rgb", output), 20)


@pytest.mark.parametrize("rate", [0, 0.5, -3, 51, float("nan")])
def test_rates_that_no_gif_has_are_refused(rate: float, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--frames-per-second"):
        check_video(tmp_path / "turn.gif", RGB, rate)


@pytest.mark.parametrize("name", ["turn.gif", "turn.mp4"])
def test_frames_are_not_collected(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """When one is made, those before the last are gone."""
    if name.endswith("mp4"):
        pytest.importorskip("imageio_ffmpeg")
    made: list[weakref.ref[Any]] = []

    def remember(image: Any) -> Any:
        made.append(weakref.ref(image))
        return image

    from_array = video.Image.fromarray
    monkeypatch.setattr(video.Image, "fromarray", lambda array: remember(from_array(array)))
    most = 0

    def stream() -> Iterator[np.ndarray]:
        nonlocal most
        for frame in shades(32, 32):
            yield remember(frame.copy())
            most = max(most, sum(reference() is not None for reference in made))

    write_video(tmp_path / name, stream(), 10)
    assert most <= 4


@pytest.mark.parametrize(
    ("name", "width", "outputs"), [("a.gif", 22_000, 3), ("a.mp4", 6_000, 3), ("a.MP4", 16_385, 1)]
)
def test_a_video_that_is_too_wide_is_refused_before_it_is_rendered(name: str, width: int, outputs: int) -> None:
    cameras = Cameras.of(np.eye(4)[None, :3], fx=9.0, fy=9.0, cx=1.0, cy=1.0, width=width, height=4)
    with pytest.raises(InputError, match=r"give fewer --outputs"):
        video._check_size(Path(name), cameras, outputs)
    smaller = Cameras.of(np.eye(4)[None, :3], fx=9.0, fy=9.0, cx=1.0, cy=1.0, width=width - 1000, height=4)
    video._check_size(Path(name), smaller, 1)
