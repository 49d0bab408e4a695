"""The methods with this pixel sampler that `ns-train` offers.

Must not import nerfstudio.configs.method_configs, which loads this module by its entry points.
"""
# pyright: reportMissingImports=false
# nerfstudio's pins rule out the environment that is linted; here its classes count as unknown

from __future__ import annotations

from dataclasses import replace
from typing import Any

from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig, RAdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.nerfacto import NerfactoModelConfig
from nerfstudio.models.vanilla_nerf import NeRFModel, VanillaModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from edge_se_sampler.methods import STRATEGIES, lean_nerf
from edge_se_sampler.models.config import LEAN_PRESETS
from edge_se_sampler.nerfstudio.datamanager import EdgeSEDataManagerConfig
from edge_se_sampler.nerfstudio.lean_datamanager import LeanDataManagerConfig, LeanPixelSamplerConfig
from edge_se_sampler.nerfstudio.lean_model import GROUP, LeanNerfModelConfig, RowAdamConfig
from edge_se_sampler.nerfstudio.pixel_sampler import EdgeSEPixelSamplerConfig


def _nerf(name: str) -> MethodSpecification:
    """One of the paper's strategies on the settings of nerfstudio's vanilla-nerf."""
    early, late, description = STRATEGIES[name]
    sampler = EdgeSEPixelSamplerConfig(early=early, late=late)  # pyright: ignore[reportArgumentType]
    manager = EdgeSEDataManagerConfig(dataparser=BlenderDataParserConfig(), pixel_sampler=sampler)
    optimizers = {
        group: {"optimizer": RAdamOptimizerConfig(lr=5e-4, eps=1e-08), "scheduler": None}
        for group in ("fields", "temporal_distortion")
    }
    pipeline = VanillaPipelineConfig(datamanager=manager, model=VanillaModelConfig(_target=NeRFModel))
    config = TrainerConfig(method_name=name, pipeline=pipeline, optimizers=optimizers)
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
                dataparser=NerfstudioDataParserConfig(), train_num_rays_per_batch=4096, eval_num_rays_per_batch=4096
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


def _lean_nerf() -> MethodSpecification:
    """The standalone program's method, with its settings for images of more than 256 pixels."""
    standalone, preset = lean_nerf(), LEAN_PRESETS["paper"]
    parts, adam = standalone.config.pipeline, replace(standalone.config.optimizer, lr=preset.learning_rate)
    manager = LeanDataManagerConfig(
        dataparser=NerfstudioDataParserConfig(),
        train_num_rays_per_batch=preset.rays,
        pixel_sampler=LeanPixelSamplerConfig(**vars(parts.datamanager.pixel_sampler)),
    )
    config = TrainerConfig(
        method_name="lean-nerf",
        max_num_iterations=preset.iterations,
        steps_per_save=2000,
        pipeline=VanillaPipelineConfig(datamanager=manager, model=LeanNerfModelConfig(lean=parts.model)),
        optimizers={GROUP: {"optimizer": RowAdamConfig(**vars(adam)), "scheduler": None}},
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    )
    return MethodSpecification(config, standalone.description)


METHODS = {name: _nerf(name) for name in STRATEGIES if name != "vanilla-nerf"}
METHODS |= {"edge-se-nerfacto": _nerfacto(), "lean-nerf": _lean_nerf()}
"""By name. vanilla-nerf is left out: nerfstudio has it, and a plugin's would silently replace it."""
