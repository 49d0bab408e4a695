"""Which phase a training step is in: early for a planned length (the paper: a tenth), or for as long as it pays.

e      squared error of a pixel
b      squared distance of its colour from the background's: its error in an empty scene
p, u   probability of a pixel under edge sampling, and under uniform sampling
E, U   means over pixels as edge sampling draws them, and as uniform sampling does
R      E[e] / E[b]: 1 for an empty scene, 0 where all is learnt. The background's pixels count in e: a fog in front of
       everything, as networks begin with, is nearer to many an object than its background
"""

from __future__ import annotations

import math
from typing import Any, Literal

Phase = Literal["early", "late"]

LEARNT, LOST = 0.5, 0.8
"""The early phase does not end before R is below the first, and begins again when R is above the second."""
PAYS_NO_MORE, PAYS_AGAIN = 4.0, 4.5
"""Nor before E[e] / U[e], the error that edge sampling finds with as many pixels as uniform sampling, is below the
first; above the second it begins again. Chosen on seed 100. In 300 iterations, PSNR for (2, 3), (3, 4), (4, 6), (6, 9):
drums, centred, 18.60, 19.01, 19.56, 19.56 (a tenth of edges: 19.62), bricks, centred, 21.39, 21.42, 21.72, 21.72
(21.99), chair, off centre, 25.69, 25.56, 25.56, 24.69 (24.36), mic, off centre, 29.26, 28.90, 28.90, 28.90 (25.29).
In 3,000, for (3, 4), (4, 4.5), (4, 6): drums 25.61, 25.45, 24.94, bricks 27.77, 28.01, 27.94: the ratio rises while
details are learnt, and hovers between 4 and 6 where the object is large."""
WINDOW_STEPS, WINDOW_PIXELS = 16, 256
"""R forgets after so many steps, or pixels of the object if those take longer; a phase lasts that at least."""


def phase_at(step: int, early_steps: float) -> Phase:
    """The phase of a step (0, 1, 2, ...): early while step < early_steps."""
    return "early" if step < early_steps else "late"


class AdaptiveSchedule:
    """Watches the errors of what is trained on: early while that pays, and again when the object is lost.

    It knows no number of steps to come, so that it does the same in a short and in a long run.
    """

    def __init__(self) -> None:
        self.phase: Phase = "early"
        self.observations = 0
        self._count = 0.0
        self._begin("early")

    def observe(self, count: float, edge_error: float, edge_background: float, uniform_error: float) -> None:
        """Take note of a step's pixels.

        Args:
            count: how many show the object.
            edge_error: E[e].
            edge_background: E[b].
            uniform_error: U[e].
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
        if self.phase == "early" and self.remaining < LEARNT and self.gain < PAYS_NO_MORE:
            self._begin("late")
        elif self.phase == "late" and (self.remaining > LOST or self.gain > PAYS_AGAIN):
            self._begin("early")

    @property
    def remaining(self) -> float:
        """R; 1 before anything was seen."""
        return self._edge_error / self._edge_background if self._edge_background else 1.0

    @property
    def gain(self) -> float:
        """E[e] / U[e]."""
        return self._edge_error / self._uniform_error if self._uniform_error else math.inf

    def _begin(self, phase: Phase) -> None:
        """A phase, judged by its own pixels alone."""
        self.phase = phase
        self._edge_error = self._edge_background = self._uniform_error = self._evidence = 0.0

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return dict(vars(self))

    def load(self, state: dict[str, Any]) -> None:
        """Go on where `state` was taken."""
        vars(self).update(state)
