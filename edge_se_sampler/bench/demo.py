"""`edge-se demo`: Random against Edge + SE on an off-centre, mostly white scene, from the same initial weights."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from edge_se_sampler import __version__
from edge_se_sampler.bench.machine import machine
from edge_se_sampler.data.made.folder import make_scenes
from edge_se_sampler.engine.checkpoint import write_atomically
from edge_se_sampler.engine.config import MachineConfig
from edge_se_sampler.engine.evaluation import evaluate, psnr, shade_behind, target_image
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.run_folder import config_to_json
from edge_se_sampler.engine.session import prepare, test_pictures
from edge_se_sampler.methods import registered_methods
from edge_se_sampler.show import require_pyplot, save_figure

SCENE = "mic"
OFFSET = (0.2, 0.15)
SIZE = 100
ITERATIONS = 600
METHODS = {"vanilla-nerf": "Random", "edge-se-nerf": "Edge + SE"}
COLORS = {"vanilla-nerf": "#7f7f7f", "edge-se-nerf": "#d62728"}


@dataclass(frozen=True)
class Outcome:
    """One method's training."""

    method: str
    seconds: float
    loss: list[dict[str, Any]]
    validation: list[dict[str, Any]]
    results: dict[str, Any]
    picture: np.ndarray


def demo(output_dir: Path, seed: int) -> list[Outcome]:
    """Make the scene, train both methods, and leave demo.png and demo.json in output_dir, the runs in demo/.

    Raises:
        InputError: output_dir cannot be written, or matplotlib is missing.
    """
    require_pyplot()
    began = time.monotonic()
    workplace = output_dir / "demo"
    scene = workplace / f"{SCENE}-off-centre"
    if not scene.exists():
        progress = Progress(50 + 1 + 10, f"making {scene.name}")
        made = make_scenes(
            workplace / "scenes-tmp", [SCENE], size=SIZE, num_train=50, num_val=1, num_test=10, placement="shifted",
            offset=OFFSET, progress=lambda done, _: progress.update(done),
        )  # fmt: skip
        progress.close()
        made[0].rename(scene)
        made[0].parent.rmdir()
    outcomes = [_train(method, scene, workplace, seed) for method in METHODS]
    target, background = _ground_truth(scene, workplace, outcomes)
    _write_json(output_dir / "demo.json", outcomes, background, seed, time.monotonic() - began)
    _draw(output_dir / "demo.png", outcomes, target, background, seed)
    return outcomes
