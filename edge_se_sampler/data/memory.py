"""Whether the images of a scene, and what training keeps of their pixels, fit the machine's memory: estimated before
any is decoded."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import numpy as np

from edge_se_sampler.data.scene_file import SourceLocation

COPIES = 2
"""Of all pixels: training stacks the images of one size."""
BYTES_OF_TABLES = 20
"""Of a pixel, beside its colors: edge strengths, probabilities and masks, as pixel samplers keep them."""
BYTES_AT_WORK = 60
"""Of a pixel of an image that is undistorted and averaged, at most: colors and where they come from, in float32."""
MEMORY_AT_WORK = 3 * 2**29
"""Bytes of all images that are decoded at the same time."""


def num_workers(num_pixels: int) -> int:
    """How many images of at most so many pixels are decoded at the same time."""
    return max(1, min(os.cpu_count() or 1, MEMORY_AT_WORK // (BYTES_AT_WORK * num_pixels)))


def available_memory() -> int | None:
    """Bytes that programs may still take, of the machine's and of their container's; where neither says, all that the
    machine has; None: that is not known."""
    found = [size for size in (_available_on_machine(), _available_in_container()) if size is not None]
    return min(found, default=_physical_memory())


def _available_on_machine() -> int | None:
    with suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return 1024 * int(line.split()[1])
    return None


def _available_in_container(cgroup: Path = Path("/sys/fs/cgroup")) -> int | None:
    """By Linux's control groups, version 2; files that could be dropped from memory count as available."""
    with suppress(OSError, ValueError, KeyError):
        limit, current = (int((cgroup / f"memory.{name}").read_text()) for name in ("max", "current"))
        statistics = dict(line.split() for line in (cgroup / "memory.stat").read_text().splitlines())
        return max(0, limit - current + int(statistics["inactive_file"]))
    return None


def _physical_memory() -> int | None:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # Windows has none
        return None


def check_memory(sizes: np.ndarray, downscale: int, location: SourceLocation) -> None:
    """InputError, which says what to give, if training on images of these sizes takes more than what is available.
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
    pixels = sizes[:, 0] // downscale * (sizes[:, 1] // downscale)
    return int((pixels * (COPIES * sizes[:, 2] + BYTES_OF_TABLES)).sum())
