"""`edge-se bench samplers`: what drawing and selecting pixels costs, without any rendering."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edge_se_sampler.bench.machine import median_milliseconds, resident_memory
from edge_se_sampler.bench.runner import run_in_subprocess
from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.config import MANAGER, MODEL, SAMPLER, override
from edge_se_sampler.engine.pipeline import Pipeline
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.session import resolve_config
from edge_se_sampler.methods import method_configs
from edge_se_sampler.sampling.distribution import PixelTable, UniformPixels, in_threads
from edge_se_sampler.sampling.edges import edge_strength
from edge_se_sampler.sampling.random_streams import Stream, stream
from edge_se_sampler.sampling.ranking import sample_by_rank


def measure(images: int, size: int, draws: int, rounds: int) -> dict[str, Any]:
    """`tables` (`build_tables`), median `milliseconds` of each kind of draw, and `training_memory`, the bytes that
    training at random and by squared error holds at its peak."""
    table, tables = build_tables(images, size)
    every_image, one_image = torch.arange(images), torch.tensor([images // 2])
    uniform = UniformPixels([(size, size)] * images)
    flat_cdf = torch.cumsum(torch.rand(images * size * size, dtype=torch.float64), dim=0)
    total, errors, extent = flat_cdf[-1], torch.rand(2 * draws), torch.tensor([images, size, size])
    cases: dict[str, Callable[[int], Any]] = {
        "edge_all_images": lambda step: table.draw(every_image, draws, stream(0, step, Stream.PIXELS)),
        "edge_one_image": lambda step: table.draw(one_image, draws, stream(0, step, Stream.PIXELS)),
        "uniform_all_images": lambda step: uniform.draw(every_image, draws, stream(0, step, Stream.PIXELS)),
        "flat_searchsorted": lambda _: torch.searchsorted(flat_cdf, torch.rand(draws, dtype=torch.float64) * total),
        "se_selection": lambda step: sample_by_rank(errors, draws, stream(0, step, Stream.SELECTION)),
        # what PixelSampler.sample_method of nerfstudio 1.1.5 computes without a mask
        "nerfstudio_uniform": lambda _: (torch.rand((draws, 3)) * extent).long(),
    }
    milliseconds, rays = median_milliseconds(cases, rounds), 1024
    random_bytes, se_bytes = (training_peak(method, rays, "small") for method in ("vanilla-nerf", "se-nerf"))
    memory = {"rays": rays, "random_bytes": random_bytes, "se_bytes": se_bytes}
    return {"tables": tables, "milliseconds": milliseconds, "training_memory": memory}


def build_tables(images: int, size: int) -> tuple[PixelTable, dict[str, float]]:
    """Edge tables of noise images (eight different ones, repeated), and what building them took."""
    noise = [np.random.default_rng(i).integers(0, 256, (size, size, 4), dtype=np.uint8) for i in range(min(images, 8))]
    table = PixelTable()
    memory_before, start = resident_memory(), time.perf_counter()
    floor = np.float32(0.01)
    table.add(in_threads(lambda i: torch.from_numpy(edge_strength(noise[i % len(noise)]) + floor), range(images)))
    seconds, pixels = time.perf_counter() - start, images * size * size
    return table, {
        "build_seconds": seconds,
        "bytes_per_pixel": table.nbytes / pixels,
        "peak_bytes_per_pixel_while_building": (resident_memory("VmHWM") - memory_before) / pixels,
    }


def training_peak(method: str, rays: int, size: str, error_source: str = "fine") -> int:
    """Resident bytes, above the level after imports, of a few steps of the `late_phase` in a fresh process."""
    return run_in_subprocess(_training_peak, method, late_phase(rays, size, error_source))


def _training_peak(method: str, changes: dict[str, Any]) -> int:
    noise = np.random.default_rng(0).integers(0, 256, (8, 100, 100, 3), dtype=np.uint8)
    pose = np.eye(4)
    pose[2, 3] = 4
    cameras = Cameras.of([pose] * 8, fx=100, fy=100, cx=50, cy=50, width=100, height=100)
    views = Views(tuple("abcdefgh"), tuple(noise), None, cameras)
    config = resolve_config(override(method_configs()[method], changes), views)
    before = resident_memory()
    pipeline = Pipeline.build(config, views, "cpu")
    trainer = config.setup(run=RunFolder(Path("never-written")), pipeline=pipeline, preview=None)
    for step in range(3):
        trainer.train_iteration(step)
    return resident_memory("VmHWM") - before


def late_phase(rays: int, size: str, error_source: str) -> dict[str, Any]:
    """Changes of a config (`override`) for training without an early phase, with so many pixels per step."""
    return {
        f"{SAMPLER}.early_fraction": 0.0,
        f"{SAMPLER}.error_source": error_source,
        f"{MANAGER}.train_num_rays_per_batch": rays,
        f"{MODEL}.size": size,
    }
