"""A run rendered as a GIF, an MP4, or a folder of frames."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO

import numpy as np
import torch
from PIL import Image

from edge_se_sampler.data.camera_path import read_camera_path, undo_dataparser
from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.files import check_output, write_atomically
from edge_se_sampler.engine.frames import (
    FRAMES_ONLY,
    choose_depth_unit,
    find_depth_range,
    name_checkpoint,
    render_frame,
    write_frames,
)
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.session import load_ensemble, read_test_views, read_train_views
from edge_se_sampler.engine.trajectories import spiral, through
from edge_se_sampler.errors import InputError, check_value
from edge_se_sampler.models.ray_model import RayModel

FRAMES_PER_SECOND = 20
NUM_FRAMES = 60
MAX_FRAMES = 10**6


def render_run(
    runs: Sequence[tuple[RunFolder, TrainerConfig]],
    output_path: Path,
    outputs: Sequence[str],
    *,
    kind: str | None = None,
    camera_path: Path | None = None,
    dataparser_transforms: Path | None = None,
    num_frames: int | None = None,
    frames_per_second: float | None = None,
    depth_unit: float | None = None,
) -> None:
    """Render the last checkpoint of a run, or of several in the mean, at the cameras of a kind (see `find_cameras`) or
    of a camera path file, as a video of the outputs (see `render_frame`) side by side, or as a folder of frames.
    InputError for what cannot be used."""
    config = runs[0][1]
    if kind is not None and camera_path is not None:
        raise InputError("--kind and --camera-path: give one of them")
    if dataparser_transforms is not None and camera_path is None:
        raise InputError("--dataparser-transforms has no effect without --camera-path")
    if num_frames is not None and (camera_path is not None or kind in ("train", "test")):
        raise InputError("--num-frames is of the kinds spiral and interpolate: leave it out")
    num_frames = NUM_FRAMES if num_frames is None else num_frames
    check_value("num-frames", num_frames, 1 <= num_frames <= MAX_FRAMES, f"from 1 to {MAX_FRAMES}")
    if depth_unit is not None and output_path.suffix:
        raise InputError("--depth-unit has no effect on a video, which cannot show raw-depth: leave it out")
    check_value("outputs", outputs, len(outputs) == len(set(outputs)) > 0, "at least one, each once")
    path = None if camera_path is None else read_camera_path(camera_path)
    if path is not None and dataparser_transforms is not None:
        assert config.data is not None  # the config is resolved
        path = undo_dataparser(path, dataparser_transforms, config.data, config.data_format)
    rates = (frames_per_second, path and path.frames_per_second, FRAMES_PER_SECOND)
    rate = next(rate for rate in rates if rate is not None)
    if output_path.suffix:
        check_video(output_path, outputs, rate)
    elif frames_per_second is not None:
        raise InputError("--frames-per-second has no effect on a folder of frames: leave it out")
    if depth_unit is not None and "raw-depth" not in outputs:
        raise InputError("--depth-unit has no effect without raw-depth among the --outputs: leave it out")
    model, paths = load_ensemble(runs)
    checkpoints = [name_checkpoint(path) for path in paths]  # now: a training may delete them meanwhile
    cameras = find_cameras(config, kind or "spiral", num_frames) if path is None else path.cameras
    depths = None if path is None else find_depth_range(model, cameras)  # of a path all is shown that a viewer shows
    unit = choose_depth_unit((depths or model.config.depths)[1], depth_unit)
    if output_path.suffix:
        _check_size(output_path, cameras, len(outputs))
        write_video(output_path, _video_frames(model, cameras, outputs, unit, depths), rate)
    else:
        write_frames(output_path, model, cameras, outputs, unit, checkpoints, depths)


def find_cameras(config: TrainerConfig, kind: str, num_frames: int) -> Cameras:
    """Cameras of a run: its training views ("train") or held-out ones ("test") as they are, a path through the training
    views in their order ("interpolate"), or a turn around what they look at ("spiral")."""
    if kind == "test":
        return read_test_views(config).cameras
    views = read_train_views(config, trains=False)
    if kind == "train":
        return views.cameras
    trajectory = spiral if kind == "spiral" else through
    return trajectory(views, config.pipeline.model.depths, num_frames)


def check_video(path: Path, outputs: Sequence[str], frames_per_second: float) -> None:
    """InputError if no such file can be written, or it cannot show such outputs."""
    suffix = path.suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise InputError(f"--output-path {path}: must end in .gif or .mp4, or have no ending: a folder of PNGs")
    for name in FRAMES_ONLY.keys() & set(outputs):
        raise InputError(f"--outputs {name} {FRAMES_ONLY[name]}: give --output-path a folder (no ending), not a video")
    most = 50 if suffix == ".gif" else 1000
    valid = 1 <= frames_per_second <= most
    check_value("frames-per-second", f"{frames_per_second:g}", valid, f"from 1 to {most} in a {suffix[1:]}")
    check_output(path, suffix)
    if suffix == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError:
            raise InputError("mp4 needs the [video] extra: pip install 'edge-se-sampler[video]', or use .gif") from None


MOST_PIXELS = {".gif": 2**16 - 1, ".mp4": 2**14}
"""Along each side of a video: what the format holds, and what encoders take."""


def _video_frames(
    model: RayModel, cameras: Cameras, outputs: Sequence[str], unit: float, depths: tuple[float, float] | None
) -> Iterator[np.ndarray]:
    """(H, W, 3) uint8 frames of `render_frame`, one after another, outputs side by side."""
    height, width = int(cameras.height[0]), int(cameras.width[0])
    with Progress(len(cameras), "rendering") as progress:
        for i in range(len(cameras)):
            images = render_frame(model, cameras, i, outputs, unit, depths)
            channels = (np.broadcast_to(np.atleast_3d(images[name]), (height, width, 3)) for name in outputs)
            yield np.concatenate(list(channels), axis=1)
            progress.update(i + 1)


def _check_size(path: Path, cameras: Cameras, num_outputs: int) -> None:
    """InputError if so many outputs of cameras side by side make no video."""
    (height, width), *others = torch.unique(torch.cat((cameras.height, cameras.width), dim=1), dim=0).tolist()
    if others:
        raise InputError("the views differ in size and make no video; give --output-path a folder (no ending)")
    if min(height, width) < 2:
        raise InputError("the views are 1 pixel wide or high, which is no video")
    suffix, width = path.suffix.lower(), width * num_outputs
    if max(height, width) > MOST_PIXELS[suffix]:
        most = f"{width} x {height} pixels are more than the {MOST_PIXELS[suffix]} a side of a {suffix[1:]}"
        raise InputError(f"{most}: give fewer --outputs, or --output-path a folder (no ending)")


def write_video(path: Path, frames: Iterable[np.ndarray], frames_per_second: float) -> None:
    """Write at least one (H, W, 3) uint8 frame, none kept as it is; a GIF shows each for the nearest number of
    hundredths of a second. InputError if it cannot be written."""
    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    write_atomically(path, lambda file: write(file, iter(frames), frames_per_second))


def _write_gif(file: BinaryIO, frames: Iterator[np.ndarray], frames_per_second: float) -> None:
    images = map(Image.fromarray, frames)
    shown = {"duration": 10 * round(100 / frames_per_second), "loop": 0}
    next(images).save(file, "GIF", save_all=True, append_images=images, **shown)


def _write_mp4(file: BinaryIO, frames: Iterator[np.ndarray], frames_per_second: float) -> None:
    import imageio_ffmpeg

    first, num_sent, num_written = next(frames), 0, 0
    height, width = (side // 2 * 2 for side in first.shape[:2])  # the codec needs even sides
    with TemporaryDirectory(prefix=".", dir=Path(file.name).parent) as folder:  # on the disk that the video is for
        video = Path(folder) / "video.mp4"
        settings: dict[str, Any] = {"fps": frames_per_second, "macro_block_size": 2, "ffmpeg_log_level": "quiet"}
        writing = imageio_ffmpeg.write_frames(str(video), (width, height), **settings)
        with closing(writing) as writer:
            writer.send(None)
            for frame in itertools.chain([first], frames):
                try:
                    writer.send(np.ascontiguousarray(frame[:height, :width]))
                except OSError as problem:  # of many lines
                    raise OSError(f"ffmpeg: {str(problem).strip().splitlines()[0]}") from problem
                num_sent += 1
        with suppress(RuntimeError):  # what it cannot read
            # imageio_ffmpeg ignores ffmpeg's exit status: only the file shows that encoding failed at the end
            num_written, _ = imageio_ffmpeg.count_frames_and_secs(str(video))
        if num_written != num_sent:
            raise OSError(f"ffmpeg wrote {num_written} of {num_sent} frames, as where a disk is full")
        with open(video, "rb") as written:
            shutil.copyfileobj(written, file)
