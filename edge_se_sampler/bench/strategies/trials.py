"""What is trained on real scenes to compare ways of choosing pixels, for a number of CPU seconds or of steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any, Literal

from edge_se_sampler.data.capture import Split
from edge_se_sampler.data.dataset import DataSettings, read_split
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.config import MODEL
from edge_se_sampler.sampling.registry import PIXEL_STRATEGIES

PlanName = Literal["seconds", "steps"]
PLANS: tuple[PlanName, ...] = ("seconds", "steps")
Placement = Literal["centered", "shifted"]
PLACEMENTS: tuple[Placement, ...] = ("centered", "shifted")
"""The scene as it is; its pictures on a larger canvas, off center."""
UNIFORM = "uniform"


@dataclass(frozen=True)
class Length:
    """How long a model is trained, and on how many test views at most, evenly spread, it is measured."""

    seconds: float
    steps: int
    test_views: int


@dataclass(frozen=True)
class Settings:
    """What all trainings have in common."""

    nerf: Length = Length(60, 300, 9)
    lean: Length = Length(10, 800, 25)


@dataclass(frozen=True)
class Model:
    """What is trained here; nerfacto is inside nerfstudio."""

    method: str
    changes: dict[str, Any]
    length: Literal["nerf", "lean"]
    """Field of `Settings`."""
    has_masks: bool = True
    """Whether the training images keep their alpha; without, they are composited on white."""


MODELS = {
    "nerf": Model("vanilla-nerf", {f"{MODEL}.size": "tiny"}, "nerf"),
    "lean": Model("lean-nerf", {}, "lean"),
    "lean-no-masks": Model("lean-nerf", {}, "lean", has_masks=False),
}
NERFACTO = "nerfacto"
"""Inside nerfstudio, see `strategies.nerfacto`."""
ALL_MODELS = (*MODELS, NERFACTO)
OF_CAPTURES = ("lean-no-masks", NERFACTO)
"""What is trained on captures, too."""


@dataclass(frozen=True)
class Strategy:
    """How pixels are chosen."""

    description: str
    settings: dict[str, Any] = field(default_factory=dict)
    """Of the pixel sampler, whose early and late strategy are uniform otherwise."""
    models: tuple[str, ...] = ALL_MODELS
    """Those that can be trained with it."""
    model_settings: dict[str, Any] = field(default_factory=dict)
    """Of the model's config."""


STRATEGIES = {
    **{
        # the losses of nerfstudio's models take no weights
        n: Strategy(
            known.description, dict.fromkeys(known.phases, n), tuple(MODELS) if n == "expansive" else ALL_MODELS
        )
        for n, known in PIXEL_STRATEGIES.items()
    },
    "se-coarse": Strategy(
        "the same, of the coarse network's errors", {"late": "se", "error_source": "coarse"}, models=("nerf",)
    ),
    "se-cached": Strategy("the same, of errors that training found before", {"late": "se", "error_source": "cached"}),
    "edge-se": Strategy("edge first, then se", {"early": "edge", "late": "se"}),
    "hard-samples": Strategy(
        "all pixels alike, the samples of their rays by their gradients", {}, ("nerf",), {"hard_samples": True}
    ),
}
"""Every one of the registry in all phases that it may stand for; ways to squared errors, and the paper's combination;
and uniform pixels of which hard samples are trained."""


@dataclass(frozen=True)
class Trial:
    """One training."""

    model: str
    scene: str
    downscale: int
    placement: Placement
    plan: PlanName
    strategy: str
    seed: int


def list_trials(
    models: Sequence[str],
    scenes: Sequence[str],
    downscales: Sequence[int],
    placements: Sequence[Placement],
    plans: Sequence[PlanName],
    strategies: Sequence[str],
    seeds: Sequence[int],
) -> list[Trial]:
    """Seed by seed and scene by scene, so that what is compared is trained side by side, of images read once."""
    return [
        Trial(model, scene, downscale, placement, plan, strategy, seed)
        for seed, model, downscale, placement, scene, plan, strategy in product(
            seeds, models, downscales, placements, scenes, plans, strategies
        )
        if model in STRATEGIES[strategy].models
    ]


def sampler_settings(strategy: str, length: Length) -> dict[str, Any]:
    """The pixel sampler's for a strategy, whose early phase lasts a tenth of the plan of steps."""
    early_phase = {"schedule": "steps", "early_steps": max(1, length.steps // 10)}
    return {"early": UNIFORM, "late": UNIFORM, **early_phase, **STRATEGIES[strategy].settings}


def measured_views(test: Views, length: Length) -> range:
    """Numbers of the test views that are measured."""
    return range(0, len(test.names), -(-len(test.names) // length.test_views))


@lru_cache(maxsize=4)
def read_views(data: Path, downscale: int, split: Split) -> Views:
    """A split of a scene, kept for the trainings on it that follow; InputError if it is missing or bad."""
    views = read_split(data, split, DataSettings(downscale=downscale))
    assert views is not None  # InputError for a missing training split; every scene here has a test split
    return views
