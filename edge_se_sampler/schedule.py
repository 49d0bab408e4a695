"""Which phase a training step is in: early for a planned length (the paper: a tenth), or until the object is learnt.

e   squared error of a pixel that was trained on
b   squared distance of its colour from the background's: its error in an empty scene
R   mean e / mean b of what training saw lately: 1 for an empty scene, 0 where all is learnt. The background's pixels
    count in e: a fog in front of everything, as networks begin with, is nearer to many an object than its background
"""

from __future__ import annotations

import math
from typing import Any, Literal

Phase = Literal["early", "late"]

LEARNT = 0.5
"""R below this ends the early phase."""
LOST = 0.8
"""R above this begins it again."""
WINDOW_STEPS, WINDOW_PIXELS = 16, 256
"""R forgets after so many steps, or pixels of the object if those take longer; a phase lasts that at least."""


def phase_at(step: int, early_steps: float) -> Phase:
    """The phase of a step (0, 1, 2, ...): early while step < early_steps."""
    return "early" if step < early_steps else "late"


class Watch:
    """Watches the errors of what is trained on: early until the object is learnt, and again when it is lost.

    It knows no number of steps to come, so that it does the same in a short and in a long run.
    """

    def __init__(self) -> None:
        self.phase: Phase = "early"
        self.observations = 0
        self._count = 0.0
        self._begin("early")

    def observe(self, count: float, error: float, background: float) -> None:
        """Take note of a step's pixels.

        Args:
            count: how many show the object.
            error: mean e of all.
            background: mean b of all.
        """
        self.observations += 1
        self._count += (count - self._count) / min(WINDOW_STEPS, self.observations)
        share = min(1 / WINDOW_STEPS, self._count / WINDOW_PIXELS)
        self._error += share * (error - self._error)
        self._background += share * (background - self._background)
        self._evidence += share * (1 - self._evidence)
        if self._evidence < 1 - math.exp(-1):
            return
        if self.phase == "early" and self.remaining < LEARNT:
            self._begin("late")
        elif self.phase == "late" and self.remaining > LOST:
            self._begin("early")

    @property
    def remaining(self) -> float:
        """R; 1 before anything was seen."""
        return self._error / self._background if self._background else 1.0

    def _begin(self, phase: Phase) -> None:
        """A phase, judged by its own pixels alone: the other phase's were drawn otherwise."""
        self.phase = phase
        self._error = self._background = self._evidence = 0.0

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return dict(vars(self))

    def load(self, state: dict[str, Any]) -> None:
        """Go on where `state` was taken."""
        vars(self).update(state)
