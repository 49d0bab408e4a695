"""What is charted: methods as they are, and one thing changed at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

from edge_se_sampler.engine.config import MachineConfig, TrainerConfig
from edge_se_sampler.methods import method_configs

Group = Literal["methods", "scorings", "sampling", "economy", "size"]
GROUPS: dict[Group, str] = {
    "methods": "Methods as they are",
    "scorings": "What scores squared errors, dense",
    "sampling": "Which pixels, lean",
    "economy": "Economy, part by part",
    "size": "How big, how fine",
}
SAMPLER, MODEL, MANAGER = "pipeline.datamanager.pixel_sampler", "pipeline.model", "pipeline.datamanager"
REMEMBERED = {f"{SAMPLER}.late": "se", f"{SAMPLER}.error_source": "cached"}
"""Squared errors at next to no cost."""


@dataclass(frozen=True)
class Variant:
    """A method, and what is changed of it."""

    group: Group
    label: str
    method: str = "lean-nerf"
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Dotted path from the method's config -> value."""


VARIANTS: dict[str, Variant] = {
    "lean": Variant("methods", "lean-nerf"),
    "random": Variant("methods", "Random", "vanilla-nerf"),
    "precrop": Variant("methods", "Precrop + Random", "precrop-nerf"),
    "se": Variant("methods", "SE", "se-nerf"),
    "precrop-se": Variant("methods", "Precrop + SE", "precrop-se-nerf"),
    "edge": Variant("methods", "Edge", "edge-nerf"),
    "edge-se": Variant("methods", "Edge + SE", "edge-se-nerf"),
    "edge-se-coarse": Variant("scorings", "Edge + SE, coarse", "edge-se-nerf", {f"{SAMPLER}.error_source": "coarse"}),
    "edge-se-memory": Variant("scorings", "Edge + SE, memory", "edge-se-nerf", {f"{SAMPLER}.error_source": "cached"}),
    "edge-se-auto": Variant("scorings", "Edge + SE, auto", "edge-se-nerf", {f"{SAMPLER}.schedule": "adaptive"}),
    "lean-se": Variant("sampling", "squared errors remembered", changes=REMEMBERED),
    "lean-se-weighted": Variant(  # Soft Mining's rule (Kheradmand et al. 2024), its exponent; its Langevin moves aside
        "sampling", "squared errors remembered, loss weighted",
        changes=REMEMBERED | {f"{SAMPLER}.importance_weight": 0.6},
    ),
    "lean-edge": Variant("sampling", "Edge first", changes={f"{SAMPLER}.early": "edge"}),
    "lean-edge-se": Variant(
        "sampling", "Edge first, then remembered errors", changes={f"{SAMPLER}.early": "edge"} | REMEMBERED
    ),
    "lean-auto": Variant(
        "sampling", "Edge while it pays, then remembered errors",
        changes={f"{SAMPLER}.early": "edge", f"{SAMPLER}.schedule": "adaptive"} | REMEMBERED,
    ),
    "lean-one-image": Variant("sampling", "one image a step", changes={f"{SAMPLER}.images_per_step": "one"}),
    "all-pixels": Variant("economy", "dead pixels too", changes={f"{MANAGER}.skip_empty_rays": False}),
    "no-hull": Variant("economy", "no hull", changes={f"{MODEL}.cull_by_alpha": False}),
    "no-hull-uniform": Variant(
        "economy", "no hull, pixels uniform",
        changes={f"{MODEL}.cull_by_alpha": False, f"{SAMPLER}.early": "uniform"},
    ),
    "no-density": Variant("economy", "no density culling", changes={f"{MODEL}.cull_by_density": False}),
    "economy-off": Variant("economy", "economy off", changes={f"{MODEL}.empty_space_skipping": False}),
    "no-features": Variant(
        "economy", "no features: 4 x 96 network",
        changes={f"{MODEL}.feature_dim": 0, f"{MODEL}.depth": 4, f"{MODEL}.width": 96},
    ),
    "two-networks": Variant(
        "economy", "coarse and fine network in the hull", "vanilla-nerf",
        {
            f"{MODEL}.empty_space_skipping": True, f"{MANAGER}.skip_empty_rays": True,
            f"{SAMPLER}.images_per_step": "all",
        },
    ),
    "width-32": Variant("size", "32 wide", changes={f"{MODEL}.width": 32}),
    "width-128": Variant("size", "128 wide", changes={f"{MODEL}.width": 128}),
    "depth-2": Variant("size", "2 layers", changes={f"{MODEL}.depth": 2}),
    "features-4": Variant("size", "4 features", changes={f"{MODEL}.feature_dim": 4}),
    "features-16": Variant("size", "16 features", changes={f"{MODEL}.feature_dim": 16}),
    "frequencies-0": Variant("size", "position as it is", changes={f"{MODEL}.position_frequencies": 0}),
    "frequencies-4": Variant("size", "4 frequencies", changes={f"{MODEL}.position_frequencies": 4}),
    "frequencies-8": Variant("size", "8 frequencies", changes={f"{MODEL}.position_frequencies": 8}),
    "cells-0.7": Variant("size", "cells of 0.7 pixels", changes={f"{MODEL}.voxel_size_px": 0.7}),
    "cells-1.6": Variant("size", "cells of 1.6 pixels", changes={f"{MODEL}.voxel_size_px": 1.6}),
    "steps-1.5": Variant("size", "steps of 1.5 cells", changes={f"{MODEL}.step_size_voxels": 1.5}),
    "rays-128": Variant("size", "128 rays", changes={f"{MANAGER}.train_num_rays_per_batch": 128}),
    "rays-512": Variant("size", "512 rays", changes={f"{MANAGER}.train_num_rays_per_batch": 512}),
}  # fmt: skip


@dataclass(frozen=True)
class Cell:
    """One training."""

    variant: str
    scene: str
    seed: int

    @property
    def name(self) -> str:
        """A name for its folder."""
        return f"{self.variant}-{self.scene}-{self.seed}"


def cells(variants: tuple[str, ...], scenes: tuple[str, ...], seeds: tuple[int, ...]) -> list[Cell]:
    """Seed by seed and scene by scene, so that what is compared is trained side by side."""
    return [Cell(name, scene, seed) for seed, scene, name in product(seeds, scenes, variants or tuple(VARIANTS))]


def changed(config: Any, path: str, value: Any) -> Any:
    """A config with one field, at the end of a dotted path, replaced."""
    name, _, rest = path.partition(".")
    return replace(config, **{name: changed(getattr(config, name), rest, value) if rest else value})


def config_of(cell: Cell, data: Path, output_dir: Path) -> TrainerConfig:
    """What a cell trains; its number of iterations is still open."""
    variant = VARIANTS[cell.variant]
    config: TrainerConfig = method_configs()[variant.method]
    for path, value in variant.changes.items():
        config = changed(config, path, value)
    machine = MachineConfig(seed=cell.seed, device_type="cpu")  # seconds are a CPU's
    return replace(config, data=data, output_dir=output_dir, experiment_name=cell.name, machine=machine)
