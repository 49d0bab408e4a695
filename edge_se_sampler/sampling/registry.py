"""The pixel-sampling strategies by name, those of other installed packages among them. Torch-free: a class is imported
when it is first used, so that `--help` can list all of them.

A package adds a strategy by an entry point of the group edge_se_sampler.pixel_strategies: the strategy's name, and
"module:Class" of a `parts.Distribution` or a `parts.Selector`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

from edge_se_sampler.errors import InputError

ENTRY_POINT_GROUP = "edge_se_sampler.pixel_strategies"
Phase = Literal["early", "late"]
BOTH: tuple[Phase, ...] = ("early", "late")
PACKAGE = "edge_se_sampler.sampling"


@dataclass(frozen=True)
class PixelStrategy:
    """What is known of a strategy before its class is imported."""

    target: type | str
    """The class, or "module:Class": a `Distribution`, or a `Selector` among uniform candidates."""
    phases: tuple[Phase, ...]
    """The phases that it may stand for."""
    description: str
    """One line."""
    settings: tuple[str, ...] = ()
    """Settings that only it reads: without it, other values than their defaults are refused."""
    refusals: tuple[tuple[str, tuple[Any, ...], str], ...] = ()
    """Setting, the values of it that the strategy works with, and what is wrong with others."""

    def load(self) -> Any:
        """The class. InputError: it cannot be imported."""
        if not isinstance(self.target, str):
            return self.target
        try:
            return EntryPoint("", self.target, ENTRY_POINT_GROUP).load()
        except Exception as problem:  # whatever another package's import may raise
            raise InputError(f"pixel strategy {self.target} cannot be imported: {problem}") from problem


PIXEL_STRATEGIES: dict[str, PixelStrategy] = {
    "uniform": PixelStrategy(f"{PACKAGE}.strategies:Uniform", BOTH, "all pixels alike"),
    "precrop": PixelStrategy(f"{PACKAGE}.strategies:Precrop", ("early",), "the center of the image, uniformly"),
    "edge": PixelStrategy(f"{PACKAGE}.strategies:Edge", ("early",), "in proportion to edge strength"),
    "se": PixelStrategy(
        f"{PACKAGE}.strategies:RankedError", ("late",), "by the rank of the squared error", settings=("error_source",)
    ),
    "error-map": PixelStrategy(
        f"{PACKAGE}.torch_ngp:ErrorMapCells",
        BOTH,
        "by the errors last found in 128 x 128 cells (torch-ngp)",
    ),
    "error-cdf": PixelStrategy(
        f"{PACKAGE}.instant_ngp:ErrorCdf", BOTH, "half by a coarse map of errors, rebuilt now and then (instant-ngp)"
    ),
    "soft-mining": PixelStrategy(
        f"{PACKAGE}.soft_mining:SoftMining",
        BOTH,
        "pixels that walk towards larger errors (Soft Mining)",
        settings=("soft_mining_alpha",),
        refusals=(("importance_weight", (0.0,), "soft-mining weights the loss itself, by soft-mining-alpha"),),
    ),
    "actray": PixelStrategy(
        f"{PACKAGE}.actray:ActRay", BOTH, "by estimated losses, the longer unseen the more (ActRay)"
    ),
    "regions": PixelStrategy(
        f"{PACKAGE}.regions:Regions", BOTH, "flat, textured or edge pixels, by the errors found in each"
    ),
    "quadtree": PixelStrategy(
        f"{PACKAGE}.quadtree:Quadtree",
        BOTH,
        "by color change, in a quadtree subdivided where errors are large",
        settings=("quadtree_threshold",),
    ),
    "expansive": PixelStrategy(
        f"{PACKAGE}.expansive:Expansive",
        BOTH,
        "half at the strongest edges, half elsewhere, losses weighted to stand for the whole image",
        refusals=(("importance_weight", (0.0,), "expansive weights the loss itself"),),
    ),
}
"""By the names that `early` and `late` give them."""


def strategy_names(phase: Phase) -> tuple[str, ...]:
    """The names that a phase's setting may have, besides `auto`."""
    return tuple(name for name, strategy in PIXEL_STRATEGIES.items() if phase in strategy.phases)


def _add_installed() -> None:
    """Add the strategies of other packages. One that takes a name that exists is left out with a line on stderr."""
    for entry in sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda entry: entry.name):
        origin = entry.dist.name if entry.dist else entry.value
        if entry.name in PIXEL_STRATEGIES or entry.name == "auto":
            taken = f"pixel strategy {entry.name!r} of {origin} left out: the name is taken"
            print(f"edge-se: {taken}", file=sys.stderr)
        else:
            PIXEL_STRATEGIES[entry.name] = PixelStrategy(entry.value, BOTH, f"of the package {origin}")


_add_installed()
