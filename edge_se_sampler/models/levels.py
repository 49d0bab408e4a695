"""When the lean model's cells are pruned and subdivided: parts of the training, in [0, 1]."""

from __future__ import annotations

LAST_SUBDIVISION, EARLY_SUBDIVISION, LEVEL_RATIO = 0.45, 0.3, 0.45
"""Part of the training after which the finest level begins; the same where each cell will be seen often; and by which
each level ends before the next one does."""
UNSETTLED, LAST_PRUNING = 0.4, 0.7
"""Part of a level whose weights are not looked at when cells are pruned: they still move; and part of the finest level
at which cells are left out that did not count in between."""


def find_level(level: int, finest: int, is_early: bool) -> tuple[float, float]:
    """Where a level, 0 .. finest, begins and ends.

    Args:
        is_early: whether each of the finest cells will be seen often.
    """
    begin = find_level_end(level - 1, finest, is_early) if level else 0.0
    return begin, find_level_end(level, finest, is_early) if level < finest else 1.0


def find_level_end(level: int, finest: int, is_early: bool) -> float:
    """Where a level before the finest one ends; see `find_level`."""
    return (EARLY_SUBDIVISION if is_early else LAST_SUBDIVISION) * LEVEL_RATIO ** (finest - level - 1)
