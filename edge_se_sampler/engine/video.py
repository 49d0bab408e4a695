"""A run rendered as a GIF or an MP4."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import torch

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.files import check_output, to_uint8, write_atomically
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.rendering import render_rays
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.session import load_model, read_test_views, read_train_views
from edge_se_sampler.errors import InputError, check_value


def spiral(like: Cameras, count: int) -> Cameras:
    """Cameras once around the origin at the median distance of `like`, rising and falling between 15 and 45 degrees,
    with the first one's intrinsics and size."""
    radius = float(like.camera_to_worlds[:, :, 3].norm(dim=1).median())
    azimuth = torch.arange(count).to(like.fx) / count * 2 * math.pi
    elevation = math.radians(30) + math.radians(15) * torch.sin(2 * azimuth)
    horizontal = elevation.cos()
    back = torch.stack((horizontal * azimuth.cos(), horizontal * azimuth.sin(), elevation.sin()), dim=1)  # unit vectors
    right = torch.stack((-azimuth.sin(), azimuth.cos(), torch.zeros_like(azimuth)), dim=1)
    poses = torch.stack((right, torch.linalg.cross(back, right), back, back * radius), dim=2)
    return replace(like[[0] * count], camera_to_worlds=poses)


def render_run(
    run: RunFolder, config: TrainerConfig, output_path: Path, kind: str, num_frames: int, frames_per_second: int
) -> None:
    """Render a run's last checkpoint along a spiral or at its held-out cameras (kind "test"), as a video."""
    check_video(output_path, frames_per_second)
    check_value("num-frames", num_frames, num_frames >= 1, "at least 1")
    check_value("frames-per-second", frames_per_second, frames_per_second >= 1, "at least 1")
    model, _ = load_model(run, config)
    if kind == "spiral":
        cameras = spiral(read_train_views(config).cameras, num_frames)
    else:
        cameras = read_test_views(config).cameras
    (height, width), *others = torch.unique(torch.cat((cameras.height, cameras.width), dim=1), dim=0).tolist()
    if others:
        raise InputError("the held-out views differ in size and make no video; use --kind spiral")
    cameras, frames = cameras.to(model.device, torch.float32), []
    with Progress(len(cameras), "rendering") as progress:
        for i in range(len(cameras)):
            frames.append(render_rays(model, cameras.image_rays(i)).reshape(height, width, 3).numpy())
            progress.update(i + 1)
    write_video(output_path, frames, frames_per_second)


def check_video(path: Path, frames_per_second: int) -> None:
    """InputError if `write_video` cannot write such a file."""
    suffix = path.suffix.lower()
    if suffix == ".gif" and frames_per_second > 50:
        raise InputError(f"--frames-per-second is {frames_per_second}: a GIF has at most 50; use .mp4")
    if suffix not in (".gif", ".mp4"):
        raise InputError(f"--output-path {path}: must end in .gif or .mp4")
    check_output(path)
    if suffix == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError:
            raise InputError("mp4 needs the [video] extra: pip install 'edge-se-sampler[video]', or use .gif") from None


def write_video(path: Path, frames: list[np.ndarray], frames_per_second: int) -> None:
    """Write (H, W, 3) float frames in [0, 1]; a GIF shows each for the nearest number of hundredths of a second.
    InputError if it cannot be written."""
    stacked, suffix = to_uint8(np.stack(frames)), path.suffix.lower()
    if suffix == ".gif":
        settings: dict[str, Any] = {"duration": 10 * round(100 / frames_per_second), "loop": 0}
    else:
        if min(stacked.shape[1:3]) < 2:
            raise InputError(f"{path}: the views are 1 pixel wide or high, which is no video")
        stacked = stacked[:, : stacked.shape[1] // 2 * 2, : stacked.shape[2] // 2 * 2]  # the codec needs even sides
        settings = {"fps": frames_per_second, "macro_block_size": 2}
    write_atomically(path, iio.imwrite("<bytes>", stacked, extension=suffix, **settings))
