"""A training of an experiment: its scene, and what is measured of it."""

from __future__ import annotations

import contextlib
import io
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edge_se_sampler.bench.outcomes import measure_outcome
from edge_se_sampler.bench.results import Run
from edge_se_sampler.data.new_folder import unless_made_meanwhile
from edge_se_sampler.data.offcenter import offcenter
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.evaluation import evaluate
from edge_se_sampler.engine.files import write_image
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.reinitialization import dead_networks
from edge_se_sampler.engine.rendering import to_pictures
from edge_se_sampler.engine.session import prepare, read_test_views


def cached_scene(workplace: Path, name: str, **options: Any) -> Path:
    """The Blender folder of a synthetic scene in workplace/scenes, rendered if it is not there. Options are those of
    `make_scenes`, whose errors it raises; scenes of other options lie in other folders."""
    words = [f"{key}-{value}" for key, value in sorted(options.items())]
    folder = workplace / "scenes" / ("_".join(words) or "default")
    if not (folder / name).exists():
        with unless_made_meanwhile(folder / name), Progress(0, f"rendering {name}") as progress:
            make_scenes(folder, [name], progress=progress.update, **options)
    return folder / name


def offcenter_copies(scene: Path, workplace: Path) -> Path:
    """The folder of a Blender folder's copies by `offcenter`, "centered" and "shifted", in workplace/offcenter, made if
    missing; raises as `offcenter`."""
    folder = workplace / "offcenter" / Path(*scene.resolve().parts[1:])
    if not folder.exists():
        with unless_made_meanwhile(folder), Progress(0, f"moving {scene.name} off center") as progress:
            offcenter(scene, folder, progress=progress.update)
    return folder


def train_and_measure(config: TrainerConfig, view_path: Path | None = None) -> Run:
    """Train a config on one thread, and measure it on its test views, the first of which is written to view_path (PNG).

    Returns:
        the measures of `evaluate` and of `measure_outcome`; which networks were dead before the first step, and how
        often one was reinitialized; steps, seconds and CPU seconds of training.
    """
    torch.set_num_threads(1)  # there are as many trainings at once as cores
    with contextlib.redirect_stderr(io.StringIO()):  # progress bars of several processes would mix
        trainer = prepare(config)
        pictures, model = to_pictures(read_test_views(trainer.config)), trainer.pipeline.model
        dead = dead_networks(model, [picture.rays(model.device)[::4] for picture in pictures])
        start = time.process_time()
        trainer.train()
    cpu_seconds = time.process_time() - start
    if trainer.stop_requested:
        raise KeyboardInterrupt
    views: list[np.ndarray] = []
    results = evaluate(model, pictures, lambda _, __, rendered: views.append(rendered))
    if view_path is not None:
        view_path.parent.mkdir(parents=True, exist_ok=True)
        write_image(view_path, views[0])
    return {
        **measure_outcome(results["images"], pictures, model.config.background_level),
        **{key: results[key] for key in ("foreground_psnr", "edge_band_psnr", "background_mse")},
        "dead_at_start": dead,
        "reinitialized": sum("reinitialized" in line for line in trainer.run.metrics()),
        "steps": trainer.next_step,
        "seconds": round(trainer.elapsed, 3),
        "cpu_seconds": round(cpu_seconds, 3),
    }
