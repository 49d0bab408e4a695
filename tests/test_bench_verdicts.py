"""The verdicts: what intervals say, and what runs say of a claim."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from edge_se_sampler.bench.paper.published import SCENES
from edge_se_sampler.bench.paper.tables import markdown, rows_of
from edge_se_sampler.bench.paper.verdicts import verdicts
from edge_se_sampler.bench.statistics import paired_difference, wilson_interval


def test_wilson_intervals() -> None:
    assert wilson_interval(0, 280) == (pytest.approx(0, abs=1e-12), pytest.approx(0.01353, abs=1e-5))
    assert wilson_interval(5, 10) == (pytest.approx(0.23659, abs=1e-5), pytest.approx(0.76341, abs=1e-5))
    assert wilson_interval(10, 10)[1] == pytest.approx(1)


def test_a_paired_difference_pools_the_deviation_of_seeds() -> None:
    difference = paired_difference([("a", 1.0), ("a", 2.0), ("a", 3.0), ("b", -1.0), ("b", -1.0), ("b", -1.0)])
    error = math.sqrt(2 / 4 * (1 / 3 + 1 / 3)) / 2  # pooled variance 2 / 4; two means of three
    assert difference.mean == 0.5
    assert difference.high is not None
    assert difference.high - 0.5 == pytest.approx(2.7764 * error, rel=1e-3)
    assert difference.detectable == pytest.approx((2.7764 + 0.9410) * error, rel=1e-3)
    assert (difference.runs, difference.scenes_better, difference.scenes) == (6, 1, 2)
    assert paired_difference([("a", 1.0), ("b", 2.0)]).low is None  # one seed tells nothing of its deviation


def test_the_interval_covers_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(1000):
        drawn = rng.normal(0.4, 1.0, (7, 3)) + np.linspace(-2, 2, 7)[:, None]
        found = paired_difference([(str(i), d) for i, row in enumerate(drawn) for d in row.tolist()])
        assert found.low is not None
        assert found.high is not None
        inside += found.low < 0.4 < found.high
    assert 930 <= inside <= 968


def experiment(psnr: dict[tuple[int, str], float], failing: Any = lambda *_: False) -> list[dict[str, Any]]:
    """Three seeds of every scene: PSNR by table and strategy, a little noise; a failure is at 15 dB."""
    rng = np.random.default_rng(1)
    return [
        {
            "table": table,
            "strategy": strategy,
            "scene": scene,
            "seed": seed,
            "psnr": 15.0 if failing(table, strategy, scene) else level + float(rng.normal(0, 0.1)),
            "edge_band_psnr": 10.0,
            "outcome": "background" if failing(table, strategy, scene) else "learnt",
        }
        for (table, strategy), level in psnr.items()
        for scene in SCENES
        for seed in range(3)
    ]


def verdict(runs: list[dict[str, Any]], beginning: str) -> str:
    (claim,) = [claim for claim in verdicts(runs) if claim["text"].startswith(beginning)]
    return claim["verdict"]


@pytest.mark.parametrize(
    ("late", "expected"), [(30.5, "supported"), (30.0, "not supported"), (29.5, "not supported")]
)  # 0.1 dB of noise would have shown 0.3 dB: no difference is an answer
def test_better_needs_an_interval_above_nothing(late: float, expected: str) -> None:
    runs = experiment({(1, "vanilla-nerf"): 30.0, (1, "se-nerf"): late})
    assert verdict(runs, "SE raises PSNR whatever the early phase, at equal steps") == expected


def test_a_claim_holds_if_all_of_it_does() -> None:
    levels = {(1, "vanilla-nerf"): 30.0, (1, "se-nerf"): 30.5, (1, "edge-nerf"): 30.0, (1, "edge-se-nerf"): 29.0}
    assert verdict(experiment(levels), "SE raises PSNR whatever the early phase, at equal steps") == "not supported"


def test_one_seed_decides_nothing() -> None:
    runs = [run for run in experiment({(1, "vanilla-nerf"): 20.0, (1, "se-nerf"): 30.0}) if run["seed"] == 0]
    assert verdict(runs, "SE raises PSNR whatever the early phase, at equal steps") == "undecided"


@pytest.mark.parametrize(("edge", "expected"), [(29.9, "supported"), (29.0, "not supported")])
def test_not_worse_forgives_little(edge: float, expected: str) -> None:
    runs = experiment({(1, "precrop-nerf"): 30.0, (1, "edge-nerf"): edge})
    assert verdict(runs, "Where the object is centred") == expected


def test_more_failures_are_worse_whatever_the_mean() -> None:
    levels = {(1, "precrop-nerf"): 30.0, (1, "edge-nerf"): 40.0}
    runs = experiment(levels, lambda table, strategy, scene: strategy == "edge-nerf" and scene == "mic")
    assert verdict(runs, "Where the object is centred") != "supported"


@pytest.mark.parametrize(
    ("theirs", "ours", "expected"),
    [({"mic", "chair"}, set(), "supported"), ({"mic"}, {"mic"}, "not supported"), (set(), set(), "undecided")],
)
def test_rescue_is_judged_where_the_other_fails(theirs: set[str], ours: set[str], expected: str) -> None:
    fails = {"precrop-nerf": theirs, "edge-nerf": ours}
    runs = experiment(
        {(2, "precrop-nerf"): 25.0, (2, "edge-nerf"): 25.0}, lambda table, strategy, scene: scene in fails[strategy]
    )
    assert verdict(runs, "Off centre, Edge trains") == expected


def test_two_dead_runs_tell_nothing_of_quality() -> None:
    def dies(table: int, strategy: str, scene: str) -> bool:
        return scene != "mic"

    levels = {(1, "vanilla-nerf"): 30.0, (1, "se-nerf"): 30.5}
    (claim,) = [c for c in verdicts(experiment(levels, dies)) if c["text"].endswith("at equal steps")]
    (row,) = claim["comparisons"]
    assert (row["runs"], row["pairs"], row["failures"], row["scenes"]) == (3, 21, 18, 1)
    assert row["mean"] == pytest.approx(0.5, abs=0.2)
    everywhere = verdicts(experiment(levels, lambda *_: True))
    (claim,) = [c for c in everywhere if c["text"].endswith("at equal steps")]
    assert claim["verdict"] == "nothing to compare"
    assert "| SE against Random, table 1 | – |" in markdown(experiment(levels, lambda *_: True), everywhere)
    both = experiment(levels | {(2, "vanilla-nerf"): 30.0, (2, "se-nerf"): 30.5}, lambda table, *_: table == 2)
    assert verdict(both, "SE raises PSNR whatever the early phase, at equal steps") == "supported"


def test_a_gain_with_few_views_is_a_difference_of_differences() -> None:
    same = {(1, "edge-nerf"): 31.0, (1, "precrop-nerf"): 30.0, (5, "edge-nerf"): 21.0, (5, "precrop-nerf"): 20.0}
    assert verdict(experiment(same), "With few views, Edge gains more") == "not supported"
    more = same | {(5, "edge-nerf"): 22.0}
    assert verdict(experiment(more), "With few views, Edge gains more") == "supported"


def test_pairs_are_of_the_same_scene_and_seed() -> None:
    runs = experiment({(1, "vanilla-nerf"): 30.0, (1, "se-nerf"): 31.0})
    for run in runs:  # scenes differ by far more than strategies
        run["psnr"] += 10 * SCENES.index(run["scene"]) + 5 * run["seed"]
    assert verdict(runs, "SE raises PSNR whatever the early phase, at equal steps") == "supported"
    alone = [run for run in runs if not (run["strategy"] == "se-nerf" and run["seed"] == 2)]
    (claim,) = [claim for claim in verdicts(alone) if claim["comparisons"][0]["label"].startswith("SE against")]
    assert claim["comparisons"][0]["runs"] == 14


# -- tables


def test_the_tables_tell_mean_deviation_and_failures() -> None:
    def run(strategy: str, seed: int, psnr: float, what: str = "learnt", scene: str = "mic") -> dict[str, Any]:
        return {"table": 2, "scene": scene, "strategy": strategy, "seed": seed, "psnr": psnr, "outcome": what}

    runs = [run("vanilla-nerf", 0, 20.0, "background"), run("vanilla-nerf", 1, 24.0), run("edge-nerf", 0, 30.0)]
    text = markdown(runs, [])
    assert "| Random | 20.00 ✗1/1 <sub>13.12</sub> |" in text  # seed 1 only one of them has
    assert "| Edge | 30.00 <sub>29.38</sub> |" in text
    assert "Table 1" not in text
    assert "Precrop" not in text
    runs += [run("edge-nerf", 1, 31.0)]
    text = markdown(runs, [])
    assert "| Random | 22.00 ± 2.83 ✗1/2 <sub>13.12</sub> |" in text
    assert "| Edge | 30.50 ± 0.71 <sub>29.38</sub> |" in text
    assert "| Random | 24.00 <sub>13.12</sub> |" in markdown(runs[1:2] + runs[2:3], [])  # none in common: what there is
    runs += [run("edge-nerf", 0, 20.0, scene="chair"), run("edge-nerf", 1, 22.0, scene="chair")]
    (table,) = rows_of(runs)
    chair, mic, mean = table.rows[1][1]
    assert chair is not None
    assert mic is not None
    assert mean is not None
    assert (chair.psnr, mic.psnr, mean.psnr) == (21.0, 30.5, 25.75)  # of scenes, not of runs
    assert mean.deviation is None
