"""One training of the sweep, and how it ends."""

from __future__ import annotations

import contextlib
import io
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from edge_se_sampler.bench.outcomes import Outcome, classify
from edge_se_sampler.bench.stability.scenes import COLORS, NUM_TRAIN, background_of, read_real_splits, render_splits
from edge_se_sampler.bench.stability.settings import SETTINGS, STRATEGIES, Setting, Trial
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.config import MANAGER, MODEL, override
from edge_se_sampler.engine.metrics import psnr
from edge_se_sampler.engine.pipeline import Pipeline, build_model
from edge_se_sampler.engine.reinitialization import dead_networks
from edge_se_sampler.engine.rendering import Picture, render_outputs, to_pictures
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.session import disable_malloc_trimming, resolve_config
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models.nerf import NeRFModel
from edge_se_sampler.models.ray_model import target_colors


@dataclass(frozen=True)
class TrainingSize:
    """How large the trainings are."""

    iterations: int = 300
    rays: int = 64
    width: int = 64
    samples: int = 16
    """Coarse ones, and as many importance samples."""


def run_trial(trial: Trial, size: TrainingSize, scene: Path | None = None) -> dict[str, Any]:
    """Train once; called in a process of its own. scene: folder of a setting's real scene.

    Returns:
        outcome and failure_mode; what `measure_views` measures; which networks were dead_at_start; how many were
        reinitialized; cpu_seconds.
    """
    torch.set_num_threads(1)
    disable_malloc_trimming()
    start = time.process_time()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        trainer, pictures = build_trainer(
            SETTINGS[trial.setting], trial.strategy, trial.seed, size, Path(folder), scene
        )
        model = trainer.pipeline.model
        dead = dead_networks(model, [picture.rays(model.device)[::2] for picture in pictures])
        for step in range(size.iterations):
            trainer.train_iteration(step)
    resets, measured = trainer.dead_network_reset, measure_views(model, pictures)
    outcome = classify(measured["psnr"], measured["background_psnr"], measured["foreground_share"])
    return {
        "outcome": outcome,
        "failure_mode": failure_mode(outcome, measured["accumulation"], "fine" in dead),
        **{key: round(value, 4) for key, value in measured.items()},
        "dead_at_start": dead,
        "reinitialized": 0 if resets is None else resets.used_sub_seeds,
        "cpu_seconds": round(time.process_time() - start, 2),
    }


def failure_mode(outcome: Outcome, accumulation: float, dead_at_start: bool) -> str | None:
    """How a network failed, if it did; dead_at_start: it had no density anywhere before the first step."""
    if outcome != "collapsed":
        return None if outcome == "converged" else outcome
    if dead_at_start:
        return "dead at the start"
    return "opaque background" if accumulation > 0.5 else "emptied"


def build_trainer(
    setting: Setting, strategy: str, seed: int, size: TrainingSize, folder: Path, scene: Path | None = None
) -> tuple[Trainer, list[Picture]]:
    """A training that is ready to begin, its run in a folder, and its held-out views."""
    train, test = _read_splits(setting, scene)
    changes = {
        "output_dir": folder,
        "experiment_name": "stability",
        "max_num_iterations": size.iterations,
        "machine.seed": seed,
        "machine.device_type": "cpu",
        "optimizer.lr": 3e-3 * setting.lr_scale,
        f"{MANAGER}.train_num_rays_per_batch": size.rays,
        f"{MODEL}.size": "tiny",
        f"{MODEL}.width": size.width,
        f"{MODEL}.num_coarse_samples": size.samples,
        f"{MODEL}.num_importance_samples": size.samples,
        f"{MODEL}.background_color": "random" if setting.background == "random" else "white",
        f"{MODEL}.depth": setting.depth,
        f"{MODEL}.density_activation": setting.density_activation,
        f"{MODEL}.initialization": setting.initialization,
        f"{MODEL}.density_noise": setting.density_noise,
        **STRATEGIES[strategy].changes,
    }
    config = resolve_config(override(method_configs()[STRATEGIES[strategy].method], changes), train)
    color = COLORS.get(setting.background, COLORS["white"])
    datamanager = config.pipeline.datamanager.setup(views=train, device="cpu", background_color=color)
    pipeline = Pipeline(datamanager, build_model(config, "cpu"))
    pipeline.model.background_fn = background_of(setting.background)
    return config.setup(run=RunFolder.create(config), pipeline=pipeline, preview=None), to_pictures(test)


def _read_splits(setting: Setting, scene: Path | None) -> tuple[Views, Views]:
    """Training and held-out views."""
    shifted = setting.placement == "shifted"
    if scene is not None:
        return read_real_splits(scene, setting.foreground, shifted, setting.num_views)
    assert setting.foreground is not None  # of real scenes alone
    train, test = render_splits(setting.foreground, shifted, NUM_TRAIN)
    return train.subset(range(setting.num_views)), test


def measure_views(model: NeRFModel, pictures: list[Picture]) -> dict[str, float]:
    """What the fine network shows of held-out views: psnr; foreground_share, the squared error on the object as a share
    of the background's alone; background_psnr, of the background alone; and accumulation, the mean opacity, in [0, 1],
    of the rays that miss the object."""
    keys = ("background", "rgb_fine", "accumulation_fine")
    views = [render_outputs(model, picture.rays(model.device), keys) for picture in pictures]
    outputs = {key: torch.cat([view[key] for view in views]) for key in keys}
    image = torch.cat([torch.from_numpy(picture.image).reshape(-1, 4) for picture in pictures])
    hits, background = image[:, 3] > 0, outputs["background"]
    error = model.squared_error(outputs, image, "fine")
    background_error = (target_colors(image, background) - background).square().sum(dim=1)
    return {
        "foreground_share": float(error[hits].sum() / background_error[hits].sum()),
        "psnr": psnr(float(error.mean() / 3)),
        "background_psnr": psnr(float(background_error.mean() / 3)),
        "accumulation": float(outputs["accumulation_fine"][~hits].mean()),
    }
