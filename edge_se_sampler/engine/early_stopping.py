"""When a training has stopped to gain."""

from __future__ import annotations

from typing import Any


class EarlyStopping:
    """Due when the PSNR has not risen by `min_gain` dB above its best for `patience` evaluations; None: never."""

    def __init__(self, patience: int | None, min_gain: float) -> None:
        self.patience, self.min_gain = patience, min_gain
        self._best, self._without_gain = float("-inf"), 0

    def update(self, psnr: float) -> None:
        """Add an evaluation's PSNR, dB."""
        has_gained = psnr >= self._best + self.min_gain and psnr > self._best
        self._without_gain = 0 if has_gained else self._without_gain + 1
        self._best = psnr if has_gained else self._best

    @property
    def is_due(self) -> bool:
        return self.patience is not None and self._without_gain >= self.patience

    def state_dict(self) -> dict[str, Any]:
        return {"best": self._best, "without_gain": self._without_gain}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned; {}: from the beginning. Patience that was lost is there again: who
        continues what has ended by it wants it to go on."""
        if state:
            self._best, self._without_gain = state["best"], state["without_gain"]
            if self.is_due:
                self._without_gain = 0
