"""Pictures -> a GIF or an MP4."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np

from edge_se_sampler.engine.files import check_output, eight_bit, write_atomically
from edge_se_sampler.errors import InputError


def check_video(path: Path, frames_per_second: int) -> None:
    """Refuse early what `write_video` could not write.

    Raises:
        InputError: neither .gif nor .mp4, too fast for a GIF, the [video] extra is missing, or the file cannot be
            written.
    """
    if path.suffix.lower() == ".gif" and frames_per_second > 50:
        raise InputError(f"--frames-per-second is {frames_per_second}: a GIF has at most 50; use .mp4")
    if path.suffix.lower() not in (".gif", ".mp4"):
        raise InputError(f"--output-path {path}: must end in .gif or .mp4")
    check_output(path)
    if path.suffix.lower() == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError:
            raise InputError("mp4 needs the [video] extra: pip install 'edge-se-sampler[video]', or use .gif") from None


def write_video(path: Path, frames: list[np.ndarray], frames_per_second: int) -> None:
    """Write (H, W, 3) float pictures in [0, 1]; a GIF's stand for whole hundredths of a second, the nearest number.

    Raises:
        InputError: it cannot be written.
    """
    stacked = eight_bit(np.stack(frames))
    if path.suffix.lower() == ".gif":
        content = iio.imwrite(
            "<bytes>", stacked, extension=".gif", duration=10 * round(100 / frames_per_second), loop=0
        )
        write_atomically(path, content)
        return
    if min(stacked.shape[1:3]) < 2:
        raise InputError(f"{path}: the views are 1 pixel wide or high, which is no video")
    even = stacked[:, : stacked.shape[1] // 2 * 2, : stacked.shape[2] // 2 * 2]  # what the codec takes
    temporary = path.with_name(f".{path.stem}.tmp.mp4")
    try:
        iio.imwrite(temporary, even, fps=frames_per_second, macro_block_size=2)
        temporary.replace(path)
    except OSError as problem:
        raise InputError(f"{path}: cannot be written ({problem.strerror or problem})") from problem
    finally:
        temporary.unlink(missing_ok=True)
