"""`edge-se bench scoring`: what squared errors cost, scored exactly, by the coarse network, or remembered, and how well
the cheap ones rank pixels as the exact ones do.

Steps of the late phase are timed in turns within one process; peaks of memory in processes of their own.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edge_se_sampler.bench.machine import machine
from edge_se_sampler.bench.micro.samplers import peak_bytes
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.config import MachineConfig
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.session import prepare
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.methods import method_configs

SCORINGS = ("fine", "coarse", "cached")
COMPARED = 4096
"""Pixels whose scores are ranked."""


def bench_scoring(data: Path, size: str, rays: int, rounds: int, learning: int) -> dict[str, Any]:
    """Measure on a Blender folder.

    Args:
        data: a scene.
        size: of the dense networks.
        rays: of a step.
        rounds: of timed steps; medians are reported.
        learning: iterations before rankings are compared.
    """
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        trainers = {"random": _trainer("vanilla-nerf", "fine", data, place, size, rays)}
        trainers |= {how: _trainer("se-nerf", how, data, place, size, rays) for how in SCORINGS}
        times = _timed(trainers, rounds)
        learnt = _trainer("se-nerf", "cached", data, place, size, rays)
        progress = Progress(learning, "learning")
        for step in range(learning):
            learnt.train_iteration(step)
            progress.update(step + 1)
        progress.close()
        ranks = rankings(learnt, learning)
    peaks = {name: peak_bytes("vanilla-nerf" if name == "random" else "se-nerf", rays, size, name) for name in trainers}
    return {
        "size": size,
        "rays": rays,
        "rounds": rounds,
        "learning": learning,
        "milliseconds": {name: 1e3 * value for name, value in times.items()},
        "time_against_random": {name: times[name] / times["random"] for name in SCORINGS},
        "memory_against_random": {name: peaks[name] / peaks["random"] for name in SCORINGS},
        "rank_correlation_with_exact": ranks,
        "machine": machine(),
    }


def _trainer(method: str, scoring: str, data: Path, place: Path, size: str, rays: int) -> Trainer:
    """A dense training whose late phase begins at once."""
    config = method_configs()[method]
    manager = config.pipeline.datamanager
    sampler = replace(manager.pixel_sampler, early_fraction=0.0, error_source=scoring)
    manager = replace(manager, train_num_rays_per_batch=rays, pixel_sampler=sampler)
    pipeline = replace(config.pipeline, datamanager=manager, model=replace(config.pipeline.model, size=size))
    return prepare(
        replace(config, data=data, output_dir=place, pipeline=pipeline, machine=MachineConfig(device_type="cpu"))
    )


def _timed(trainers: dict[str, Trainer], rounds: int) -> dict[str, float]:
    """Median seconds of a step of each, taken in turns; the first round does not count."""
    times: dict[str, list[float]] = {name: [] for name in trainers}
    progress = Progress(rounds + 1, "timing")
    for step in range(rounds + 1):
        for name, trainer in trainers.items():
            began = time.perf_counter()
            trainer.train_iteration(step)
            times[name].append(time.perf_counter() - began)
        progress.update(step + 1)
    progress.close()
    return {name: statistics.median(values[1:]) for name, values in times.items()}


def rankings(trainer: Trainer, step: int) -> dict[str, float]:
    """Spearman's correlation of cheap scores with the exact ones, over pixels drawn uniformly from all images."""
    manager, model = trainer.pipeline.datamanager, trainer.pipeline.model
    memory = manager.train_pixel_sampler.memory
    images = manager.image_batch["image"]
    rng = np.random.default_rng(0)
    numbers = rng.integers(len(images), size=COMPARED)
    pixels = [(n, *rng.integers(images[n].shape[:2])) for n in numbers.tolist()]
    indices = torch.tensor(pixels)
    rays = manager.cameras.pixel_rays(indices)
    image = torch.stack([images[n][row, column] for n, row, column in pixels]).float() / 255
    scores: dict[str, list[torch.Tensor]] = {"fine": [], "coarse": []}
    model.eval()
    with torch.no_grad():
        for rows in model.chunks(len(rays)):
            outputs = model(rays[rows])
            for level, told in scores.items():
                told.append(model.squared_error(outputs, image[rows], level))
    exact, coarse = (torch.cat(told).numpy() for told in scores.values())
    remembered = memory.recall(indices.numpy(), step, manager.train_pixel_sampler.num_rays_per_batch)
    return {"coarse": spearman(exact, coarse), "cached": spearman(exact, remembered)}


def spearman(first: np.ndarray, second: np.ndarray) -> float:
    """Correlation of the ranks of two sets of scores; ties share their mean rank."""
    ranks = []
    for scores in (first, second):
        _, place, count = np.unique(scores, return_inverse=True, return_counts=True)
        ranks.append((count.cumsum() - (count - 1) / 2)[place])
    return float(np.corrcoef(np.stack(ranks))[0, 1])


def scene_in(workplace: Path, scene: str) -> Path:
    """A synthetic scene, made if it is not there."""
    data = workplace / "scenes" / scene
    if not data.exists():
        make_scenes(data.parent, [scene])
    return data


def table_of(result: dict[str, Any]) -> str:
    """The result as lines to read."""
    times, memory, ranks = (
        result[key] for key in ("time_against_random", "memory_against_random", "rank_correlation_with_exact")
    )
    lines = [f"{result['size']} networks, {result['rays']} rays, against Random's step"]
    for name in SCORINGS:
        rank = f", ranks as exact scores do: {ranks[name]:.2f}" if name in ranks else ""
        lines.append(f"  {name:<7} {times[name]:.2f} x the time, {memory[name]:.2f} x the memory{rank}")
    return "\n".join(lines)
