"""`edge-se bench samplers`: what choosing pixels costs, without any rendering."""

from __future__ import annotations

import math
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edge_se_sampler.bench.machine import machine, resident_memory
from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.pipeline import Pipeline
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.resolve import resolve_config
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.methods import method_configs
from edge_se_sampler.sampling.distribution import PixelTable, UniformPixels, in_threads
from edge_se_sampler.sampling.edges import edge_strength
from edge_se_sampler.sampling.random_streams import Stream, stream
from edge_se_sampler.sampling.ranking import sample_by_rank

EPSILON = np.float32(0.01)


def bench_samplers(images: int, size: int, draws: int, repeats: int) -> dict[str, Any]:
    """Build tables for noise images and time draws, interleaved; all times are medians.

    Args:
        images: how many.
        size: rows and columns of each.
        draws: pixels a draw.
        repeats: rounds; in each, every kind of draw is timed once.
    """
    progress = Progress(repeats + images, "bench samplers")
    table, building = build_tables(images, size, progress)
    everything, one = torch.arange(images), torch.tensor([images // 2])
    uniform = UniformPixels([(size, size)] * images)
    flat = torch.cumsum(torch.rand(images * size * size, dtype=torch.float64), dim=0)
    errors = torch.rand(2 * draws)
    host_uniform = _nerfstudio_uniform(images, size, draws)
    cases: dict[str, Callable[[int], Any]] = {
        "edge_all_images": lambda step: table.draw(everything, draws, stream(0, step, Stream.PIXELS)),
        "edge_one_image": lambda step: table.draw(one, draws, stream(0, step, Stream.PIXELS)),
        "uniform_all_images": lambda step: uniform.draw(everything, draws, stream(0, step, Stream.PIXELS)),
        "flat_searchsorted": lambda _: torch.searchsorted(flat, torch.rand(draws, dtype=torch.float64) * flat[-1]),
        "se_selection": lambda step: sample_by_rank(errors, draws, stream(0, step, Stream.SELECTION)),
        "nerfstudio_uniform": host_uniform,
    }
    times: dict[str, list[float]] = {name: [] for name in cases}
    for step in range(repeats):
        for name, case in cases.items():
            began = time.perf_counter()
            case(step)
            times[name].append(time.perf_counter() - began)
        progress.update(images + step + 1)
    progress.close()
    return {
        "images": images,
        "size": size,
        "draws": draws,
        "repeats": repeats,
        **building,
        "milliseconds": {name: 1e3 * statistics.median(values) for name, values in times.items()},
        "large_image": large_image_halves(),
        "training_memory": memory_ratio(),
        "machine": machine(),
    }


def build_tables(images: int, size: int, progress: Progress) -> tuple[PixelTable, dict[str, float]]:
    """Edge tables of noise images: the tables, and what building them took."""
    noise = [np.random.default_rng(i).integers(0, 256, (size, size, 4), dtype=np.uint8) for i in range(min(images, 8))]
    table = PixelTable()
    before = resident_memory()
    began = time.perf_counter()

    def strength(i: int) -> torch.Tensor:
        progress.update(i)
        return torch.from_numpy(edge_strength(noise[i % len(noise)]) + EPSILON)

    table.add(in_threads(strength, range(images)))
    seconds = time.perf_counter() - began
    pixels = images * size * size
    return table, {
        "pixels": pixels,
        "build_seconds": seconds,
        "bytes_per_pixel": table.nbytes / pixels,
        "peak_bytes_per_pixel_while_building": (resident_memory("VmHWM") - before) / pixels,
    }


def large_image_halves() -> dict[str, float]:
    """One image of more than 2^24 pixels whose lower half is twice as strong: the share of draws that fell there.

    Two thirds are expected; torch.multinomial drew none at 2^24 categories.
    """
    side, count = 4200, 100_000
    strength = torch.ones(side, side)
    strength[side // 2 :] = 2
    table = PixelTable()
    table.add([strength])
    drawn = table.draw(torch.tensor([0]), count, stream(0, 0, Stream.PIXELS))
    share = float((drawn[:, 1] >= side // 2).double().mean())
    deviation = math.sqrt(2 / 9 / count)
    return {"pixels": side * side, "share": share, "expected": 2 / 3, "z": (share - 2 / 3) / deviation}


def _nerfstudio_uniform(images: int, size: int, draws: int) -> Callable[[int], Any]:
    """What nerfstudio 1.1.5's PixelSampler.sample_method computes without a mask."""
    extent = torch.tensor([images, size, size])
    return lambda _: (torch.rand((draws, 3)) * extent).long()


_PEAK = (
    "import sys; from edge_se_sampler.bench.micro.samplers import training_peak; print(training_peak(*sys.argv[1:]))"
)


def memory_ratio(rays: int = 1024) -> dict[str, float]:
    """Peak memory of training with SE against training with Random, each in a process of its own."""
    random, se = (peak_bytes(method, rays, "small", "fine") for method in ("vanilla-nerf", "se-nerf"))
    return {"rays": rays, "random_bytes": random, "se_bytes": se, "ratio": se / random}


def peak_bytes(method: str, rays: int, size: str, scoring: str) -> float:
    """`training_peak` in a process of its own."""
    command = [sys.executable, "-c", _PEAK, method, str(rays), size, scoring]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def training_peak(method: str, rays: str, size: str, scoring: str) -> int:
    """Resident bytes, above the level after imports, of a few late training steps."""
    noise = np.random.default_rng(0).integers(0, 256, (8, 100, 100, 3), dtype=np.uint8)
    pose = np.eye(4)
    pose[2, 3] = 4
    cameras = Cameras.of([pose] * 8, fx=100, fy=100, cx=50, cy=50, width=100, height=100)
    views = Views(tuple("abcdefgh"), tuple(noise), None, cameras)
    config = method_configs()[method]
    how = scoring if method == "se-nerf" else "fine"
    sampler = replace(config.pipeline.datamanager.pixel_sampler, early_fraction=0.0, error_source=how)
    manager = replace(config.pipeline.datamanager, train_num_rays_per_batch=int(rays), pixel_sampler=sampler)
    model = replace(config.pipeline.model, size=size)
    config = resolve_config(replace(config, pipeline=replace(config.pipeline, datamanager=manager, model=model)), views)
    before = resident_memory()
    pipeline = Pipeline.build(config, views, "cpu")
    trainer = config.setup(run=RunFolder(Path("never-written")), pipeline=pipeline, preview=None)
    for step in range(3):
        trainer.train_iteration(step)
    return resident_memory("VmHWM") - before


def table_of(result: dict[str, Any]) -> str:
    """The result as lines to read."""
    times, memory, large = result["milliseconds"], result["training_memory"], result["large_image"]
    lines = [
        f"{result['images']} images of {result['size']} x {result['size']}, {result['draws']} pixels a draw",
        f"  tables      {result['build_seconds']:.2f} s, {result['bytes_per_pixel']:.2f} bytes a pixel "
        f"(peak while building {result['peak_bytes_per_pixel_while_building']:.1f})",
    ]
    lines += [f"  {name.replace('_', ' '):<20} {value:7.3f} ms" for name, value in times.items()]
    lines += [
        f"  {large['pixels'] / 1e6:.1f}M-pixel image: {large['share']:.4f} of the draws in the half that holds "
        f"{large['expected']:.4f} of the mass (z = {large['z']:.2f})",
        f"  training memory at N = {memory['rays']}: SE {memory['ratio']:.3f} x Random",
    ]
    return "\n".join(lines)
