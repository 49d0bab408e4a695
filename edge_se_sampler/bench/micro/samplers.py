"""`edge-se bench samplers`: what drawing and selecting pixels costs, without any rendering."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from edge_se_sampler.bench.machine import median_milliseconds, resident_memory
from edge_se_sampler.sampling.distribution import PixelTable, UniformPixels, in_threads
from edge_se_sampler.sampling.edges import edge_strength
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.pixel_sampler import EdgeSEPixelSampler
from edge_se_sampler.sampling.random_streams import Stream, stream
from edge_se_sampler.sampling.ranking import sample_by_rank
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig


def measure(images: int, size: int, draws: int, rounds: int) -> dict[str, Any]:
    """`tables` (`build_tables`), `strategies`: what the tables of each take, and median `milliseconds` of each kind of
    draw, by its label."""
    table, tables = build_tables(images, size)
    every_image, one_image = torch.arange(images), torch.tensor([images // 2])
    uniform = UniformPixels([(size, size)] * images)
    flat_cdf = torch.cumsum(torch.rand(images * size * size, dtype=torch.float64), dim=0)
    total, errors, extent = flat_cdf[-1], torch.rand(2 * draws), torch.tensor([images, size, size])
    cases: dict[str, Callable[[int], Any]] = {
        "Edge, of all images": lambda step: table.draw(every_image, draws, stream(0, step, Stream.PIXELS)),
        "Edge, of one image": lambda step: table.draw(one_image, draws, stream(0, step, Stream.PIXELS)),
        "Random, of all images": lambda step: uniform.draw(every_image, draws, stream(0, step, Stream.PIXELS)),
        "for comparison: torch.searchsorted in one CDF over all pixels": lambda _: torch.searchsorted(
            flat_cdf, torch.rand(draws, dtype=torch.float64) * total
        ),
        "SE's selection by rank, errors given": lambda step: sample_by_rank(
            errors, draws, stream(0, step, Stream.SELECTION)
        ),
        # what nerfstudio's PixelSampler.sample_method computes without a mask
        "for comparison: nerfstudio 1.1.5's uniform pixels": lambda _: (torch.rand((draws, 3)) * extent).long(),
    }
    strategies = {}
    for name in ("uniform", "error-map", "error-cdf", "soft-mining", "actray", "regions", "quadtree", "expansive"):
        take_ten_steps, strategies[name] = prepare_strategy(name, images, size, draws)
        cases[f"ten steps of {name}, of all images: pixels drawn, errors learnt from"] = take_ten_steps
    return {"tables": tables, "strategies": strategies, "milliseconds": median_milliseconds(cases, rounds)}


def prepare_strategy(late: str, images: int, size: int, draws: int) -> tuple[Callable[[int], None], dict[str, float]]:
    """A function that takes ten steps with a strategy, on copies of one noise image, whose errors are random; and what
    its tables take."""
    config = EdgeSEPixelSamplerConfig(early="uniform", late=late, images_per_step="all")
    sampler, errors = EdgeSEPixelSampler(config, num_rays_per_batch=draws), torch.rand(draws)
    sampler.bind(squared_error=lambda _: errors, progress=lambda _: 1.0, seed=0)
    noise = torch.randint(256, (1, size, size, 3), dtype=torch.uint8)
    batch = {"image": noise.expand(images, -1, -1, -1), "image_idx": torch.arange(images)}
    start = time.perf_counter()
    sampler.check_images(batch)
    seconds = time.perf_counter() - start
    table, _ = sampler.strategies[late].distribution.tables(ImageBatch.of(batch, use_mask=False))
    held = sum(getattr(value, "nbytes", 0) for value in vars(table).values())

    def take(number: int) -> None:
        for step in range(10 * number + 1, 10 * number + 11):
            sampler.set_step(step)
            sampler.sample(batch)
            sampler.observe(errors)

    return take, {"build_seconds": seconds, "bytes_per_pixel": held / (images * size * size)}


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
