"""The goodness-of-fit test itself: it keeps its error rate and sees what it should."""

from __future__ import annotations

import numpy as np
import pytest
from goodness import mean_is, p_value


@pytest.mark.parametrize(("statistic", "cells", "expected"), [(10.827566, 2, 1e-3), (18.307038, 11, 0.05)])
def test_p_values_of_chi_square_tables(statistic: float, cells: int, expected: float) -> None:
    # two cells off by d and -d, the others exact: statistic = 2 d^2 / e
    each = 1e6
    counts = np.full(cells, each)
    counts[0] += np.sqrt(statistic * each / 2)
    counts[1] -= np.sqrt(statistic * each / 2)
    assert p_value(counts, np.full(cells, 1 / cells)) == pytest.approx(expected, rel=1e-5)


def test_p_values_of_true_draws_are_uniform() -> None:
    rng = np.random.default_rng(0)
    p = np.arange(1, 11) / 55
    values = [p_value(rng.multinomial(10_000, p), p) for _ in range(2000)]
    assert p_value(np.histogram(values, bins=10, range=(0, 1))[0], np.full(10, 0.1)) > 1e-6


def test_an_impossible_cell_is_proof() -> None:
    assert p_value(np.array([1_000_000, 1]), np.array([1.0, 0.0])) == 0


def test_mean_is_rejects_six_sigma() -> None:
    samples = np.random.default_rng(0).normal(size=10_000)
    assert mean_is(samples, 0)
    assert not mean_is(samples, 0.06)
