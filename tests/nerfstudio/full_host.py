"""nerfstudio 1.1.5 as a whole, made small: a scene, LPIPS weights to load, and trainers of a few quick steps."""
# pyright: reportMissingImports=false
# nerfstudio's pins rule out the environment that is linted

from __future__ import annotations

import inspect
import os
from pathlib import Path
from typing import Any

import torch

from edge_se_sampler.bench.nerfstudio.host import build_config, build_trainer

RAYS = 33
"""Odd, and no divisor of anything."""
PLANNED = 20


def config_of(
    name: str, scene: Path, runs: Path, *, rays: int = RAYS, alpha: str | None = "white", **changes: Any
) -> Any:
    """A registered method's config, small, on a Blender scene and the CPU.

    Args:
        alpha: the data parser's alpha_color; None leaves RGBA images to the model.
        changes: of the trainer's config.
    """
    from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig

    config = build_config(name, 42, scene, runs)
    config.machine.device_type = "cpu"
    config.max_num_iterations = PLANNED
    manager, model = config.pipeline.datamanager, config.pipeline.model
    manager.dataparser = BlenderDataParserConfig(alpha_color=alpha)
    manager.train_num_rays_per_batch = manager.eval_num_rays_per_batch = rays
    if hasattr(model, "num_coarse_samples"):
        model.num_coarse_samples = model.num_importance_samples = 8
    elif hasattr(model, "log2_hashmap_size"):
        model.log2_hashmap_size = 10
        model.num_proposal_samples_per_ray, model.num_nerf_samples_per_ray = (16, 8), 8
    for key, value in changes.items():
        setattr(config, key, value)
    return config


def trainer_of(config: Any, test_mode: str = "val") -> Any:
    """nerfstudio's trainer, set up as `ns-train` does, or with the test views in place of val's."""
    return build_trainer(config, test_mode)


def max_num_iterations(start: int, more: int) -> int:
    """What makes nerfstudio train that many steps more: 1.1.5 counts from the start, its main branch from step 0."""
    from nerfstudio.engine.trainer import Trainer

    return start + more if "max_num_iterations - self._start_step" in inspect.getsource(Trainer.train) else more


def train(trainer: Any, steps: int) -> None:
    """Train that many steps more, whatever the run was planned for."""
    trainer.config.max_num_iterations = max_num_iterations(trainer._start_step, steps)
    trainer.train()


def watch(sampler: Any) -> list[tuple[int, str, torch.Tensor]]:
    """Step, strategy and indices of every batch that the sampler draws from now on."""
    seen: list[tuple[int, str, torch.Tensor]] = []
    sample = sampler.sample

    def watched(image_batch: dict[str, Any]) -> dict[str, Any]:
        strategy = sampler.strategy
        batch = sample(image_batch)
        seen.append((sampler._step.number, strategy, batch["indices"]))
        return batch

    sampler.sample = watched
    return seen


def without_lpips_downloads() -> None:
    """AlexNet weights where torch looks for them: random ones, so that no LPIPS of these tests means anything."""
    import torchvision

    checkpoints = Path(os.environ["TORCH_HOME"]) / "hub" / "checkpoints"
    checkpoints.mkdir(parents=True, exist_ok=True)
    torch.save(torchvision.models.alexnet(weights=None).state_dict(), checkpoints / "alexnet-owt-7be5be79.pth")
