"""What the chart's runs say: PSNR after seconds of training, compared on the scenes and seeds that all variants have.

PSNR at a moment is the mean over scenes of the median over seeds; a run that has ended stays at what it ended with.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from edge_se_sampler.bench.chart.variants import GROUPS, RECOMMENDED, VARIANTS
from edge_se_sampler.bench.results import Run

END = float("inf")
"""The moment at which every training has ended."""


def scenes_of(runs: Iterable[Run]) -> list[str]:
    return sorted({run["scene"] for run in runs})


def runs_on(runs: list[Run], scenes: Collection[str]) -> list[Run]:
    """The runs on some scenes; none if one of the scenes has none."""
    found = [run for run in runs if run["scene"] in scenes]
    return found if {run["scene"] for run in found} == set(scenes) else []


def psnr_at(curve: Sequence[Sequence[float]], seconds: float) -> float | None:
    """PSNR at a moment of training, by a curve's rows [seconds, ..., PSNR]: between them linear in the logarithm of
    time; None before the first one, which may come a step late."""
    times, psnr = [row[0] for row in curve], [row[-1] for row in curve]
    if seconds < times[0] * 0.99:
        return None
    return float(np.interp(np.log(seconds), np.log(times), psnr))


def mean_psnr_at(runs: list[Run], seconds: float, over_seeds: Callable[[Any], Any] = np.median) -> float | None:
    """Mean over scenes of the median (or another statistic) over seeds; None if a run has not been evaluated yet."""
    psnr = {scene: [psnr_at(r["curve"], seconds) for r in runs if r["scene"] == scene] for scene in scenes_of(runs)}
    if not psnr or any(value is None for of_seeds in psnr.values() for value in of_seeds):
        return None
    return statistics.mean(float(over_seeds(of_seeds)) for of_seeds in psnr.values())


def comparable(runs_by_name: Mapping[str, list[Run]]) -> dict[str, list[Run]]:
    """The runs on the scenes and seeds that all names have; empty if there are none."""
    keys = [{(run["scene"], run["seed"]) for run in runs} for runs in runs_by_name.values()]
    common = set.intersection(*keys) if keys else set()
    if not common:
        return {}
    return {name: [run for run in runs if (run["scene"], run["seed"]) in common] for name, runs in runs_by_name.items()}


def by_variant(runs: list[Run], groups: Collection[str] = GROUPS) -> dict[str, list[Run]]:
    """Variants of some groups that have runs, the recommended one included -> their runs."""
    names = [name for name, variant in VARIANTS.items() if variant.group in groups or name == RECOMMENDED]
    return {name: found for name in names if (found := [run for run in runs if run["variant"] == name])}
