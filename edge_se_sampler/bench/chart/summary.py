"""What the chart's runs say: PSNR after seconds of training, and which variant is best when.

A variant's PSNR at a moment is the mean over scenes of the median over seeds; a run that has ended stays at what it
ended with. Variants are only compared on the scenes and seeds that all of them have.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np

from edge_se_sampler.bench.chart.trials import EVAL_SECONDS
from edge_se_sampler.bench.chart.variants import GROUPS, RECOMMENDED, VARIANTS, Group
from edge_se_sampler.bench.runner import Run

END = float("inf")
"""The moment at which every training has ended."""


def scenes_of(runs: list[Run]) -> list[str]:
    """Scenes, in alphabetical order."""
    return sorted({run["scene"] for run in runs})


def runs_of(runs: list[Run], variant: str, scene: str | None = None) -> list[Run]:
    """The runs of a variant, and of a scene."""
    return [run for run in runs if run["variant"] == variant and scene in (None, run["scene"])]


def psnr_at(curve: Sequence[Sequence[float]], seconds: float) -> float | None:
    """PSNR at a moment of training, between evaluations linear in the logarithm of time; None before the first
    evaluation, which may come a step late.

    Args:
        curve: rows that begin with seconds and end with PSNR.
    """
    times, psnr = [row[0] for row in curve], [row[-1] for row in curve]
    if not times or seconds < times[0] * 0.99:
        return None
    return float(np.interp(np.log(seconds), np.log(times), psnr))


def mean_psnr_at(runs: list[Run], seconds: float, over_seeds: Callable[[Any], Any] = np.median) -> float | None:
    """Mean over scenes of the median (or another statistic) over seeds; None if a run has not been evaluated yet."""
    values = {scene: [psnr_at(r["curve"], seconds) for r in runs if r["scene"] == scene] for scene in scenes_of(runs)}
    if not values or any(value is None for of_seeds in values.values() for value in of_seeds):
        return None
    return statistics.mean(float(over_seeds(of_seeds)) for of_seeds in values.values())


def comparable(runs: list[Run], variants: Collection[str]) -> dict[str, list[Run]]:
    """Those of some variants that have runs -> their runs on the scenes and seeds that all of them have; empty if there
    are none."""
    by_variant = {name: found for name in VARIANTS if name in variants and (found := runs_of(runs, name))}
    keys = [{(run["scene"], run["seed"]) for run in found} for found in by_variant.values()]
    common = set.intersection(*keys) if keys else set()
    if not common:
        return {}
    return {name: [r for r in found if (r["scene"], r["seed"]) in common] for name, found in by_variant.items()}


def comparable_groups(runs: list[Run], groups: Collection[Group] = tuple(GROUPS)) -> dict[str, list[Run]]:
    """`comparable` of the variants of some groups, and the recommended one."""
    return comparable(runs, [name for name, v in VARIANTS.items() if v.group in groups or name == RECOMMENDED])


def upper_envelope(runs: list[Run]) -> list[tuple[int, str, float, float | None]]:
    """At every evaluation: seconds, the best variant, its PSNR, and how far the recommended one lies below, dB."""
    by_variant = comparable_groups(runs)
    rows = []
    for seconds in (s for s in EVAL_SECONDS if any(run["seconds"] >= s for run in runs)):
        psnr = {name: value for name in by_variant if (value := mean_psnr_at(by_variant[name], seconds)) is not None}
        if psnr:
            best = max(psnr, key=psnr.__getitem__)
            gap = psnr[best] - psnr[RECOMMENDED] if RECOMMENDED in psnr else None
            rows.append((seconds, best, psnr[best], gap))
    return rows


def differences(runs: list[Run], first: str, second: str, seconds: float) -> dict[str, float]:
    """Scene -> by how many dB the first variant is ahead of the second at a moment, medians over their common seeds."""
    by_variant = comparable(runs, (first, second))
    if len(by_variant) < 2:
        return {}
    ahead = {}
    for scene in scenes_of(by_variant[first]):
        psnr, reference = (mean_psnr_at(runs_of(by_variant[v], v, scene), seconds) for v in (first, second))
        if psnr is not None and reference is not None:
            ahead[scene] = psnr - reference
    return ahead


def always_better(runs: list[Run]) -> list[str]:
    """Variants ahead of the recommended one, in the mean over scenes, at every evaluation that both have."""
    names = [name for name in VARIANTS if name != RECOMMENDED and runs_of(runs, name)]
    ahead = {name: [differences(runs, name, RECOMMENDED, seconds) for seconds in EVAL_SECONDS] for name in names}
    known = {name: [statistics.mean(d.values()) for d in rows if d] for name, rows in ahead.items()}
    return [name for name, values in known.items() if values and min(values) > 0]


def baseline_runs(baseline: dict[str, Any], runs: list[Run]) -> list[Run]:
    """Another program's runs on the scenes of some runs; none if it lacks one of them."""
    scenes = set(scenes_of(runs))
    found = [run for run in baseline["runs"] if run["scene"] in scenes]
    return found if scenes == set(scenes_of(found)) else []
