"""One cell of the paper's tables: a method, a placement, a scene, a strategy and a seed, trained and measured."""

from __future__ import annotations

import contextlib
import io
import time
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

import torch

from edge_se_sampler.bench.outcome import background_measures, foreground_share, outcome
from edge_se_sampler.bench.paper.published import SCENES, STRATEGIES
from edge_se_sampler.engine.config import MachineConfig, TrainerConfig
from edge_se_sampler.engine.evaluation import evaluate, shade_behind
from edge_se_sampler.engine.session import prepare, test_pictures
from edge_se_sampler.methods import registered_methods
from edge_se_sampler.nerf.config import InfoNeRFModelConfig

Method = Literal["nerf", "info-nerf"]
Placement = Literal["centered", "shifted"]
TABLES: dict[int, tuple[Method, Placement]] = {
    1: ("nerf", "centered"),
    2: ("nerf", "shifted"),
    3: ("info-nerf", "centered"),
    4: ("info-nerf", "shifted"),
}
FEW_VIEWS = 10
"""InfoNeRF trains on so many."""


@dataclass(frozen=True)
class Preset:
    """How large the experiment is."""

    size: Literal["paper", "small", "tiny"]
    iterations: int
    info_iterations: int
    rays: int
    image_size: int | None = None
    """Of made scenes; None: the data is given."""
    num_train: int = 50
    num_test: int = 4


PRESETS = {
    "cpu": Preset("tiny", iterations=400, info_iterations=300, rays=256, image_size=64),
    # section 4.1 of the paper: 200,000 iterations, 50,000 for InfoNeRF, 1024 rays
    "paper": Preset("paper", iterations=200_000, info_iterations=50_000, rays=1024),
}


@dataclass(frozen=True)
class Cell:
    """Where a cell stands."""

    table: int
    scene: str
    strategy: str
    seed: int

    @property
    def name(self) -> str:
        """A name for its folder."""
        return f"table-{self.table}-{self.scene}-{self.strategy}-{self.seed}"


def cells(
    tables: tuple[int, ...], scenes: tuple[str, ...], strategies: tuple[str, ...], seeds: tuple[int, ...]
) -> list[Cell]:
    """All cells asked for, seed by seed, so that an unfinished experiment is a smaller one."""
    every = product(seeds, tables or tuple(TABLES), scenes or SCENES, strategies or STRATEGIES)
    return [Cell(table, scene, strategy, seed) for seed, table, scene, strategy in every]


def config_of(cell: Cell, preset: Preset, data: Path, output_dir: Path) -> TrainerConfig:
    """What a cell trains: dense and faithful, nothing culled."""
    method, _ = TABLES[cell.table]
    config = registered_methods()[cell.strategy].specification.config
    manager = replace(config.pipeline.datamanager, train_num_rays_per_batch=preset.rays)
    model = InfoNeRFModelConfig() if method == "info-nerf" else config.pipeline.model
    iterations = preset.info_iterations if method == "info-nerf" else preset.iterations
    return replace(
        config,
        data=data,
        output_dir=output_dir,
        experiment_name=cell.name,
        num_views=FEW_VIEWS if method == "info-nerf" else None,
        max_num_iterations=iterations,
        steps_per_save=iterations,
        steps_per_log=max(1, iterations // 100),
        machine=MachineConfig(seed=cell.seed, device_type="auto"),
        pipeline=replace(config.pipeline, datamanager=manager, model=replace(model, size=preset.size)),
    )


def run_cell(cell: Cell, preset: Preset, data: Path, output_dir: Path, threads: int) -> dict[str, Any]:
    """Train a cell and measure it; runs in a process of its own.

    Returns:
        its place, psnr and the other measures, outcome, seconds, CPU seconds, steps, and the training loss's curve.
    """
    torch.set_num_threads(threads)
    with contextlib.redirect_stderr(io.StringIO()):  # its progress: several cells write to one terminal
        trainer = prepare(config_of(cell, preset, data, output_dir))
        began = time.process_time()
        trainer.train()
    cpu_seconds = time.process_time() - began
    if trainer.stop_requested:
        raise KeyboardInterrupt
    pictures, model = test_pictures(trainer.config), trainer.pipeline.model
    results = evaluate(model, pictures)
    background = background_measures(pictures, shade_behind(model))
    background_psnr = sum(alone["psnr"] or 0.0 for alone in background) / len(background)
    share = foreground_share(results, background)
    method, placement = TABLES[cell.table]
    return {
        **asdict(cell),
        "method": method,
        "placement": placement,
        **{key: results[key] for key in ("psnr", "ssim", "foreground_psnr", "edge_band_psnr", "background_mse")},
        "background_psnr": background_psnr,
        "foreground_share": share,
        "outcome": outcome(results["psnr"], background_psnr, share),
        "steps": trainer.next_step,
        "seconds": trainer.elapsed,
        "cpu_seconds": cpu_seconds,
        "loss": [[line["step"], line["loss"]] for line in trainer.run.metrics() if "loss" in line],
    }
