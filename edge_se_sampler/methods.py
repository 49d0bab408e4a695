"""The named methods: the paper's six strategies on NeRF, two on InfoNeRF, lean-nerf, and those of other packages.
Torch-free.

A package adds a method by an entry point of the group edge_se_sampler.method_configs that names an
`engine.config.MethodSpecification`.
"""

from __future__ import annotations

import sys
from importlib.metadata import entry_points
from typing import NamedTuple

from edge_se_sampler.data.config import VanillaDataManagerConfig
from edge_se_sampler.engine.config import MethodSpecification, OptimizerConfig, PipelineConfig, TrainerConfig
from edge_se_sampler.models.config import InfoNeRFModelConfig, LeanModelConfig, NeRFModelConfig
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig

ENTRY_POINT_GROUP = "edge_se_sampler.method_configs"

STRATEGIES = {
    "vanilla-nerf": ("uniform", "uniform", "Random: NeRF with pixels drawn uniformly"),
    "precrop-nerf": ("precrop", "uniform", "Precrop + Random: the center of the image first"),
    "se-nerf": ("uniform", "se", "SE: uniform first, then by the rank of the squared error"),
    "precrop-se-nerf": ("precrop", "se", "Precrop + SE: the center first, then by squared error"),
    "edge-nerf": ("edge", "uniform", "Edge: by edge strength first, then uniformly"),
    "edge-se-nerf": ("edge", "se", "Edge + SE: by edge strength first, then by squared error"),
}
"""Method -> early, late, description: table 1 of the paper."""


def _nerf(name: str, model: NeRFModelConfig, early: str, late: str, description: str) -> MethodSpecification:
    sampler = EdgeSEPixelSamplerConfig(early=early, late=late)  # pyright: ignore[reportArgumentType]
    pipeline = PipelineConfig(datamanager=VanillaDataManagerConfig(pixel_sampler=sampler), model=model)
    return MethodSpecification(TrainerConfig(method_name=name, pipeline=pipeline), description)


def lean_nerf() -> MethodSpecification:
    """The method that is recommended."""
    sampler = EdgeSEPixelSamplerConfig(early="expansive", late="expansive", images_per_step="all")
    manager = VanillaDataManagerConfig(skip_empty_rays=True, pixel_sampler=sampler)
    adam = OptimizerConfig(eps=1e-15, beta2=0.99, warmup_steps=20, fused=True)
    config = TrainerConfig(
        method_name="lean-nerf",
        steps_per_save=5_000,
        steps_per_log=50,
        pipeline=PipelineConfig(manager, LeanModelConfig()),
        optimizer=adam,
    )
    return MethodSpecification(config, "Sparse cells as small as a pixel, only where the scene is: recommended")


class RegisteredMethod(NamedTuple):
    """A method, and the installed package that it comes from."""

    specification: MethodSpecification
    origin: str


def registered_methods() -> dict[str, RegisteredMethod]:
    """Every method by name: this package's, then those of other installed packages.

    An entry point that fails to load, is no MethodSpecification or takes a name that exists is left out with one line
    on stderr; it must not break the others.
    """
    info_nerf = "InfoNeRF: NeRF from few views (--num-views), with losses on unseen rays"
    own_methods = [
        *(_nerf(name, NeRFModelConfig(), *strategy) for name, strategy in STRATEGIES.items()),
        # the paper's other model takes the other strategies by flags
        _nerf("info-nerf", InfoNeRFModelConfig(), "uniform", "uniform", info_nerf),
        _nerf("edge-se-info-nerf", InfoNeRFModelConfig(), "edge", "se", "Edge + SE on InfoNeRF"),
        lean_nerf(),
    ]
    methods = {method.config.method_name: RegisteredMethod(method, "edge_se_sampler") for method in own_methods}
    for entry in sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda entry: entry.name):
        origin = entry.dist.name if entry.dist else entry.value
        try:
            specification = entry.load()
            if not isinstance(specification, MethodSpecification):
                raise TypeError(f"{entry.value} is not a MethodSpecification")
            name = specification.config.method_name
            if name in methods:
                raise ValueError(f"the name {name!r} is taken by {methods[name].origin}")
        except Exception as problem:  # whatever another package's import may raise
            print(f"edge-se: method {entry.name!r} of {origin} left out: {problem}", file=sys.stderr)
            continue
        methods[name] = RegisteredMethod(specification, origin)
    return methods


def method_configs() -> dict[str, TrainerConfig]:
    """The default settings of every registered method, by its name."""
    return {name: method.specification.config for name, method in registered_methods().items()}
