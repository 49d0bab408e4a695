"""One training of an experiment, measured: the same for every bench."""

from __future__ import annotations

import contextlib
import io
import time
from typing import Any

import numpy as np
import torch

from edge_se_sampler.bench.outcome import judged
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.evaluation import evaluate, get_background_color
from edge_se_sampler.engine.files import png_bytes
from edge_se_sampler.engine.reinitialization import dead_networks
from edge_se_sampler.engine.session import prepare, test_pictures

MEASURES = ("psnr", "ssim", "foreground_psnr", "edge_band_psnr", "background_mse")


def trial(config: TrainerConfig) -> dict[str, Any]:
    """Train a config, on one thread, and measure it on its held-out views.

    Returns:
        psnr and the other measures, outcome, which networks were dead before the first step and how many began anew,
        seconds, CPU seconds, steps, the training loss at every `loss_every`th step, and `view`, the first held-out
        view as PNG.
    """
    torch.set_num_threads(1)  # there are as many trainings at once as cores
    with contextlib.redirect_stderr(io.StringIO()):  # its progress: several write to one terminal
        trainer = prepare(config)
        pictures, model = test_pictures(trainer.config), trainer.pipeline.model
        dead = dead_networks(model, [picture.rays(model.device)[::4] for picture in pictures])
        began = time.process_time()
        trainer.train()
    cpu_seconds = time.process_time() - began
    if trainer.stop_requested:
        raise KeyboardInterrupt
    views: list[np.ndarray] = []
    results = evaluate(model, pictures, lambda _, __, rendered: views.append(rendered))
    metrics, every = trainer.run.metrics(), trainer.config.steps_per_log
    return {
        **{key: results[key] for key in MEASURES},
        **judged(results, pictures, get_background_color(model)),
        "dead_at_start": dead,
        "revived": sum("reinitialized" in line for line in metrics),
        "steps": trainer.next_step,
        "seconds": round(trainer.elapsed, 3),
        "cpu_seconds": round(cpu_seconds, 3),
        "loss_every": every,
        "loss": [_rounded(line["loss"]) for line in metrics if "loss" in line and line["step"] % every == 0],
        "strategies": _phases(metrics),
        "view": png_bytes(views[0]),
    }


def _phases(metrics: list[dict[str, Any]]) -> list[list[Any]]:
    """[step, strategy] wherever the logged strategy changed."""
    told: list[list[Any]] = []
    for line in metrics:
        if "strategy" in line and (not told or told[-1][1] != line["strategy"]):
            told.append([line["step"], line["strategy"]])
    return told


def _rounded(value: float, digits: int = 4) -> float:
    return float(f"{value:.{digits}g}")
