"""Settings of the pixel sampler, the same flags in every host.

Not frozen: configs of nerfstudio are not, and a subclass of an unfrozen one cannot be; samplers copy it.
Torch-free, so that `--help` need not wait for torch.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, ClassVar, Literal

from edge_se_sampler.errors import InputError, check_known
from edge_se_sampler.protocol import ADDED_LATER, PixelSamplerConfig
from edge_se_sampler.sampling.registry import PIXEL_STRATEGIES, strategy_names

if TYPE_CHECKING:
    from typing_extensions import Self

    EarlyStrategy = LateStrategy = str
else:  # what --help lists
    EarlyStrategy, LateStrategy = Literal[(*strategy_names("early"), "auto")], Literal[strategy_names("late")]


@dataclass
class SamplingSettings:
    """Which pixels train the network, early and late. Early and late together cover the paper's six strategies."""

    early: EarlyStrategy = "edge"
    """How pixels are drawn in the early phase: uniformly, from the center of the image, in proportion to edge
    strength, or as the errors tell that training found (see the README of edge_se_sampler/sampling); auto: uniformly
    where lean-nerf knows from alpha where the object is, otherwise by edges, under the adaptive schedule unless that
    is steps."""
    late: LateStrategy = "se"
    """How pixels are drawn afterwards: uniformly, by the rank of their squared error among uniform candidates, or as
    the errors tell that training found. The same name as early's: all the time."""
    schedule: Literal["fraction", "steps", "adaptive"] = "fraction"
    """What ends the early phase: a share of the training; a number of steps; or (adaptive, for edges) that
    the object is learnt and edges no longer find larger errors. When either is no longer so, the phase returns."""
    early_fraction: float = 0.1
    """Share of the training that the early phase lasts (schedule: fraction), by iterations or by the time budget; the
    paper's 1/10."""
    early_steps: int = 0
    """Number of steps that the early phase lasts (schedule: steps)."""
    images_per_step: Literal["one", "all"] = "one"
    """Draw a step's pixels from one image (the paper) or from all loaded images (nerfstudio); an image is chosen
    first, a pixel in it second."""
    precrop_fraction: float = 0.5
    """Side of the precrop box as a share of the image's side."""
    edge_filter: Literal["sobel", "laplacian", "canny"] = "sobel"
    """Edge operator; each answers a full-contrast step with 1."""
    edge_source: Literal["color", "alpha", "both"] = "color"
    """Edges of the color composited on the background, of alpha (a white object on white has no color edge), or
    the stronger of both."""
    edge_epsilon: float = 0.01
    """Strength that every pixel has besides its edge (epsilon of equation 5), so that none has probability 0."""
    se_candidates: int = 2
    """Candidates that squared-error sampling scores for each pixel that it keeps."""
    error_source: Literal["fine", "coarse", "cached"] = "fine"
    """Squared errors of the candidates: of the rendered fine colors (the paper); of the coarse network's, for a third
    of the cost; or cached ones, which training found there before, at almost no cost."""
    importance_weight: float = 0.0
    """0: no loss weights, biased as in the paper; 1: inverse-probability weights, an unbiased loss; between: that
    power of the weights."""
    soft_mining_alpha: float = field(default=0.6, metadata=ADDED_LATER)
    """Soft Mining weights the loss by this power of 1 / error; 0: not at all."""
    quadtree_threshold: float = field(default=0.015, metadata=ADDED_LATER)
    """Root mean squared error of a channel above which the quadtree's leaves are subdivided, in [0, 1]."""

    def resolve_auto(self, has_masks: bool = False) -> Self:
        """Replace an `early` of auto.

        Args:
            has_masks: whether alpha masks tell where the object is.
        """
        if self.early != "auto":
            return self
        if has_masks and self.schedule != "adaptive":
            return replace(self, early="uniform")
        return replace(self, early="edge", schedule="steps" if self.schedule == "steps" else "adaptive")

    def rules(self) -> list[tuple[str, bool, str]]:
        """Field, whether its value has a meaning, and what is wrong if not."""
        in_steps, steps, weight = self.schedule == "steps", self.early_steps, self.importance_weight
        all_uniform = self.early in ("uniform", "precrop") and self.late == "uniform"
        epsilon_range = "must be between 1e-6 and 1e6 (less would never train flat regions)"
        not_in_steps = f"has no effect under schedule {self.schedule!r}; add --...schedule steps"
        needs_edges = "'adaptive' compares edges with uniform pixels: it needs early edge"
        return [
            ("precrop_fraction", 0 < self.precrop_fraction <= 1, "must be above 0 and at most 1"),
            ("early_fraction", 0 <= self.early_fraction <= 1, "must be between 0 and 1"),
            ("early_steps", not in_steps or steps >= 1, "schedule 'steps' needs a number of steps, at least 1"),
            ("early_steps", in_steps or not steps, not_in_steps),
            ("schedule", self.schedule != "adaptive" or self.early == "edge", needs_edges),
            ("edge_epsilon", 1e-6 <= self.edge_epsilon <= 1e6, epsilon_range),
            ("se_candidates", 2 <= self.se_candidates <= 1000, "must be from 2 to 1000: one alone is no choice"),
            ("importance_weight", 0 <= weight <= 1, "must be between 0 and 1"),
            ("importance_weight", not (weight and all_uniform), "has no effect when all pixels are drawn uniformly"),
            ("soft_mining_alpha", 0 <= self.soft_mining_alpha <= 1, "must be between 0 and 1"),
            ("quadtree_threshold", 0 <= self.quadtree_threshold <= 1, "must be between 0 and 1"),
            *self._strategy_rules(),
        ]

    def _strategy_rules(self) -> Iterator[tuple[str, bool, str]]:
        """Rules of the registered strategies."""
        defaults = {setting.name: setting.default for setting in fields(self)}
        for name, strategy in PIXEL_STRATEGIES.items():
            phases = [phase for phase in strategy.phases if getattr(self, phase) == name]
            for setting in strategy.settings:
                no_effect = f"has no effect without {' or '.join(strategy.phases)} {name}"
                yield setting, bool(phases) or getattr(self, setting) == defaults[setting], no_effect
            for setting, values, problem in strategy.refusals:
                yield setting, not phases or getattr(self, setting) in values, problem

    def check(self) -> None:
        """Raise InputError for a value or a combination that has no meaning, or a strategy that is not known."""
        check_known("pixel-sampler.early", [self.early], (*strategy_names("early"), "auto"))
        check_known("pixel-sampler.late", [self.late], strategy_names("late"))
        for setting, valid, problem in self.rules():
            if not valid:
                raise InputError(f"pixel-sampler.{setting.replace('_', '-')} is {getattr(self, setting)!r}: {problem}")


@dataclass
class EdgeSEPixelSamplerConfig(SamplingSettings, PixelSamplerConfig):
    """The pixel sampler's settings in the standalone program."""

    _target: ClassVar[type | str] = "edge_se_sampler.sampling.pixel_sampler:EdgeSEPixelSampler"
