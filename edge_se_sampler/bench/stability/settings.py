"""The robustness sweep: a base setting, every axis varied alone, the pairs that matter, and the strategies trained."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from edge_se_sampler.bench.paper.published import LABELS
from edge_se_sampler.engine.config import SAMPLER

Background = Literal["white", "black", "grey", "green", "random", "textured"]


@dataclass(frozen=True)
class Strategy:
    """How pixels are sampled, and whether dead networks are reinitialised."""

    label: str
    method: str
    changes: dict[str, Any] = field(default_factory=dict)
    """Dotted path -> value, of the method's config (`override`)."""


REINIT, ADAPTIVE = {"reinit_dead": True}, {f"{SAMPLER}.schedule": "adaptive"}
STRATEGIES = {
    **{method: Strategy(label, method) for method, label in LABELS.items()},
    "reinit": Strategy("Random, reinitialised", "vanilla-nerf", REINIT),
    "adaptive": Strategy("Edge + SE, adaptive, reinitialised", "edge-se-nerf", {**REINIT, **ADAPTIVE}),
}
"""The paper's six; and two that give new weights to networks that have died."""


@dataclass(frozen=True)
class Setting:
    """What is trained on what; the defaults are the base setting."""

    scene: str | None = None
    """Folder of a real scene; None: a synthetic one."""
    foreground: float | None = 0.05
    """Share of an image's pixels that show the object, a mean over the views; None: a real scene as it is."""
    placement: Literal["centered", "shifted"] = "centered"
    num_views: int = 40
    background: Background = "white"
    density_activation: Literal["relu", "softplus"] = "relu"
    initialization: Literal["xavier", "torch"] = "xavier"
    density_noise: float = 0.0
    """Standard deviation, on the raw density."""
    depth: int = 4
    lr_scale: float = 1.0
    """Factor of the learning rate."""


AXES: dict[str, tuple[str, tuple[Any, ...]]] = {
    "foreground": ("object {:.0%}", (0.01, 0.02, 0.10, 0.30)),
    "placement": ("off centre", ("shifted",)),
    "num_views": ("{} views", (10,)),
    "background": ("{} background", ("black", "grey", "green", "random", "textured")),
    "density_activation": ("{} density", ("softplus",)),
    "initialization": ("{} initialisation", ("torch",)),
    "density_noise": ("density noise {:g}", (1.0,)),
    "depth": ("{} layers", (8,)),
    "lr_scale": ("learning rate x{:g}", (3.0,)),
}
"""Field of `Setting` -> its label in words, and its values besides the base setting's."""
PAIRS: tuple[dict[str, Any], ...] = (
    {"foreground": 0.01, "placement": "shifted"},
    {"foreground": 0.02, "placement": "shifted"},
    {"foreground": 0.10, "placement": "shifted"},
    {"placement": "shifted", "num_views": 10},
    {"initialization": "torch", "depth": 8},
    {"density_activation": "softplus", "initialization": "torch"},
    {"placement": "shifted", "density_activation": "softplus"},
)
"""Small and off centre; off centre and few views; what PyTorch ports start with, and softplus, which may help them."""


SYNTHETIC_SETTINGS = {
    ", ".join(AXES[axis][0].format(value) for axis, value in changes.items()) or "base": Setting(**changes)
    for changes in ({}, *({axis: value} for axis, (_, values) in AXES.items() for value in values), *PAIRS)
}
REAL_SETTINGS = {
    f"real {scene}, {label}": Setting(scene=scene, **changes)
    for scene in ("lego", "chair")
    for label, changes in {
        "as it is": {"foreground": None},
        "as it is, 10 views": {"foreground": None, "num_views": 10},
        "object 5%": {},
        "object 2%": {"foreground": 0.02},
        "object 5%, off centre": {"placement": "shifted"},
    }.items()
}
SETTINGS = SYNTHETIC_SETTINGS | REAL_SETTINGS
"""Label, which says what differs from the base setting -> setting."""


@dataclass(frozen=True)
class Trial:
    """One training of the sweep."""

    setting: str
    """Label in `SETTINGS`."""
    strategy: str
    """Name in `STRATEGIES`."""
    seed: int
