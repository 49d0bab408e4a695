"""What the chart compares: methods as they are, and lean-nerf with one thing changed at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from edge_se_sampler.bench.paper.published import LABELS
from edge_se_sampler.engine.config import MANAGER, MODEL, SAMPLER

RECOMMENDED = "lean"
"""Every group is compared with this variant."""
TOP = ("methods", "errors")
"""Groups that the picture of all methods shows; the others change parts of the recommended one."""

EDGE = {f"{SAMPLER}.early": "edge"}
CACHED_ERRORS = {f"{SAMPLER}.error_source": "cached"}
CACHED_SE = {f"{SAMPLER}.late": "se", **CACHED_ERRORS}
ADAPTIVE = {f"{SAMPLER}.schedule": "adaptive"}
NO_HULL = {f"{MODEL}.cull_by_alpha": False}
FOUR_BY_96 = {f"{MODEL}.feature_dim": 0, f"{MODEL}.depth": 4, f"{MODEL}.width": 96}
IN_THE_HULL = {
    f"{MODEL}.empty_space_skipping": True,
    f"{MANAGER}.skip_empty_rays": True,
    f"{SAMPLER}.images_per_step": "all",
}


@dataclass(frozen=True)
class Variant:
    """A method, and what is changed of it."""

    group: str
    label: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Dotted path from the method's config -> value."""
    method: str = "lean-nerf"

    @property
    def full_label(self) -> str:
        """The label where variants of several groups stand together."""
        return self.label if self.group in TOP else f"lean-nerf: {self.label}"


VARIANTS: dict[str, Variant] = {
    RECOMMENDED: Variant("methods", "lean-nerf"),
    **{
        method.removesuffix("-nerf").replace("vanilla", "random"): Variant("methods", label, method=method)
        for method, label in LABELS.items()
    },
    "edge-se-coarse": Variant(
        "errors", "Edge + SE (errors of the coarse network)", {f"{SAMPLER}.error_source": "coarse"}, "edge-se-nerf"
    ),
    "edge-se-cached": Variant("errors", "Edge + SE (cached errors)", CACHED_ERRORS, "edge-se-nerf"),
    "edge-se-adaptive": Variant("errors", "Edge + SE (adaptive schedule)", ADAPTIVE, "edge-se-nerf"),
    "lean-se": Variant("pixels", "SE (cached errors)", CACHED_SE),
    "lean-se-weighted": Variant(
        "pixels", "SE (cached errors, weighted loss)", {**CACHED_SE, f"{SAMPLER}.importance_weight": 0.6}
    ),
    "lean-edge": Variant("pixels", "Edge", EDGE),
    "lean-edge-se": Variant("pixels", "Edge + SE (cached errors)", {**EDGE, **CACHED_SE}),
    "lean-adaptive": Variant(
        "pixels", "Edge + SE (cached errors, adaptive schedule)", {**EDGE, **CACHED_SE, **ADAPTIVE}
    ),
    "lean-one-image": Variant("pixels", "one image a step", {f"{SAMPLER}.images_per_step": "one"}),
    "all-rays": Variant("parts", "rays that miss the hull too", {f"{MANAGER}.skip_empty_rays": False}),
    "no-hull": Variant("parts", "no hull", NO_HULL),
    "no-hull-uniform": Variant("parts", "no hull (uniform pixels)", {**NO_HULL, f"{SAMPLER}.early": "uniform"}),
    "no-density": Variant("parts", "no pruning by density", {f"{MODEL}.cull_by_density": False}),
    "no-skipping": Variant("parts", "no empty-space skipping", {f"{MODEL}.empty_space_skipping": False}),
    "no-features": Variant("parts", "no features (network of 4 x 96)", FOUR_BY_96),
    "two-networks": Variant("parts", "vanilla-nerf's two networks in the hull", IN_THE_HULL, "vanilla-nerf"),
    "width-32": Variant("size", "32 wide", {f"{MODEL}.width": 32}),
    "width-128": Variant("size", "128 wide", {f"{MODEL}.width": 128}),
    "depth-2": Variant("size", "2 layers", {f"{MODEL}.depth": 2}),
    "features-4": Variant("size", "4 features", {f"{MODEL}.feature_dim": 4}),
    "features-16": Variant("size", "16 features", {f"{MODEL}.feature_dim": 16}),
    "frequencies-0": Variant("size", "no positional encoding", {f"{MODEL}.position_frequencies": 0}),
    "frequencies-4": Variant("size", "4 frequencies", {f"{MODEL}.position_frequencies": 4}),
    "frequencies-8": Variant("size", "8 frequencies", {f"{MODEL}.position_frequencies": 8}),
    "voxels-0.7": Variant("size", "cells of 0.7 pixels", {f"{MODEL}.voxel_size_px": 0.7}),
    "voxels-1.6": Variant("size", "cells of 1.6 pixels", {f"{MODEL}.voxel_size_px": 1.6}),
    "steps-1.5": Variant("size", "steps of 1.5 cells", {f"{MODEL}.step_size_voxels": 1.5}),
    "rays-128": Variant("size", "128 rays", {f"{MANAGER}.train_num_rays_per_batch": 128}),
    "rays-512": Variant("size", "512 rays", {f"{MANAGER}.train_num_rays_per_batch": 512}),
}
GROUPS = tuple(dict.fromkeys(variant.group for variant in VARIANTS.values()))
