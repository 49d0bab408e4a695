"""`edge-se bench scoring`: what squared errors of each source cost, and how well the cheap ones rank pixels.

Steps of the late phase are timed in turns within one process; peaks of memory in a fresh process each.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edge_se_sampler.bench.machine import median_milliseconds, resident_memory
from edge_se_sampler.bench.runner import run_in_subprocess
from edge_se_sampler.bench.statistics import require_scipy_stats
from edge_se_sampler.bench.train import cached_scene
from edge_se_sampler.engine.config import MANAGER, MODEL, SAMPLER, TrainerConfig, override
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.rendering import render_outputs
from edge_se_sampler.engine.session import prepare
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.methods import method_configs
from edge_se_sampler.sampling.distribution import UniformPixels
from edge_se_sampler.sampling.image_batch import ImageBatch, unit_interval
from edge_se_sampler.sampling.strategies import RankedError

ERROR_SOURCES = {
    "fine": "the fine network, as in the paper (`fine`)",
    "coarse": "the coarse network alone (`coarse`)",
    "cached": "errors that training found there earlier (`cached`)",
}


def measure(workplace: Path, scene: str, size: str, rays: int, rounds: int, iterations: int) -> dict[str, Any]:
    """Measure on a synthetic scene.

    Returns:
        median `milliseconds` per step of Random and of each error source, `memory_against_random` of each error source
        (a ratio of peaks), and `rank_correlation` of the cheap scores with the fine ones (Spearman).

    Raises:
        InputError: no such scene, or the [bench] extra is missing.
    """
    require_scipy_stats()
    data = cached_scene(workplace, scene)
    with tempfile.TemporaryDirectory() as folder:
        changes = {
            "data": data,
            "output_dir": Path(folder),
            "machine.device_type": "cpu",
            f"{SAMPLER}.early_fraction": 0.0,
            f"{MANAGER}.train_num_rays_per_batch": rays,
            f"{MODEL}.size": size,
        }
        configs = {"random": override(method_configs()["vanilla-nerf"], changes)}
        for source in ERROR_SOURCES:
            configs[source] = override(method_configs()["se-nerf"], changes | {f"{SAMPLER}.error_source": source})
        trainers = {name: prepare(config) for name, config in configs.items()}
        milliseconds = median_milliseconds({name: each.train_iteration for name, each in trainers.items()}, rounds)
        trainer = prepare(configs["cached"])
        with Progress(iterations, "training") as progress:
            for step in range(iterations):
                trainer.train_iteration(step)
                progress.update(step + 1)
        correlations = correlate_rankings(trainer, iterations)
        peaks = {name: run_in_subprocess(training_peak, config) for name, config in configs.items()}
    memory = {source: peaks[source] / peaks["random"] for source in ERROR_SOURCES}
    return {"milliseconds": milliseconds, "memory_against_random": memory, "rank_correlation": correlations}


def correlate_rankings(trainer: Trainer, step: int) -> dict[str, float]:
    """Spearman's correlation of coarse and cached scores with the fine ones, over pixels drawn uniformly; cached errors
    are looked up at a step."""
    manager, model = trainer.pipeline.datamanager, trainer.pipeline.model
    sampler, batch = manager.train_pixel_sampler, ImageBatch.of(manager.image_batch, use_mask=False)
    ranked = sampler.strategies["se"].selector
    assert isinstance(ranked, RankedError)
    assert ranked.error_map is not None
    rng = np.random.default_rng(0)
    drawn = UniformPixels(batch.sizes).draw(torch.arange(len(batch.sizes)), 4096, rng)
    pixels = batch.gather(drawn)
    indices, image = pixels["indices"], unit_interval(pixels["image"])
    outputs = render_outputs(model, manager.cameras.pixel_rays(indices), ("background", "rgb_fine", "rgb_coarse"))
    fine, coarse = (model.squared_error(outputs, image, network).numpy() for network in ("fine", "coarse"))
    cached = ranked.error_map.lookup(indices.numpy(), step, sampler.num_rays_per_batch)
    spearman = require_scipy_stats().spearmanr
    return {"coarse": float(spearman(fine, coarse).statistic), "cached": float(spearman(fine, cached).statistic)}


def training_peak(config: TrainerConfig) -> int:
    """Resident bytes of a few steps, above the level after imports; to be called in a fresh process."""
    before = resident_memory()
    trainer = prepare(config)
    for step in range(3):
        trainer.train_iteration(step)
    return resident_memory("VmHWM") - before
