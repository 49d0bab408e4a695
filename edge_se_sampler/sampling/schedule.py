"""Which phase a training step is in: early for a planned length (the paper: a tenth), or for as long as edges pay.

e      squared error of a pixel
b      squared distance of its color from the background's: its error in an empty scene
p, u   probability of a pixel under edge sampling, and under uniform sampling
E, U   means over pixels as edge sampling draws them, and as uniform sampling does
R      E[e] / E[b]: 1 for an empty scene, 0 where everything is learnt. Pixels of the background count in e: a fog in
       front of everything, as networks begin with, may be nearer to an object's color than the background is
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from torch import Tensor

from edge_se_sampler.sampling.background import PlainBackgrounds, summarize_errors
from edge_se_sampler.sampling.parts import Distribution, PixelBatch, SamplerPart, TrainingStep
from edge_se_sampler.sampling.registry import Phase

Progress = Callable[[int], float]
"""The part of the training, in [0, 1], that is done when a step begins."""

REMAINING_TO_END, REMAINING_TO_RETURN = 0.5, 0.8
"""The early phase does not end before R is below the first, and returns when R is above the second (hysteresis)."""
GAIN_TO_END, GAIN_TO_RETURN = 4.0, 4.5
"""Nor does it end before E[e] / U[e], the error that edge sampling finds with as many pixels as uniform sampling, is
below the first; above the second it returns. The ratio rises while details are learnt, so lower thresholds would hold
on to edges for too long where the object is large, and higher ones would leave small objects too early."""
WINDOW_STEPS, WINDOW_PIXELS = 16, 256
"""A phase lasts, and means are over, at least about so many steps and so many pixels of the object."""
MAX_PIXELS = 256
"""Pixels of a step that are looked at, at most twice as many: enough for the means."""


class Schedule(SamplerPart, ABC):
    """Says which phase a step is in."""

    early_may_return: bool = False  # after the late phase

    @abstractmethod
    def phase(self, step: int) -> Phase:
        """The phase of a step (0, 1, 2, ...)."""


class FixedSchedule(Schedule):
    """Early while progress(step) < early_length: a part of the training, or without a `progress` a number of steps."""

    def __init__(self, early_length: float, progress: Progress | None = None) -> None:
        self.early_length, self.progress = early_length, progress

    def phase(self, step: int) -> Phase:
        done = step if self.progress is None else self.progress(step)
        return "early" if done < self.early_length else "late"


class AdaptiveSchedule(Schedule):
    """Early while edges pay, and again when they pay again or the object is lost. It knows no number of steps to come,
    so that it does the same in a short and in a long run."""

    early_may_return = True
    needs_errors = True

    def __init__(self, edges: Distribution) -> None:
        self._edges = edges
        self._backgrounds = PlainBackgrounds()
        self.current: Phase = "early"
        self.observations = 0
        self._count = 0.0
        self._begin("early")

    def phase(self, step: int) -> Phase:
        """The current phase, whatever the step."""
        return self.current

    def update(self, drawn: PixelBatch, squared_error: Tensor, step: TrainingStep) -> None:
        """Compare what both ways of drawing would find, from pixels that either of them drew."""
        rows = slice(None, None, max(1, len(squared_error) // MAX_PIXELS))
        image, numbers = (values[rows].cpu().numpy() for values in (drawn.values["image"], drawn.values["indices"]))
        self._backgrounds.add(drawn.batch)
        distance = self._backgrounds.squared_distance(image, numbers[:, 0], drawn.batch.background_color)
        edge_ratio = self._edges.density_ratio(drawn.batch, drawn.pixels[rows]).numpy()
        error = squared_error[rows].float().cpu().numpy()
        self.observe(*summarize_errors(error, distance, edge_ratio, drawn.density_ratio(rows).numpy()))

    def observe(self, count: float, edge_error: float, edge_background: float, uniform_error: float) -> None:
        """Add a step's means E[e], E[b] and U[e] to the running ones, and change the phase if they say so.

        Args:
            count: pixels that show the object.
        """
        self.observations += 1
        self._count += (count - self._count) / min(WINDOW_STEPS, self.observations)
        share = min(1 / WINDOW_STEPS, self._count / WINDOW_PIXELS)
        self._edge_error += share * (edge_error - self._edge_error)
        self._edge_background += share * (edge_background - self._edge_background)
        self._uniform_error += share * (uniform_error - self._uniform_error)
        self._evidence += share * (1 - self._evidence)
        if self._evidence < 1 - math.exp(-1):
            return
        if self.current == "early" and self.remaining < REMAINING_TO_END and self.gain < GAIN_TO_END:
            self._begin("late")
        elif self.current == "late" and (self.remaining > REMAINING_TO_RETURN or self.gain > GAIN_TO_RETURN):
            self._begin("early")

    @property
    def remaining(self) -> float:
        """R; 1 before anything was observed."""
        return self._edge_error / self._edge_background if self._edge_background else 1.0

    @property
    def gain(self) -> float:
        """E[e] / U[e]."""
        return self._edge_error / self._uniform_error if self._uniform_error else math.inf

    def _begin(self, phase: Phase) -> None:
        """Begin a phase, which is judged by its own pixels alone."""
        self.current = phase
        self._edge_error = self._edge_background = self._uniform_error = self._evidence = 0.0

    def state_dict(self) -> dict[str, Any]:
        """The phase and the running means: plain numbers."""
        return {name: value for name, value in vars(self).items() if name not in ("_edges", "_backgrounds")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        vars(self).update(state)
