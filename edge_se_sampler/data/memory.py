"""Whether the images of a scene fit the machine's memory and, where they are trained on, what training keeps of their
pixels and its model: estimated before any image is decoded."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edge_se_sampler import ranks
from edge_se_sampler.data.scene_file import SourceLocation

COPIES = 2
"""Of all pixels: training stacks the images of one size."""
BYTES_OF_TABLES = 26
"""Of a pixel, beside its colors: edge strengths, probabilities and masks, as pixel samplers keep them, where there are
masks; a few less where there are none."""
BYTES_AT_WORK = 60
"""Of a pixel of an image that is undistorted and averaged, at most: colors and where they come from, in float32."""
MEMORY_AT_WORK = 3 * 2**29
"""Bytes of all images that are decoded at the same time, at most; and half of what is available."""
MIN_SIDE = 50
"""Pixels of the shorter side of the images that are still worth training on."""
ModelMemory = Callable[[bool, int], int]
"""Whether all images have alpha, which may tell where the object is, and their longest side, in pixels -> bytes that
training a model takes beside them."""


@dataclass(frozen=True)
class MemoryNeeds:
    """Bytes that are taken at most."""

    images: int
    tables: int
    """What pixel samplers keep of each pixel; 0: there are none."""
    model: int
    """0: it is in a memory of its own, or there is none."""

    @property
    def total(self) -> int:
        return self.images + self.tables + self.model

    def __str__(self) -> str:
        parts = [f"images {_format(self.images)}"] + [f"tables {_format(self.tables)}"] * (self.tables > 0)
        return ", ".join(parts + [f"model up to {_format(self.model)}"] * (self.model > 0))


def num_workers(num_pixels: int) -> int:
    """How many images of at most so many pixels are decoded at the same time."""
    available = available_memory()
    at_work = MEMORY_AT_WORK if available is None else min(MEMORY_AT_WORK, available // 2)
    return max(1, min(os.cpu_count() or 1, at_work // (BYTES_AT_WORK * num_pixels)))


def available_memory() -> int | None:
    """Bytes that programs may still take, of the machine's and of their container's; where neither says, all that the
    machine has; None: that is not known. Of several processes that train together, each has its share."""
    found = [size for size in (_available_on_machine(), _available_in_container()) if size is not None]
    available = min(found, default=_physical_memory())
    return None if available is None else available // ranks.local_world_size()


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


def check_memory(
    sizes: np.ndarray, downscale: int, model_memory: Callable[[int], int] | None, location: SourceLocation
) -> str:
    """What images of these sizes take, and what is available, in a line; InputError, which says what to give, if that
    is less. `sizes` (n, 3) int64: width, height, bytes of a pixel; `model_memory` is that of the model that is trained
    on them, by the longest side, None: nothing is; `location` is the file that lists them."""
    needed, available = estimate_memory(sizes, downscale, model_memory), available_memory()
    if available is None:
        return str(needed)
    if needed.total <= available:
        return f"{needed}; {_format(available)} available"
    if model_memory is None:
        problem, remedy = f"its {len(sizes)} images take", "end other programs, or train with a larger --downscale"
    else:
        problem = f"training on its {len(sizes)} images takes"
        remedy = _find_remedy(sizes, downscale, model_memory, available)
    problem = f"{problem} {_format(needed.total)} of memory ({needed}), {_format(available)} are available"
    raise location.error(problem, remedy)


def estimate_memory(sizes: np.ndarray, downscale: int, model_memory: Callable[[int], int] | None) -> MemoryNeeds:
    """What images of these sizes take, as `check_memory` has them."""
    width, height = sizes[:, 0] // downscale, sizes[:, 1] // downscale
    pixels = width * height
    images = int((pixels * sizes[:, 2]).sum())
    if model_memory is None:
        return MemoryNeeds(images, 0, 0)
    longest = int(max(width.max(), height.max()))
    return MemoryNeeds(COPIES * images, BYTES_OF_TABLES * int(pixels.sum()), model_memory(longest))


def _find_remedy(sizes: np.ndarray, downscale: int, model_memory: Callable[[int], int], available: int) -> str:
    for enough in range(downscale + 1, int(sizes[:, :2].min()) // MIN_SIDE + 1):
        if estimate_memory(sizes, enough, model_memory).total <= available:
            return f"give --downscale {enough}"
    largest = estimate_memory(sizes, downscale, model_memory)
    return "give fewer images, as --num-views does" if largest.model <= available else "train a smaller model"


def _format(size: int) -> str:
    gib = min(size, 2**100) / 2**30
    return f"{gib:,.1f} GiB" if gib >= 0.1 else f"{1024 * gib:.1f} MiB"
