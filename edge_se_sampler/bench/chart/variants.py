"""What the chart compares: methods as they are, and lean-nerf with one thing changed at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from edge_se_sampler.bench.overrides import MANAGER, MODEL, SAMPLER
from edge_se_sampler.bench.strategies import LABELS

Group = Literal["methods", "errors", "pixels", "parts", "size"]
TOP: tuple[Group, ...] = ("methods", "errors")
"""Groups that the main picture shows; the others change parts of the recommended method."""
RECOMMENDED = "lean"
"""Every group is compared with this variant."""
EDGE = {f"{SAMPLER}.early": "edge"}
CACHED_ERRORS = {f"{SAMPLER}.late": "se", f"{SAMPLER}.error_source": "cached"}


@dataclass(frozen=True)
class Variant:
    """A method, and what is changed of it."""

    group: Group
    label: str
    method: str = "lean-nerf"
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Dotted path from the method's config -> value."""

    @property
    def full_label(self) -> str:
        """The label where variants of several groups stand together."""
        return self.label if self.group in TOP else f"lean-nerf: {self.label}"


VARIANTS: dict[str, Variant] = {
    RECOMMENDED: Variant("methods", "lean-nerf"),
    "random": Variant("methods", LABELS["vanilla-nerf"], "vanilla-nerf"),
    "precrop": Variant("methods", LABELS["precrop-nerf"], "precrop-nerf"),
    "se": Variant("methods", LABELS["se-nerf"], "se-nerf"),
    "precrop-se": Variant("methods", LABELS["precrop-se-nerf"], "precrop-se-nerf"),
    "edge": Variant("methods", LABELS["edge-nerf"], "edge-nerf"),
    "edge-se": Variant("methods", LABELS["edge-se-nerf"], "edge-se-nerf"),
    "edge-se-coarse": Variant(
        "errors", "Edge + SE (errors of the coarse network)", "edge-se-nerf", {f"{SAMPLER}.error_source": "coarse"}
    ),
    "edge-se-cached": Variant(
        "errors", "Edge + SE (cached errors)", "edge-se-nerf", {f"{SAMPLER}.error_source": "cached"}
    ),
    "edge-se-adaptive": Variant(
        "errors", "Edge + SE (adaptive schedule)", "edge-se-nerf", {f"{SAMPLER}.schedule": "adaptive"}
    ),
    "lean-se": Variant("pixels", "SE (cached errors)", changes=CACHED_ERRORS),
    "lean-se-weighted": Variant(
        "pixels", "SE (cached errors, weighted loss)", changes=CACHED_ERRORS | {f"{SAMPLER}.importance_weight": 0.6}
    ),
    "lean-edge": Variant("pixels", "Edge", changes=EDGE),
    "lean-edge-se": Variant("pixels", "Edge + SE (cached errors)", changes=EDGE | CACHED_ERRORS),
    "lean-adaptive": Variant(
        "pixels", "Edge + SE (cached errors, adaptive schedule)",
        changes=EDGE | CACHED_ERRORS | {f"{SAMPLER}.schedule": "adaptive"},
    ),
    "lean-one-image": Variant("pixels", "one image a step", changes={f"{SAMPLER}.images_per_step": "one"}),
    "all-rays": Variant("parts", "rays that miss the hull too", changes={f"{MANAGER}.skip_empty_rays": False}),
    "no-hull": Variant("parts", "no hull", changes={f"{MODEL}.cull_by_alpha": False}),
    "no-hull-uniform": Variant(
        "parts", "no hull (uniform pixels)", changes={f"{MODEL}.cull_by_alpha": False, f"{SAMPLER}.early": "uniform"}
    ),
    "no-density": Variant("parts", "no pruning by density", changes={f"{MODEL}.cull_by_density": False}),
    "no-skipping": Variant("parts", "no empty-space skipping", changes={f"{MODEL}.empty_space_skipping": False}),
    "no-features": Variant(
        "parts", "no features (network of 4 x 96)",
        changes={f"{MODEL}.feature_dim": 0, f"{MODEL}.depth": 4, f"{MODEL}.width": 96},
    ),
    "two-networks": Variant(
        "parts", "vanilla-nerf's two networks in the hull", "vanilla-nerf",
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
    "frequencies-0": Variant("size", "no positional encoding", changes={f"{MODEL}.position_frequencies": 0}),
    "frequencies-4": Variant("size", "4 frequencies", changes={f"{MODEL}.position_frequencies": 4}),
    "frequencies-8": Variant("size", "8 frequencies", changes={f"{MODEL}.position_frequencies": 8}),
    "voxels-0.7": Variant("size", "cells of 0.7 pixels", changes={f"{MODEL}.voxel_size_px": 0.7}),
    "voxels-1.6": Variant("size", "cells of 1.6 pixels", changes={f"{MODEL}.voxel_size_px": 1.6}),
    "steps-1.5": Variant("size", "steps of 1.5 cells", changes={f"{MODEL}.step_size_voxels": 1.5}),
    "rays-128": Variant("size", "128 rays", changes={f"{MANAGER}.train_num_rays_per_batch": 128}),
    "rays-512": Variant("size", "512 rays", changes={f"{MANAGER}.train_num_rays_per_batch": 512}),
}  # fmt: skip

GROUPS: dict[Group, tuple[str, str]] = {
    "methods": (
        "Methods",
        "The paper's six strategies on the original NeRF, whose coarse and fine networks sample every ray along its "
        "whole length; and `lean-nerf`, whose one small network is evaluated only in the *hull*: the cells of space "
        "that no two views see to be background, by their alpha masks. The six use the masks for compositing alone; "
        'what `lean-nerf` is without masks stands below as "no hull". On the original NeRF the choice of pixels '
        "decides whether anything is learnt at all. Other programs run unchanged, by the same clock, on the same data "
        "and test views, with smaller settings than their own (in the commands below), because no CPU gets anywhere "
        "with those; others may find better ones. Whether they failed is not known.",
    ),
    "errors": (
        "Cheaper squared errors, and no fixed phase length",
        "Squared-error sampling (SE) draws twice the batch and keeps the half with the larger errors, by rank. Those "
        "errors are rendered by both networks (as in the paper), by the coarse one alone, or not at all: they are "
        "cached from earlier steps. The adaptive schedule ends the edge phase when the object is learnt and edges no "
        "longer find larger errors than uniform pixels, instead of after a tenth of the iterations.",
    ),
    "pixels": (
        "Which pixels lean-nerf trains on",
        "`lean-nerf` draws uniformly among the pixels whose rays meet the hull; here it draws by edges first, by "
        "cached squared errors afterwards, or both. The weighted loss is the rule of [Soft Mining]"
        "(https://ubc-vision.github.io/nf-soft-mining/) (Kheradmand et al. 2024), the nearest prior work: pixels by "
        "their error, the loss weighted by their probability to the power of -0.6, its exponent; it finds the errors "
        "by Langevin moves instead. Where the object's cells are known nothing dies, rays outside cost next to "
        "nothing, and the choice matters little: so `lean-nerf` takes the simplest.",
    ),
    "parts": (
        "What lean-nerf's parts are worth",
        "`lean-nerf` with one part left out. *Features*: vectors at the cells' corners, interpolated, that spare the "
        "network its width. *Pruning by density*: cells found empty while training are no longer sampled, and the "
        "others are subdivided. Without a hull, training begins with all of the box between the cameras' near and far "
        "planes, and draws pixels by edges for as long as they find larger errors than uniform ones, for the first "
        "seconds' sake.",
    ),
    "size": (
        "How big, and how fine",
        "`lean-nerf` has one hidden layer 64 wide, 8 features, 6 frequencies of positional encoding, cells of 1 pixel, "
        "steps of 1 cell, 256 rays.",
    ),
}
"""Group -> its title, and what a reader needs to know."""

COMPARISONS: dict[tuple[str, str], str] = {
    ("edge-se", "edge"): "squared errors on the original NeRF",
    ("edge-se-cached", "edge-se"): "caching them",
    ("lean-se", "lean"): "cached squared errors in lean-nerf",
    ("lean", "no-hull"): "the hull",
    ("no-hull", "no-hull-uniform"): "edges first, without a hull",
    ("lean", "no-density"): "pruning by density, with a hull",
    ("no-hull", "no-skipping"): "pruning by density, without a hull",
    ("lean", "frequencies-4"): "6 frequencies instead of 4",
}
"""Pairs of variants -> what the first has and the second lacks."""
