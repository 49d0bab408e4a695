"""One training of the map, and how it ended, of the coarse and of the fine network.

share   error on the object as a share of an empty scene's
"""

from __future__ import annotations

import contextlib
import io
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.bench.outcome import outcome
from edge_se_sampler.bench.stability.scenes import COLORS, background_of, views
from edge_se_sampler.bench.stability.settings import STRATEGIES, Cell, Point, points
from edge_se_sampler.engine.config import MachineConfig, TrainerConfig
from edge_se_sampler.engine.evaluation import Picture, pictures_of, render_rays
from edge_se_sampler.engine.files import png_bytes, write_atomically
from edge_se_sampler.engine.metrics import psnr
from edge_se_sampler.engine.pipeline import Pipeline, build_model
from edge_se_sampler.engine.reinitialization import dead_networks
from edge_se_sampler.engine.resolve import resolve_config
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.session import keep_freed_memory
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models.config import NeRFModelConfig
from edge_se_sampler.models.nerf import NeRFModel
from edge_se_sampler.models.ray_model import target_colors

Ending = Literal["learnt", "slow", "dead at the start", "killed by the data", "opaque background"]
LEARNING_RATE = 3e-3
LOOKS = 10
"""So often a training is looked at."""


@dataclass(frozen=True)
class Scale:
    """How large the trainings are."""

    iterations: int = 300
    rays: int = 64
    width: int = 64
    samples: int = 16
    """Coarse ones, and as many importance samples."""


@dataclass(frozen=True)
class Measured:
    """What a network shows of held-out views."""

    share: float
    psnr: float
    background_psnr: float
    """Of the empty scene."""
    accumulation: float
    """Mean opacity of the rays that meet nothing."""


def ending(measured: Measured, dead_at_start: bool) -> Ending:
    """How a training ended.

    As `outcome` has it; where nothing was learnt, it began without a gradient, or is empty, or hides everything
    behind an opaque background.
    """
    rough = outcome(measured.psnr, measured.background_psnr, measured.share)
    if rough != "background":
        return rough
    if dead_at_start:
        return "dead at the start"
    return "opaque background" if measured.accumulation > 0.5 else "killed by the data"


def trainer_of(point: Point, strategy: str, seed: int, scale: Scale, folder: Path) -> tuple[Trainer, list[Picture]]:
    """A point's training, about to begin, and its held-out views."""
    chosen = STRATEGIES[strategy]
    train, test = views(point.foreground, point.placement == "shifted", 40)
    model = NeRFModelConfig(
        "tiny", width=scale.width, depth=point.depth, num_coarse_samples=scale.samples,
        num_importance_samples=scale.samples, density_activation=point.activation,
        initialization=point.initialization, density_noise=point.noise,
        background_color="random" if point.background == "random" else "white",
    )  # fmt: skip
    config: TrainerConfig = method_configs()["edge-se-nerf"]
    settings: dict[str, Any] = {"early": chosen.early, "late": chosen.late, "schedule": chosen.schedule}
    sampler = replace(config.pipeline.datamanager.pixel_sampler, **settings)
    manager = replace(config.pipeline.datamanager, train_num_rays_per_batch=scale.rays, pixel_sampler=sampler)
    config = replace(
        config,
        output_dir=folder,
        experiment_name="stability",
        max_num_iterations=scale.iterations,
        machine=MachineConfig(seed=seed, device_type="cpu"),
        optimizer=replace(config.optimizer, lr=LEARNING_RATE * point.rate),
        pipeline=replace(config.pipeline, datamanager=manager, model=model),
        reinit_dead=chosen.reinit_dead,
    )
    train = train.subset(range(point.views))
    config = resolve_config(config, train)
    in_front_of = COLORS.get(point.background, COLORS["white"])
    datamanager = config.pipeline.datamanager.setup(views=train, device="cpu", background_color=in_front_of)
    pipeline = Pipeline(datamanager, build_model(config, "cpu"))
    pipeline.model.background_fn = background_of(point.background)
    return config.setup(run=RunFolder.create(config), pipeline=pipeline, preview=None), pictures_of(test)


def run_cell(cell: Cell, scale: Scale, views_folder: Path) -> dict[str, Any]:
    """Train a cell and judge it; runs in a process of its own.

    Returns:
        its place, of each network how it ended and what it shows, the fine one's share at LOOKS times, how many
        networks began anew, CPU seconds. A failed one's portrait goes to views_folder.
    """
    torch.set_num_threads(1)
    keep_freed_memory()
    point = points()[cell.point]
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        trainer, pictures = trainer_of(point, cell.strategy, cell.seed, scale, Path(folder))
        model = trainer.pipeline.model
        probe = [picture.rays(model.device)[::2] for picture in pictures]
        dead, shares = dead_networks(model, probe), []
        for step in range(scale.iterations):
            trainer.train_iteration(step)
            if (step + 1) % max(1, scale.iterations // LOOKS) == 0:
                shares.append(round(measured(model, pictures, stride=5)["fine"].share, 4))
        revived = 0 if trainer.dead_network_reset is None else trainer.dead_network_reset.used_sub_seeds
    told: dict[str, Any] = {}
    for level, shown in measured(model, pictures).items():
        told |= {f"{level}_ending": ending(shown, level in dead)}
        told |= {f"{level}_{key}": round(value, 4) for key, value in asdict(shown).items()}
    if told["fine_ending"] != "learnt":
        views_folder.mkdir(parents=True, exist_ok=True)
        write_atomically(views_folder / f"{cell.name}.png", png_bytes(portrait(model, pictures[0])))
    return {
        **asdict(cell),
        **point.changes,
        "outcome": told["fine_ending"],
        **told,
        "dead_at_start": dead,
        "revived": revived,
        "shares": shares,
        "cpu_seconds": round(time.process_time() - began, 2),
    }


def portrait(model: NeRFModel, picture: Picture) -> np.ndarray:
    """A held-out view, what the fine network renders of it, and its opacity, side by side: (H, 3 W, 3) in [0, 1]."""
    height, width, channels = picture.image.shape
    rays = picture.rays(model.device)
    rendered, opacity, background = (
        render_rays(model, rays, key) for key in ("rgb_fine", "accumulation_fine", "background")
    )
    truth = target_colors(torch.from_numpy(picture.image).reshape(-1, channels), background)
    panels = [panel.expand(-1, 3).reshape(height, width, 3) for panel in (truth, rendered, opacity)]
    return torch.cat(panels, dim=1).clamp(0, 1).numpy()


@torch.no_grad()
def measured(model: NeRFModel, pictures: list[Picture], stride: int = 1) -> dict[str, Measured]:
    """The coarse and the fine network against the held-out views, every stride-th pixel."""
    was_training = model.training
    model.eval()
    images = [torch.from_numpy(picture.image).reshape(-1, 4)[::stride] for picture in pictures]
    errors, accumulations = ({level: [] for level in model.networks} for _ in range(2))
    distances = []
    for picture, image in zip(pictures, images, strict=True):
        rays = picture.rays(model.device)[::stride]
        for rows in model.chunks(len(rays)):
            outputs = model(rays[rows])
            away = target_colors(image[rows], outputs["background"]) - outputs["background"]
            distances.append(away.square().sum(dim=1))
            for level in model.networks:
                errors[level].append(model.squared_error(outputs, image[rows], level))
                accumulations[level].append(outputs[f"accumulation_{level}"][:, 0])
    model.train(was_training)
    distance, inside = torch.cat(distances), torch.cat(images)[:, 3] > 0
    return {
        level: _measured(torch.cat(errors[level]), torch.cat(accumulations[level]), distance, inside)
        for level in model.networks
    }


def _measured(error: Tensor, accumulation: Tensor, distance: Tensor, inside: Tensor) -> Measured:
    return Measured(
        share=float(error[inside].sum() / distance[inside].sum()),
        psnr=psnr(float(error.mean() / 3)),
        background_psnr=psnr(float(distance.mean() / 3)),
        accumulation=float(accumulation[~inside].mean()),
    )
