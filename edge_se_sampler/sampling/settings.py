"""The settings of important-pixel sampling, the same flags in every host.

Not frozen, because nerfstudio's configs are not and a subclass of theirs cannot be; samplers copy it.
Torch-free, so that `--help` need not wait for torch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal, TypeVar

from edge_se_sampler.errors import InputError
from edge_se_sampler.protocol import PixelSamplerConfig

Settings = TypeVar("Settings", bound="SamplingSettings")


@dataclass
class SamplingSettings:
    """Which pixels train the network, early and late. Early and late together cover the paper's six strategies."""

    early: Literal["uniform", "precrop", "edge", "auto"] = "edge"
    """How pixels are drawn in the early phase: all alike, from the centred box, or in proportion to edge strength.
    Or auto (lean-nerf's): by edges as long as they pay, but all alike where alpha tells where the object is."""
    late: Literal["uniform", "se"] = "se"
    """How pixels are drawn afterwards: all alike, or by the rank of their squared error among uniform candidates."""
    schedule: Literal["fraction", "steps", "adaptive"] = "fraction"
    """What ends the early phase: a share of the planned iterations; a number of steps; or, for edge sampling, that the
    object is learnt and edges no longer pay (it begins again where the object is lost, or they do)."""
    early_fraction: float = 0.1
    """Share of the planned iterations that the early phase lasts (schedule: fraction); the paper's 1/10."""
    early_steps: int = 0
    """Number of steps that the early phase lasts (schedule: steps)."""
    images_per_step: Literal["one", "all"] = "one"
    """Draw a step's pixels from one image (the paper) or from all images at hand (nerfstudio); an image is chosen
    first, a pixel in it second."""
    precrop_fraction: float = 0.5
    """Side of the precrop box as a share of the image's side."""
    edge_filter: Literal["sobel", "laplacian", "canny"] = "sobel"
    """Edge operator; a full-contrast step answers 1 under each."""
    edge_source: Literal["color", "alpha", "both"] = "color"
    """Edges of the colour composited on the background, of alpha (a white object on white has no colour edge), or
    the stronger of both."""
    edge_epsilon: float = 0.01
    """Strength that every pixel has besides its edge (epsilon of equation 5), so that none has probability 0."""
    se_candidates: int = 2
    """Candidates scored for each pixel that squared-error sampling keeps."""
    error_source: Literal["fine", "coarse", "cached"] = "fine"
    """What scores the candidates: the fine colours (the paper); the coarse network's alone, for a third of the cost;
    or, for next to nothing, what training found there the last times."""
    importance_weight: float = 0.0
    """0: no loss weights, biased as in the paper; 1: inverse-probability weights, an unbiased loss; between: that
    power of them."""

    def resolve_auto(self: Settings, has_masks: bool = False) -> Settings:
        """With an `early` of auto decided by whether it is known where the object is; `check` comes after."""
        if self.early != "auto":
            return self
        if has_masks and self.schedule != "adaptive":
            return replace(self, early="uniform")
        return replace(self, early="edge", schedule="adaptive")

    def check(self) -> None:
        """Raise InputError for a value or a combination that has no meaning."""

        def refuse(field: str, problem: str) -> None:
            raise InputError(f"pixel-sampler.{field.replace('_', '-')} is {getattr(self, field)!r}: {problem}")

        if not 0 < self.precrop_fraction <= 1:
            refuse("precrop_fraction", "must be above 0 and at most 1")
        if not 0 <= self.early_fraction <= 1:
            refuse("early_fraction", "must be between 0 and 1")
        if self.schedule == "steps" and self.early_steps < 1:
            refuse("early_steps", "schedule 'steps' needs a number of steps, at least 1")
        if self.schedule != "steps" and self.early_steps:
            refuse("early_steps", f"has no effect under schedule {self.schedule!r}; add --...schedule steps")
        if self.schedule == "adaptive" and self.early != "edge":
            refuse("schedule", "'adaptive' asks whether edges pay: it needs early edge")
        if not 1e-6 <= self.edge_epsilon <= 1e6:
            refuse("edge_epsilon", "must be between 1e-6 and 1e6 (less would never train flat regions)")
        if self.se_candidates < 2:
            refuse("se_candidates", "must be at least 2, or there is nothing to choose from")
        if not 0 <= self.importance_weight <= 1:
            refuse("importance_weight", "must be between 0 and 1")
        if self.importance_weight and self.early != "edge" and self.late == "uniform":
            refuse("importance_weight", "has no effect when all that are drawn are drawn alike")
        if self.error_source != "fine" and self.late != "se":
            refuse("error_source", "has no effect without late se")

    def early_length(self, planned_steps: int) -> float:
        """Steps that the early phase lasts in a run planned for that many; under the adaptive schedule nobody knows."""
        # rounded: 0.07 * 100 is 7.000000000000001
        return self.early_steps if self.schedule == "steps" else round(self.early_fraction * planned_steps, 6)


@dataclass
class EdgeSEPixelSamplerConfig(SamplingSettings, PixelSamplerConfig):
    """Important-pixel sampling under our own protocol."""

    _target: ClassVar[type | str] = "edge_se_sampler.sampling.pixel_sampler:EdgeSEPixelSampler"
