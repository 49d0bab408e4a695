"""Where on the map of stability a training stands: a base point, each axis varied alone, and the pairs that matter.

f   share of an image that shows the object, a mean over the views
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

Background = Literal["white", "black", "grey", "green", "random", "textured"]


@dataclass(frozen=True)
class Strategy:
    """How pixels are chosen, and whether dead networks begin anew."""

    label: str
    early: str
    late: str
    schedule: str = "fraction"
    reinit_dead: bool = False


STRATEGIES = {
    "vanilla-nerf": Strategy("Random", "uniform", "uniform"),
    "revived": Strategy("Random, dead networks anew", "uniform", "uniform", reinit_dead=True),
    "precrop-nerf": Strategy("Precrop + Random", "precrop", "uniform"),
    "se-nerf": Strategy("SE", "uniform", "se"),
    "precrop-se-nerf": Strategy("Precrop + SE", "precrop", "se"),
    "edge-nerf": Strategy("Edge", "edge", "uniform"),
    "edge-se-nerf": Strategy("Edge + SE", "edge", "se"),
    "auto": Strategy("Edge + SE, auto, dead anew", "edge", "se", schedule="adaptive", reinit_dead=True),
}
"""The paper's six, and those that repair."""


@dataclass(frozen=True)
class Point:
    """A configuration; the defaults are the base point."""

    foreground: float = 0.05
    """f."""
    placement: Literal["centered", "shifted"] = "centered"
    views: int = 40
    background: Background = "white"
    activation: Literal["relu", "softplus"] = "relu"
    initialization: Literal["xavier", "torch"] = "xavier"
    noise: float = 0.0
    """Standard deviation, on the raw density."""
    depth: int = 4
    rate: float = 1.0
    """Of the learning rate."""

    @property
    def changes(self) -> dict[str, Any]:
        """What differs from the base point."""
        return {key: value for key, value in asdict(self).items() if value != getattr(BASE, key)}

    @property
    def label(self) -> str:
        """The changes in words."""
        return ", ".join(WORDS[key].format(value) for key, value in self.changes.items()) or "base"


BASE = Point()
WORDS = {
    "foreground": "f {:.0%}",
    "placement": "off centre",
    "views": "{} views",
    "background": "{}",
    "activation": "{}",
    "initialization": "{} weights",
    "noise": "noise {:g}",
    "depth": "depth {}",
    "rate": "rate x{:g}",
}
AXES: dict[str, tuple[Any, ...]] = {
    "foreground": (0.01, 0.02, 0.10, 0.30),
    "placement": ("shifted",),
    "views": (10,),
    "background": ("black", "grey", "green", "random", "textured"),
    "activation": ("softplus",),
    "initialization": ("torch",),
    "noise": (1.0,),
    "depth": (8,),
    "rate": (3.0,),
}
"""What each axis takes besides the base point's value."""
PAIRS: tuple[dict[str, Any], ...] = (
    {"foreground": 0.01, "placement": "shifted"},
    {"foreground": 0.02, "placement": "shifted"},
    {"foreground": 0.10, "placement": "shifted"},
    {"placement": "shifted", "views": 10},
    {"initialization": "torch", "depth": 8},
    {"initialization": "torch", "activation": "softplus"},
    {"placement": "shifted", "activation": "softplus"},
)
"""Smaller and elsewhere; elsewhere and fewer; what a port begins with, and the cure it may have."""


def points() -> list[Point]:
    """The map: base, axes, pairs."""
    alone = [replace(BASE, **{axis: value}) for axis, values in AXES.items() for value in values]
    return [BASE, *alone, *(replace(BASE, **pair) for pair in PAIRS)]


@dataclass(frozen=True)
class Cell:
    """One training of the map."""

    point: int
    """Number in `points()`."""
    strategy: str
    seed: int

    @property
    def name(self) -> str:
        """A name for its files."""
        return f"point-{self.point}-{self.strategy}-{self.seed}"


def cells(chosen: tuple[int, ...], strategies: tuple[str, ...], seeds: tuple[int, ...]) -> list[Cell]:
    """All trainings asked for, seed by seed, so that an unfinished map is a coarser one."""
    numbers = chosen or tuple(range(len(points())))
    return [Cell(n, name, seed) for seed in seeds for n in numbers for name in strategies or tuple(STRATEGIES)]
