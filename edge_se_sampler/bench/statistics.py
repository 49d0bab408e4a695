"""What a number of runs can say: intervals of rates and of paired differences.

n    runs
d    paired difference of two strategies on one scene and seed
df   degrees of freedom, n minus the number of scenes
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from edge_se_sampler.errors import InputError

CONFIDENCE = 0.95
POWER = 0.8


def require_scipy_stats() -> Any:
    """scipy.stats; InputError if the [bench] extra is missing."""
    try:
        from scipy import stats
    except ImportError:
        raise InputError("statistics need the [bench] extra: pip install 'edge-se-sampler[bench]'") from None
    return stats


def wilson_interval(failures: int, runs: int) -> tuple[float, float]:
    """95 % interval of a failure rate (Wilson 1927), of independent runs."""
    interval = require_scipy_stats().binomtest(failures, runs).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


@dataclass(frozen=True)
class PairedDifference:
    """A mean difference over these scenes, its 95 % interval over seeds, and what so many runs could have shown."""

    mean: float
    runs: int
    """Pairs."""
    scenes_better: int
    """Scenes whose mean difference is above 0."""
    scenes: int
    low: float | None = None
    high: float | None = None
    """None: a single seed, or too few runs, say nothing of the deviation."""
    detectable: float | None = None
    """A true difference of this size is found with 80 % power."""


def paired_difference(differences: Iterable[tuple[str, float]]) -> PairedDifference:
    """Of (scene, d) of every pair; of no pairs, all is 0 and unknown.

    The scenes are fixed and seeds are drawn: only the deviation between a scene's seeds counts, pooled over the
    scenes. The interval is about these scenes, not about others.
    """
    by_scene: dict[str, list[float]] = {}
    for scene, difference in differences:
        by_scene.setdefault(scene, []).append(difference)
    if not by_scene:
        return PairedDifference(0.0, 0, 0, 0)
    means = {scene: statistics.mean(values) for scene, values in by_scene.items()}
    mean, runs = statistics.mean(means.values()), sum(map(len, by_scene.values()))
    counts = (runs, sum(value > 0 for value in means.values()), len(means))
    df = runs - len(means)
    if df < 4:
        return PairedDifference(mean, *counts)
    variance = sum((d - means[scene]) ** 2 for scene, values in by_scene.items() for d in values) / df
    error = math.sqrt(variance * sum(1 / len(values) for values in by_scene.values())) / len(means)
    t = require_scipy_stats().t(df)
    reach = float(t.ppf(0.5 + CONFIDENCE / 2))
    detectable = (reach + float(t.ppf(POWER))) * error
    return PairedDifference(mean, *counts, mean - reach * error, mean + reach * error, detectable)


def format_difference(difference: PairedDifference) -> str:
    """The mean with its interval, where there is one."""
    if not difference.runs:
        return "–"
    interval = "" if difference.low is None else f" [{difference.low:+.2f}, {difference.high:+.2f}]"
    return f"{difference.mean:+.2f}{interval}"
