"""What the runs say of each strategy against uniform pixels, panel by panel: a model on images of a size, centered or
not.

Differences are taken between trainings of the same scene and seed, not both of which failed, and means over scenes of
the median over seeds. The spread of a number is the mean over scenes of its greatest minus its least value over the
seeds that did not fail: failures are counted, and would drown all else.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from edge_se_sampler.bench.outcomes import failed
from edge_se_sampler.bench.results import Run
from edge_se_sampler.bench.strategies.trials import ALL_MODELS, PLACEMENTS, STRATEGIES, UNIFORM

Verdict = Literal["better", "same", "worse"]
METRICS = ("psnr", "foreground_psnr", "edge_band_psnr")


@dataclass(frozen=True)
class Panel:
    """What is compared among itself."""

    model: str
    size: tuple[int, int]
    """Width and height of the images in pixels: captures are apart from NeRF's scenes."""
    placement: str

    @classmethod
    def of(cls, run: Run) -> Panel:
        return cls(run["model"], (run["size"][0], run["size"][1]), run["placement"])


@dataclass(frozen=True)
class Comparison:
    """A strategy under a plan, and its differences from uniform pixels (dB)."""

    psnr: float
    spread: float | None
    """The greater of its own and of uniform's that is known; None: neither, see `_spread`."""
    differences: dict[str, float]
    """By metric, over the trainings that uniform pixels have too and that did not both fail; empty: none. Captures have
    no PSNR of an object."""
    pairs: list[float]
    """Differences of PSNR, one a scene and seed."""
    fewest_pairs: int
    """Of a scene; 0: there is nothing to compare with."""

    @property
    def verdict(self) -> Verdict | None:
        """Better or worse: by more than the spread. None: without a spread, or with less than two pairs in a scene."""
        if self.spread is None or self.fewest_pairs < 2:
            return None
        difference = self.differences["psnr"]
        if abs(difference) <= self.spread:
            return "same"
        return "better" if difference > 0 else "worse"


def panels_of(runs: Iterable[Run]) -> list[Panel]:
    """Models in the order of `ALL_MODELS`, small before large, centered before shifted."""

    def order(panel: Panel) -> tuple[Any, ...]:
        return ALL_MODELS.index(panel.model), math.prod(panel.size), PLACEMENTS.index(panel.placement)

    return sorted({Panel.of(run) for run in runs}, key=order)


def captures_of(runs: Iterable[Run]) -> list[str]:
    """The scenes in which no alpha tells an object, by name."""
    return sorted({run["scene"] for run in runs if run["foreground_psnr"] is None})


def strategies_of(runs: Iterable[Run]) -> list[str]:
    """In the order of `STRATEGIES`, then those that this installation lacks."""
    found = {run["strategy"] for run in runs}
    return [name for name in STRATEGIES if name in found] + sorted(found - STRATEGIES.keys())


def select(runs: Iterable[Run], panel: Panel, strategy: str, plan: str | None = None) -> list[Run]:
    """The runs of a strategy in a panel, under one plan or under all."""
    return [
        run for run in runs if Panel.of(run) == panel and run["strategy"] == strategy and plan in (None, run["plan"])
    ]


def compare(runs: list[Run], panel: Panel, strategy: str, plan: str) -> Comparison | None:
    """A strategy with uniform pixels; None: it has no run."""
    own, uniform = select(runs, panel, strategy, plan), select(runs, panel, UNIFORM, plan)
    if not own:
        return None
    pairs = [pair for pair in _pair(own, uniform) if not all(map(failed, pair))]
    differences, spreads, fewest_pairs = {}, [_spread(own)], 0
    if pairs and strategy != UNIFORM:
        for metric in METRICS:
            known = [(run, before) for run, before in pairs if None not in (run[metric], before[metric])]
            by_scene = _by_scene((run["scene"], run[metric] - before[metric]) for run, before in known)
            if by_scene:
                differences[metric] = statistics.mean(map(statistics.median, by_scene.values()))
        spreads.append(_spread([before for _, before in pairs]))
        fewest_pairs = min(map(len, _by_scene((run["scene"], run["psnr"]) for run, _ in pairs).values()))
    return Comparison(
        psnr=statistics.mean(map(statistics.median, _by_scene((run["scene"], run["psnr"]) for run in own).values())),
        spread=max((spread for spread in spreads if spread is not None), default=None),
        differences=differences,
        pairs=[run["psnr"] - before["psnr"] for run, before in pairs],
        fewest_pairs=fewest_pairs,
    )


def cost_of_a_step(runs: list[Run], panel: Panel, strategy: str) -> float | None:
    """CPU seconds of a step as a multiple of uniform pixels': the median of the pairs of equal steps, if there are any;
    what comes before the first step is left out."""
    pairs = _pair(select(runs, panel, strategy, "steps"), select(runs, panel, UNIFORM, "steps"))
    ratios = [_seconds_per_step(run) / _seconds_per_step(before) for run, before in pairs]
    return statistics.median(ratios) if ratios else None


def count_failures(runs: list[Run], panel: Panel, strategy: str) -> tuple[int, int]:
    """Failures and trainings, under all plans."""
    found = select(runs, panel, strategy)
    return sum(map(failed, found)), len(found)


def best_at_equal_seconds(runs: list[Run], panel: Panel) -> str | None:
    """The strategy with the greatest difference from uniform pixels, uniform itself if none is above 0; None: nothing
    was compared."""
    found = {name: compare(runs, panel, name, "seconds") for name in strategies_of(runs)}
    differences = {name: c.differences["psnr"] for name, c in found.items() if c is not None and c.differences}
    if not differences:
        return None
    return max({UNIFORM: 0.0, **differences}.items(), key=lambda item: item[1])[0]


def _seconds_per_step(run: Run) -> float:
    return (run["seconds"] - run["ready_seconds"]) / run["steps"]


def _pair(runs: Sequence[Run], uniform: Sequence[Run]) -> list[tuple[Run, Run]]:
    """Runs of one panel and plan with uniform's of the same scene and seed."""
    by_key = {(run["scene"], run["seed"]): run for run in uniform}
    return [(run, by_key[key]) for run in runs if (key := (run["scene"], run["seed"])) in by_key]


def _by_scene(values: Iterable[tuple[str, float]]) -> dict[str, list[float]]:
    groups: dict[str, list[float]] = {}
    for scene, value in values:
        groups.setdefault(scene, []).append(value)
    return groups


def _spread(runs: Sequence[Run]) -> float | None:
    """Of PSNR of the runs that did not fail; None if some scene has less than two of them."""
    by_scene = _by_scene((run["scene"], run["psnr"]) for run in runs if not failed(run))
    if by_scene.keys() != {run["scene"] for run in runs} or any(len(psnrs) < 2 for psnrs in by_scene.values()):
        return None
    return statistics.mean(max(psnrs) - min(psnrs) for psnrs in by_scene.values())
