"""Which phase a training step is in. The paper: early for the first tenth of the planned steps, then late."""

from __future__ import annotations

from typing import Literal

Phase = Literal["early", "late"]


def phase_at(step: int, early_steps: float) -> Phase:
    """The phase of a step (0, 1, 2, ...): early while step < early_steps."""
    return "early" if step < early_steps else "late"
