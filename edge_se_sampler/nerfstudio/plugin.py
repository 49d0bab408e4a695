"""Important-pixel sampling for nerfstudio's data manager, and the methods that `ns-train` offers with it.

Must not import nerfstudio.configs.method_configs, which loads this module by its entry points.
"""
# pyright: reportMissingImports=false
# nerfstudio's pins rule out the environment that is linted; here its classes count as unknown

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from typing import Any

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.optimizers import AdamOptimizerConfig, RAdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.nerfacto import NerfactoModelConfig
from nerfstudio.models.vanilla_nerf import NeRFModel, VanillaModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification
from torch import Tensor, nn

from edge_se_sampler.datamanager import SamplerHooks
from edge_se_sampler.edges import WHITE
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import STRATEGIES
from edge_se_sampler.nerfstudio.pixel_sampler import EdgeSEPixelSamplerConfig
from edge_se_sampler.pixel_sampler import ImportantPixels
from edge_se_sampler.sampling_settings import SamplingSettings

BLACK = (0.0, 0.0, 0.0)


class EdgeSEDataManager(SamplerHooks, VanillaDataManager):
    """nerfstudio's data manager, its training sampler bound to the run. Evaluation keeps nerfstudio's own sampler."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # a buffer goes into nerfstudio's checkpoint: a resumed run has another max_num_iterations, but the same plan
        self.register_buffer("planned_steps", torch.zeros((), dtype=torch.int64))

    def _get_pixel_sampler(self, dataset: Any, num_rays_per_batch: int) -> Any:
        """The sampler of the training or the evaluation images; the config that both share stays as it is."""
        shared = self.config.pixel_sampler
        important = isinstance(shared, SamplingSettings)
        if important and self.config.patch_size > 1:
            raise InputError(f"patch-size is {self.config.patch_size}: important pixels are not drawn in patches")
        evaluation = dataset is not self.train_dataset
        self.config.pixel_sampler = _plain(shared) if important and evaluation else copy.copy(shared)
        try:
            return super()._get_pixel_sampler(dataset, num_rays_per_batch)
        finally:
            self.config.pixel_sampler = shared

    def get_training_callbacks(self, training_callback_attributes: Any) -> list[Any]:
        """nerfstudio's callbacks and ours; called once the checkpoint, if there is one, has been loaded."""
        if isinstance(self.train_pixel_sampler, ImportantPixels):
            self.train_pixel_sampler.background = shade_behind(training_callback_attributes.pipeline.model)
        return super().get_training_callbacks(training_callback_attributes)

    def plan(self, trainer: Any) -> dict[str, int]:
        """The first run's number of steps, and a seed for each process of a distributed run."""
        if not self.planned_steps:
            self.planned_steps.fill_(trainer.config.max_num_iterations)
        machine = trainer.config.machine
        rank = machine.machine_rank * machine.num_devices + self.local_rank
        return {"planned_steps": int(self.planned_steps), "seed": machine.seed + (rank << 32)}

    def before_iteration(self, func: Any) -> TrainingCallback:
        """func(step=...) before every training iteration."""
        return TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], func)

    def ray_errors(self, model: Any, ray_bundle: Any, batch: dict[str, Tensor]) -> Tensor:
        """(n,) squared errors of the model's fine colours, compared as its loss compares them."""
        with _scoring(model):
            outputs = model(ray_bundle)
        level = next((level for level in ("", "_fine") if f"rgb{level}" in outputs), None)
        if level is None:
            raise InputError(f"{type(model).__name__} renders neither rgb nor rgb_fine: late 'se' cannot score it")
        colors = outputs[f"rgb{level}"]
        image = batch["image"].to(colors.device)
        accumulation = outputs.get(f"accumulation{level}")
        renderer: Any = getattr(model, "renderer_rgb", None)
        if accumulation is not None and hasattr(renderer, "blend_background_for_loss_computation"):
            colors, image = renderer.blend_background_for_loss_computation(
                pred_image=colors, pred_accumulation=accumulation, gt_image=image
            )
        return (colors - image[:, :3]).square().sum(dim=1)


def shade_behind(model: Any) -> tuple[float, float, float]:
    """What the model's loss composites RGBA images on; a random background has no edge of its own, and counts as
    white. Without alpha the data parser has composited them already, and this is of no account."""
    background: Any = getattr(getattr(model, "renderer_rgb", None), "background_color", None)
    if isinstance(background, Tensor):
        red, green, blue = background.tolist()
        return red, green, blue
    return BLACK if background in ("black", "last_sample") else WHITE


def _plain(shared: PixelSamplerConfig) -> PixelSamplerConfig:
    """nerfstudio's own uniform sampler with the settings of ours that it knows."""
    known = {f.name: getattr(shared, f.name) for f in fields(PixelSamplerConfig) if f.name != "_target"}
    return PixelSamplerConfig(**known)


@contextmanager
def _scoring(model: nn.Module) -> Iterator[None]:
    """Render as training does, pose corrections and all, and leave no trace.

    nerfacto's proposal sampler counts the steps since it last let gradients through; a forward pass that resets the
    counter takes the next step's turn, and the proposal networks would never be trained again.
    """
    counters = [(m, m._steps_since_update) for m in model.modules() if hasattr(m, "_steps_since_update")]
    was_training = model.training
    model.train()
    try:
        yield
    finally:
        model.train(was_training)
        for module, count in counters:
            module._steps_since_update = count


@dataclass
class EdgeSEDataManagerConfig(VanillaDataManagerConfig):
    """nerfstudio's data manager with important-pixel sampling; it suits any method whose model takes rays."""

    _target: type = field(default_factory=lambda: EdgeSEDataManager)
    pixel_sampler: EdgeSEPixelSamplerConfig = field(default_factory=EdgeSEPixelSamplerConfig)
    """Which pixels are trained on."""


def _nerf(name: str) -> MethodSpecification:
    """One of the paper's strategies on the settings of nerfstudio's vanilla-nerf."""
    early, late, description = STRATEGIES[name]
    sampler = EdgeSEPixelSamplerConfig(early=early, late=late)  # pyright: ignore[reportArgumentType]
    optimizer = RAdamOptimizerConfig(lr=5e-4, eps=1e-08)
    config = TrainerConfig(
        method_name=name,
        pipeline=VanillaPipelineConfig(
            datamanager=EdgeSEDataManagerConfig(dataparser=BlenderDataParserConfig(), pixel_sampler=sampler),
            model=VanillaModelConfig(_target=NeRFModel),
        ),
        optimizers={
            "fields": {"optimizer": optimizer, "scheduler": None},
            "temporal_distortion": {"optimizer": copy.copy(optimizer), "scheduler": None},
        },
    )
    return MethodSpecification(config, description)


def _nerfacto() -> MethodSpecification:
    """Edge + SE on the settings of nerfstudio's nerfacto."""

    def adam(lr: float, lr_final: float, max_steps: int) -> dict[str, Any]:
        scheduler = ExponentialDecaySchedulerConfig(lr_final=lr_final, max_steps=max_steps)
        return {"optimizer": AdamOptimizerConfig(lr=lr, eps=1e-15), "scheduler": scheduler}

    config = TrainerConfig(
        method_name="edge-se-nerfacto",
        steps_per_eval_batch=500,
        steps_per_save=2000,
        max_num_iterations=30000,
        mixed_precision=True,
        pipeline=VanillaPipelineConfig(
            datamanager=EdgeSEDataManagerConfig(
                dataparser=NerfstudioDataParserConfig(),
                train_num_rays_per_batch=4096,
                eval_num_rays_per_batch=4096,
            ),
            model=NerfactoModelConfig(
                eval_num_rays_per_chunk=1 << 15,
                average_init_density=0.01,
                camera_optimizer=CameraOptimizerConfig(mode="SO3xR3"),
            ),
        ),
        optimizers={
            "proposal_networks": adam(1e-2, 1e-4, 200000),
            "fields": adam(1e-2, 1e-4, 200000),
            "camera_opt": adam(1e-3, 1e-4, 5000),
        },
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    )
    return MethodSpecification(config, "Nerfacto, its pixels drawn by edge strength first, then by squared error")


METHODS = {name: _nerf(name) for name in STRATEGIES if name != "vanilla-nerf"} | {"edge-se-nerfacto": _nerfacto()}
"""By name. vanilla-nerf is left out: nerfstudio has it, and a plugin's would silently replace it."""
