"""What runs say of a claim."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from edge_se_sampler.bench.paper.published import SCENES
from edge_se_sampler.bench.paper.verdicts import ClaimVerdict, evaluate_claims

AT_EQUAL_STEPS = "SE raises PSNR whatever the early phase, at equal steps"


def never(table: int, strategy: str, scene: str) -> bool:
    return False


def make_runs(
    levels: dict[tuple[int, str], float], fails: Callable[[int, str, str], bool] = never
) -> list[dict[str, Any]]:
    """Three seeds of every scene: PSNR by table and strategy with a little noise; a failure is at 15 dB."""
    rng = np.random.default_rng(1)
    return [
        {
            "table": table,
            "strategy": strategy,
            "scene": scene,
            "seed": seed,
            "psnr": 15.0 if fails(table, strategy, scene) else level + float(rng.normal(0, 0.1)),
            "edge_band_psnr": 10.0,
            "outcome": "collapsed" if fails(table, strategy, scene) else "converged",
        }
        for (table, strategy), level in levels.items()
        for scene in SCENES
        for seed in range(3)
    ]


def find(runs: list[dict[str, Any]], beginning: str) -> ClaimVerdict:
    (entry,) = [entry for entry in evaluate_claims(runs) if entry.claim.text.startswith(beginning)]
    return entry


@pytest.mark.parametrize(
    ("late", "expected"), [(30.5, "supported"), (30.0, "not supported"), (29.5, "not supported")]
)  # with 0.1 dB of noise the runs could have shown 0.3 dB: no difference is an answer
def test_better_needs_an_interval_above_zero(late: float, expected: str) -> None:
    runs = make_runs({(1, "vanilla-nerf"): 30.0, (1, "se-nerf"): late})
    assert find(runs, AT_EQUAL_STEPS).verdict == expected


def test_a_claim_is_supported_only_if_all_of_its_comparisons_are() -> None:
    levels = {(1, "vanilla-nerf"): 30.0, (1, "se-nerf"): 30.5, (1, "edge-nerf"): 30.0, (1, "edge-se-nerf"): 29.0}
    assert find(make_runs(levels), AT_EQUAL_STEPS).verdict == "not supported"


def test_one_seed_decides_nothing() -> None:
    runs = [run for run in make_runs({(1, "vanilla-nerf"): 20.0, (1, "se-nerf"): 30.0}) if run["seed"] == 0]
    assert find(runs, AT_EQUAL_STEPS).verdict == "undecided"


@pytest.mark.parametrize(("edge", "expected"), [(29.9, "supported"), (29.0, "not supported")])
def test_not_inferior_allows_a_small_difference(edge: float, expected: str) -> None:
    runs = make_runs({(1, "precrop-nerf"): 30.0, (1, "edge-nerf"): edge})
    assert find(runs, "Where the object is centred").verdict == expected


def test_more_failures_are_inferior_whatever_the_mean() -> None:
    levels = {(1, "precrop-nerf"): 30.0, (1, "edge-nerf"): 40.0}
    runs = make_runs(levels, lambda table, strategy, scene: strategy == "edge-nerf" and scene == "mic")
    assert find(runs, "Where the object is centred").verdict == "undecided"


@pytest.mark.parametrize(
    ("precrop", "edge", "expected"),
    [({"mic", "chair"}, set(), "supported"), ({"mic"}, {"mic"}, "not supported"), (set(), set(), "nothing to compare")],
)
def test_failures_are_prevented_where_the_baseline_fails(precrop: set[str], edge: set[str], expected: str) -> None:
    failing = {"precrop-nerf": precrop, "edge-nerf": edge}
    runs = make_runs(
        {(2, "precrop-nerf"): 25.0, (2, "edge-nerf"): 25.0}, lambda table, strategy, scene: scene in failing[strategy]
    )
    assert find(runs, "Off centre, Edge trains").verdict == expected


def test_failures_of_few_runs_or_seeds_leave_what_is_prevented_undecided() -> None:
    levels = {(2, "precrop-nerf"): 25.0, (2, "edge-nerf"): 25.0}
    runs = make_runs(levels)
    runs[0]["outcome"] = "collapsed"  # one of a scene's three
    assert find(runs, "Off centre, Edge trains").verdict == "undecided"
    two_seeds = [run for run in make_runs(levels) if run["seed"] != 2]
    assert find(two_seeds, "Off centre, Edge trains").verdict == "undecided"


def test_two_failed_runs_are_not_compared() -> None:
    levels = {(1, "vanilla-nerf"): 30.0, (1, "se-nerf"): 30.5}
    (row,) = find(make_runs(levels, lambda table, strategy, scene: scene != "mic"), AT_EQUAL_STEPS).rows
    assert (row.difference.runs, row.pairs, row.failures, row.difference.scenes) == (3, 21, 18, 1)
    assert row.difference.mean == pytest.approx(0.5, abs=0.2)
    assert find(make_runs(levels, lambda *_: True), AT_EQUAL_STEPS).verdict == "nothing to compare"
    more = levels | {(2, "vanilla-nerf"): 30.0, (2, "se-nerf"): 30.5}
    assert find(make_runs(more, lambda table, *_: table == 2), AT_EQUAL_STEPS).verdict == "supported"


@pytest.mark.parametrize(("edge_with_few", "expected"), [(21.0, "not supported"), (22.0, "supported")])
def test_a_gain_with_few_views_is_a_difference_of_differences(edge_with_few: float, expected: str) -> None:
    centred = {(1, "edge-nerf"): 31.0, (1, "precrop-nerf"): 30.0}
    few_views = {(5, "edge-nerf"): edge_with_few, (5, "precrop-nerf"): 20.0}
    assert find(make_runs(centred | few_views), "With few views, Edge gains more").verdict == expected


def test_pairs_are_of_the_same_scene_and_seed() -> None:
    runs = make_runs({(1, "vanilla-nerf"): 30.0, (1, "se-nerf"): 31.0})
    for run in runs:  # scenes and seeds differ by far more than strategies
        run["psnr"] += 10 * SCENES.index(run["scene"]) + 5 * run["seed"]
    assert find(runs, AT_EQUAL_STEPS).verdict == "supported"
    unpaired = [run for run in runs if not (run["strategy"] == "se-nerf" and run["seed"] == 2)]
    (row,) = find(unpaired, AT_EQUAL_STEPS).rows
    assert row.difference.runs == 14
