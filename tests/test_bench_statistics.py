"""Intervals of rates and of paired differences."""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_se_sampler.bench.statistics import format_difference, paired_difference, wilson_interval


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


def test_one_seed_tells_nothing_of_its_deviation() -> None:
    assert paired_difference([("a", 1.0), ("b", 2.0)]).low is None


def test_the_interval_covers_the_true_difference_in_95_percent() -> None:
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(1000):
        drawn = rng.normal(0.4, 1.0, (7, 3)) + np.linspace(-2, 2, 7)[:, None]
        found = paired_difference([(str(i), d) for i, row in enumerate(drawn) for d in row.tolist()])
        assert found.low is not None
        assert found.high is not None
        covered += found.low < 0.4 < found.high
    assert 930 <= covered <= 968


def test_differences_are_printed_with_what_is_known_of_them() -> None:
    assert format_difference(paired_difference([])) == "–"
    assert format_difference(paired_difference([("a", 1.0), ("b", 2.0)])) == "+1.50"
    assert (
        format_difference(paired_difference([("a", d) for d in (-0.5, -0.5, 0.5, 0.5, 0.0)])) == "+0.00 [-0.62, +0.62]"
    )
