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

CONFIDENCE = 0.95
POWER = 0.8


def wilson(failures: int, runs: int) -> tuple[float, float]:
    """95 % interval of a failure rate (Wilson 1927), of independent runs."""
    z = statistics.NormalDist().inv_cdf(0.5 + CONFIDENCE / 2)
    share = failures / runs
    middle = (share + z * z / (2 * runs)) / (1 + z * z / runs)
    half = z / (1 + z * z / runs) * math.sqrt(share * (1 - share) / runs + z * z / (4 * runs * runs))
    return max(0.0, middle - half), min(1.0, middle + half)


def t_quantile(p: float, df: int) -> float:
    """Quantile of Student's t, within 1e-3 for df >= 4 (Abramowitz and Stegun, 26.7.5)."""
    z = statistics.NormalDist().inv_cdf(p)
    terms = (
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    return z + sum(term / df**power for power, term in enumerate(terms, start=1))


@dataclass(frozen=True)
class PairedDifference:
    """A mean difference over these scenes, its 95 % interval over seeds, and what so many runs could have shown."""

    mean: float
    low: float | None
    high: float | None
    """None: a single seed, or too few runs, say nothing of the deviation."""
    detectable: float | None
    """A true difference of this size is found with 80 % power."""
    runs: int
    """Pairs."""
    scenes_better: int
    """Scenes whose mean difference is above 0."""
    scenes: int


def paired_difference(differences: Iterable[tuple[str, float]]) -> PairedDifference:
    """Of (scene, d) of every pair; of none, all is 0 and unknown.

    The scenes are what they are and seeds are drawn: only the deviation between a scene's seeds counts, pooled over
    the scenes. The interval is about these scenes, not about others.
    """
    by_scene: dict[str, list[float]] = {}
    for scene, difference in differences:
        by_scene.setdefault(scene, []).append(difference)
    if not by_scene:
        return PairedDifference(0.0, None, None, None, 0, 0, 0)
    means = {scene: statistics.mean(values) for scene, values in by_scene.items()}
    mean, runs = statistics.mean(means.values()), sum(map(len, by_scene.values()))
    better = sum(value > 0 for value in means.values())
    df = runs - len(means)
    if df < 4:
        return PairedDifference(mean, None, None, None, runs, better, len(means))
    variance = sum((d - means[scene]) ** 2 for scene, values in by_scene.items() for d in values) / df
    error = math.sqrt(variance * sum(1 / len(values) for values in by_scene.values())) / len(means)
    reach = t_quantile(0.5 + CONFIDENCE / 2, df)
    detectable = (reach + t_quantile(POWER, df)) * error
    return PairedDifference(mean, mean - reach * error, mean + reach * error, detectable, runs, better, len(means))
