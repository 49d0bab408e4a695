"""Whether the images of a scene fit the machine's memory, estimated before any is decoded."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from edge_se_sampler.data.scene_file import SourceLocation

COPIES = 2
"""Of all pixels: training stacks the images of one size."""
BYTES_AT_WORK = 60
"""Of a pixel of an image that is undistorted and averaged, at most: colors and where they come from, in float32."""
MEMORY_AT_WORK = 3 * 2**29
"""Bytes of all images that are decoded at the same time."""


def num_workers(num_pixels: int) -> int:
    """How many images of at most so many pixels are decoded at the same time."""
    return max(1, min(os.cpu_count() or 1, MEMORY_AT_WORK // (BYTES_AT_WORK * num_pixels)))


def available_memory() -> int | None:
    """Bytes that programs may still take; where the system does not say, all it has; None: that is not known."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return 1024 * int(line.split()[1])
    except (OSError, ValueError, IndexError):
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # Windows has none
        return None


def check_memory(sizes: np.ndarray, downscale: int, location: SourceLocation) -> None:
    """InputError if images of these sizes, downscaled, take more than what is available; it says what to give.
    `sizes` (n, 3) int64: width, height, bytes of a pixel; `location` is the file that lists them."""
    available = available_memory()
    if available is None or (needed := _count_bytes(sizes, downscale)) <= available:
        return
    enough = downscale + 1
    while _count_bytes(sizes, enough) > available:
        enough += 1
    problem = f"its {len(sizes)} images take {needed / 2**30:.1f} GiB of memory, {available / 2**30:.1f} are available"
    raise location.error(problem, f"give --downscale {enough}")


def _count_bytes(sizes: np.ndarray, downscale: int) -> int:
    return COPIES * int((sizes[:, 0] // downscale * (sizes[:, 1] // downscale) * sizes[:, 2]).sum())
