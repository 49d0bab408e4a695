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

UNIFORM_PIXELS = {f"{SAMPLER}.early": "uniform", f"{SAMPLER}.late": "uniform"}
CACHED_ERRORS = {f"{SAMPLER}.error_source": "cached"}
ADAPTIVE = {f"{SAMPLER}.schedule": "adaptive"}
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
    "lean-uniform": Variant("pixels", "uniformly", UNIFORM_PIXELS),
    "lean-errors": Variant(
        "pixels", "by cached squared errors", {**UNIFORM_PIXELS, f"{SAMPLER}.late": "se", **CACHED_ERRORS}
    ),
    "lean-edge": Variant(
        "pixels", "Edge first (adaptive schedule)", {**UNIFORM_PIXELS, f"{SAMPLER}.early": "edge", **ADAPTIVE}
    ),
    "no-hull": Variant("parts", "no hull", {f"{MODEL}.cull_by_alpha": False}),
    "no-alpha-loss": Variant("parts", "no alpha loss", {f"{MODEL}.alpha_loss": 0.0}),
    "two-networks": Variant("parts", "vanilla-nerf's two networks in the hull", IN_THE_HULL, "vanilla-nerf"),
}
GROUPS = tuple(dict.fromkeys(variant.group for variant in VARIANTS.values()))
