"""How far a training is, by its steps: what the learning rate and a model's cells follow."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

NUM_SEGMENTS = 100
FIRST_STEPS = 8
"""Steps of a time budget's first segment: nothing is known of their speed yet."""


class Plan:
    """The length of a training: so many steps; or a hundred segments, each a hundredth of the training and of its own
    number of steps. With a time budget (s), the number of a segment's steps is decided when it begins, by how long
    those of the one before took."""

    def __init__(self, num_steps: int | None, segments: Sequence[int] = (), time_budget: float | None = None) -> None:
        self.segments, self.time_budget = list(segments), time_budget
        self._num_steps = num_steps
        self._measured_from, self._owed = (0, 0.0), 0.0

    @property
    def num_steps(self) -> int | None:
        """Steps of the whole training; None: not known yet."""
        return sum(self.segments) if len(self.segments) == NUM_SEGMENTS else self._num_steps

    def progress(self, step: int) -> float:
        """The part of the training, in [0, 1], that is done when step 0, 1, 2, ... begins; of segments that are not
        decided, their begin."""
        if not self.segments and self._num_steps is not None:
            return step / self._num_steps
        begin = 0
        for i, length in enumerate(self.segments):
            # where segments without steps begin as well, the first of them counts: the others are decided on later
            if step == begin or step < begin + length:
                return (i + (step - begin) / max(length, 1)) / NUM_SEGMENTS
            begin += length
        return len(self.segments) / NUM_SEGMENTS

    def decide(self, step: int, elapsed: float) -> None:
        """Where a segment ends, decide on the next one: `step` begins after so many seconds."""
        if self.time_budget is None or self.num_steps is not None or step < sum(self.segments):
            return
        begin, since = self._measured_from
        self._measured_from = step, elapsed
        if step == begin or elapsed <= since:
            self.segments.append(FIRST_STEPS)
            return
        seconds_per_step = (elapsed - since) / (step - begin)
        seconds = max(0.0, self.time_budget - elapsed) / (NUM_SEGMENTS - len(self.segments))
        while sum(self.segments) == step and len(self.segments) < NUM_SEGMENTS:
            # of segments that are shorter than a step, only some have one
            self._owed += seconds / seconds_per_step
            self.segments.append(int(self._owed))
            self._owed -= self.segments[-1]

    def state_dict(self) -> dict[str, Any]:
        """What was decided, for a checkpoint."""
        return {"segments": list(self.segments), "measured_from": list(self._measured_from), "owed": self._owed}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        self.segments, self._owed = list(state["segments"]), state["owed"]
        self._measured_from = tuple(state["measured_from"])
