"""Squared errors -> ranks -> kept candidates: equations 6 and 7, drawn without replacement."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from goodness import ALPHA, mean_is, p_value

from edge_se_sampler.sampling import ranking
from edge_se_sampler.sampling.ranking import error_ranks, sample_by_rank

Ranking = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def literal_argsort(errors: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Equation 6 to the letter: the indices that sort, not the ranks."""
    return np.argsort(errors) + 1


WRONG: dict[str, Ranking] = {
    "the literal argsort": literal_argsort,
    "descending": lambda errors, rng: len(errors) + 1 - error_ranks(errors, rng),
    "all alike": lambda errors, rng: np.ones(len(errors)),
    "squared ranks": lambda errors, rng: error_ranks(errors, rng) ** 2,
    "the errors themselves": lambda errors, rng: errors + 1e-9,
}


def test_the_rank_differs_from_the_literal_argsort() -> None:
    errors = np.array([0.3, 0.1, 0.9, 0.2])
    assert error_ranks(errors, np.random.default_rng(0)).tolist() == [3, 1, 4, 2]
    assert literal_argsort(errors, np.random.default_rng(0)).tolist() == [2, 4, 1, 3]


# ---- ranks


@pytest.mark.parametrize("count", [1, 2, 3, 100, 4097])
def test_ranks_count_the_errors_that_are_not_larger(count: int) -> None:
    errors = np.random.default_rng(count).exponential(size=count)
    ranks = error_ranks(errors, np.random.default_rng(0))
    assert ranks.dtype == np.int64
    assert ranks.tolist() == [int((errors <= error).sum()) for error in errors]


def test_ranks_of_ties_are_those_that_the_tied_share() -> None:
    errors = np.random.default_rng(0).integers(0, 5, 200).astype(float)
    ranks = error_ranks(errors, np.random.default_rng(0))
    assert sorted(ranks) == list(range(1, 201))
    order = np.argsort(ranks)
    assert (np.diff(errors[order]) >= 0).all()


@pytest.mark.parametrize(
    ("errors", "tied"), [([0.5, 0.5, 0.5], [0, 1, 2]), ([0, 0, 0, 0], [0, 1, 2, 3]), ([2, 1, 9, 1, 1, 0], [1, 3, 4])]
)
def test_ties_fall_in_every_order_equally_often(errors: list[float], tied: list[int]) -> None:
    rng = np.random.default_rng(0)
    orders = {order: 0 for order in itertools.permutations(range(len(tied)))}
    for _ in range(6000):
        ranks = error_ranks(np.array(errors), rng)[tied]
        orders[tuple((ranks - ranks.min()).tolist())] += 1
    assert p_value(np.array(list(orders.values())), np.full(len(orders), 1 / len(orders))) > ALPHA


# ---- what is kept


def fits_equation_7(monkeypatch: pytest.MonkeyPatch, ranks: Ranking) -> bool:
    """One of five candidates: kept with probability rank / sum of ranks, exactly."""
    monkeypatch.setattr(ranking, "error_ranks", ranks)
    errors = torch.tensor([0.4, 0.1, 0.5, 0.2, 0.3])
    rng = np.random.default_rng(0)
    kept = np.bincount([int(sample_by_rank(errors, 1, rng).rows) for _ in range(5_000)], minlength=5)
    return p_value(kept, np.array([4, 1, 5, 2, 3]) / 15) > ALPHA


def test_one_of_five_follows_equation_7(monkeypatch: pytest.MonkeyPatch) -> None:
    assert fits_equation_7(monkeypatch, error_ranks)


@pytest.mark.parametrize("wrong", [*WRONG, "ranks from 0"])
def test_one_of_five_would_show_a_wrong_rank(wrong: str, monkeypatch: pytest.MonkeyPatch) -> None:
    weights = (WRONG | {"ranks from 0": lambda errors, rng: error_ranks(errors, rng) - 1 + 1e-12})[wrong]
    if wrong == "the errors themselves":  # here they are the ranks, but for a factor
        assert fits_equation_7(monkeypatch, weights)
    else:
        assert not fits_equation_7(monkeypatch, weights)


M, TRIALS, BINS = 2000, 500, 20
CENTRES = (np.arange(M) + 1) / M
INCLUSION = 1 - np.exp(-1.594 * CENTRES)
"""The closed form for N = m / 2 and many candidates."""


def fits_closed_form(monkeypatch: pytest.MonkeyPatch, ranks: Ranking) -> bool:
    """Whether half of many candidates are kept as often as the closed form says, rank by rank.

    Inclusions are negatively dependent, so a bin's count varies less than independent ones would.
    """
    monkeypatch.setattr(ranking, "error_ranks", ranks)
    rng = np.random.default_rng(0)
    kept = np.zeros(M)
    for _ in range(TRIALS):
        true_rank = rng.permutation(M)
        errors = torch.from_numpy((true_rank / M) ** 4)  # skewed, as errors are
        kept[true_rank[sample_by_rank(errors, M // 2, rng).rows.numpy()]] += 1
    counted = kept.reshape(BINS, -1).sum(axis=1)
    expected = TRIALS * INCLUSION.reshape(BINS, -1).sum(axis=1)
    spread = np.sqrt(TRIALS * (INCLUSION * (1 - INCLUSION)).reshape(BINS, -1).sum(axis=1))
    top = kept[-10:].sum() / (10 * TRIALS)
    return bool((np.abs(counted - expected) < 5.45 * spread).all()) and abs(top - 0.797) < 0.03  # ALPHA over 20 bins


def test_half_of_many_follow_the_closed_form(monkeypatch: pytest.MonkeyPatch) -> None:
    assert math.isclose(INCLUSION.mean(), 0.5, abs_tol=1e-3)  # 1.594 is what makes half of them stay
    assert fits_closed_form(monkeypatch, error_ranks)


@pytest.mark.parametrize("wrong", WRONG)
def test_half_of_many_would_show_a_wrong_rank(wrong: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not fits_closed_form(monkeypatch, WRONG[wrong])


@pytest.mark.parametrize(("count", "keep"), [(1, 1), (2, 1), (7, 3), (7, 7), (4096, 2048), (4096, 1), (4096, 4095)])
def test_exactly_n_different_rows_in_order(count: int, keep: int) -> None:
    errors = torch.rand(count, generator=torch.Generator().manual_seed(0))
    before = errors.clone()
    kept = sample_by_rank(errors, keep, np.random.default_rng(0))
    rows = kept.rows.tolist()
    assert len(rows) == keep
    assert rows == sorted(set(rows))
    assert rows[0] >= 0
    assert rows[-1] < count
    assert kept.rows.dtype == torch.int64
    assert kept.inclusion.dtype == torch.float32
    assert kept.inclusion.shape == (keep,)
    assert ((kept.inclusion > 0) & (kept.inclusion <= 1)).all()
    assert torch.equal(errors, before)


def test_keeping_all_has_inclusion_probability_one() -> None:
    kept = sample_by_rank(torch.rand(50), 50, np.random.default_rng(0))
    assert kept.rows.tolist() == list(range(50))
    assert kept.inclusion.tolist() == [1.0] * 50


@pytest.mark.parametrize("keep", [0, -1, 6, 100])
def test_n_out_of_range_is_refused(keep: int) -> None:
    with pytest.raises(ValueError, match=f"cannot keep {keep} of 5"):
        sample_by_rank(torch.rand(5), keep, np.random.default_rng(0))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", [[0], [4], [1, 3]])
def test_an_error_that_is_not_finite_is_an_error(bad: float, where: list[int]) -> None:
    errors = torch.rand(5)
    errors[where] = bad
    with pytest.raises(FloatingPointError, match=f"{len(where)} of 5 candidates are not finite"):
        sample_by_rank(errors, 2, np.random.default_rng(0))


def test_the_largest_float32_is_finite() -> None:
    errors = torch.tensor([0.0, torch.finfo(torch.float32).max])
    kept = [int(sample_by_rank(errors, 1, np.random.default_rng(seed)).rows) for seed in range(300)]
    assert p_value(np.bincount(kept, minlength=2), np.array([1 / 3, 2 / 3])) > ALPHA


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_the_same_generator_keeps_the_same(dtype: torch.dtype) -> None:
    errors = torch.arange(60).flip(0).to(dtype).requires_grad_()
    first, second = (sample_by_rank(errors, 20, np.random.default_rng(3)) for _ in range(2))
    assert torch.equal(first.rows, second.rows)
    assert torch.equal(first.inclusion, second.inclusion)
    assert not first.inclusion.requires_grad


# ---- weights


def weighted_means(weight: Callable[[ranking.Selection, np.ndarray], np.ndarray]) -> tuple[np.ndarray, float]:
    """Weighted means over 10 kept of 20 candidates of a value that grows with the error, and the plain mean of all."""
    value = np.linspace(0, 1, 20) ** 2
    errors, rng = torch.from_numpy(value), np.random.default_rng(0)
    p = np.arange(1, 21) / 210
    means = np.empty(8_000)
    for i in range(len(means)):
        kept = sample_by_rank(errors, 10, rng)
        means[i] = (weight(kept, p) * value[kept.rows.numpy()]).sum() / 20
    return means, float(value.mean())


def test_inverse_inclusion_makes_the_mean_unbiased() -> None:
    assert mean_is(*weighted_means(lambda kept, p: 1 / kept.inclusion.numpy()))


@pytest.mark.parametrize(
    ("wrong", "weight"),
    [
        ("1 / p of equation 7", lambda kept, p: 1 / (10 * p[kept.rows.numpy()])),
        ("none", lambda kept, p: np.full(10, 2.0)),
    ],
)
def test_other_weights_are_biased(wrong: str, weight: Callable) -> None:
    means, truth = weighted_means(weight)
    assert not mean_is(means, truth), wrong
    assert abs(means.mean() / truth - 1) > 0.05
