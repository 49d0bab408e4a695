"""Squared-error sampling: candidates drawn uniformly, scored without gradients, kept by rank."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
import torch
from batches import LATE, MIXED, NUMBERS, SAME, batch_of, brightness, following, half_masks
from goodness import ALPHA, p_value, pixel_counts
from torch import Tensor


class Model:
    """Scores candidates as a function of their pixel, and records the calls."""

    def __init__(self) -> None:
        self.calls: list[dict[str, Any]] = []
        self.grad: list[bool] = []
        self.weight = torch.ones((), requires_grad=True)

    def __call__(self, candidates: dict[str, Any]) -> Tensor:
        self.calls.append(candidates)
        self.grad.append(torch.is_grad_enabled())
        return self.weight * brightness(candidates)


@pytest.mark.parametrize("candidates", [2, 3, 5])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("sizes", [SAME, MIXED])
def test_n_of_the_candidates_without_replacement(candidates: int, masked: bool, sizes: Any) -> None:
    model = Model()
    host = batch_of(sizes, masks=half_masks(sizes) if masked else None)
    pixels = following(LATE, rays=50, se_candidates=candidates, squared_error=model).sample(host)
    assert len(model.calls) == 1
    offered = model.calls[0]
    assert set(offered) == set(pixels)
    assert all(len(value) == candidates * 50 for value in offered.values())
    assert torch.equal(offered["address"], offered["indices"])
    assert len(pixels["indices"]) == 50
    kept = Counter(map(tuple, pixels["indices"].tolist()))
    assert kept <= Counter(map(tuple, offered["indices"].tolist()))  # as often as offered at most


def test_candidates_are_scored_without_gradients() -> None:
    model = Model()
    sampler = following(LATE, squared_error=model)
    with torch.enable_grad():
        sampler.sample(batch_of())
        assert torch.is_grad_enabled()
    assert model.grad == [False]


def test_the_model_scores_nothing_before_the_late_phase() -> None:
    model = Model()
    for early in ("uniform", "precrop", "edge"):
        following(0, early=early, squared_error=model).sample(batch_of())
    assert model.calls == []


def test_candidates_are_uniform() -> None:
    model = Model()
    following(LATE, rays=20_000, images_per_step="all", squared_error=model).sample(batch_of())
    indices = model.calls[0]["indices"]
    order = torch.tensor([NUMBERS.index(number) for number in indices[:, 0].tolist()])
    counts = pixel_counts(torch.cat((order[:, None], indices[:, 1:]), dim=1), (3, 9, 14))
    assert p_value(counts, np.full(counts.shape, 1 / counts.size)) > ALPHA


def kept_candidates(errors: Tensor, rays: int, candidates: int) -> Tensor:
    """(m,) 1 for the candidates that stay when the model answers these errors."""

    def squared_error(offered: dict[str, Any]) -> Tensor:
        offered["row"] = torch.arange(len(errors))  # one more key of a candidate
        return errors

    sampler = following(LATE, rays=rays, se_candidates=candidates, squared_error=squared_error)
    kept = sampler.sample(batch_of())["row"]
    assert len(kept.unique()) == rays
    return torch.bincount(kept, minlength=len(errors)).double()


@pytest.mark.parametrize(("candidates", "constant"), [(2, 1.59362), (3, 0.87421)])
def test_large_errors_are_kept_as_the_closed_form_says(candidates: int, constant: float) -> None:
    rays, m = 10_000, candidates * 10_000
    inclusion = -torch.expm1(-constant * (torch.arange(m).double() + 1) / m)  # by rank; `constant` makes N stay
    assert inclusion.sum() == pytest.approx(rays, rel=1e-3)
    errors = torch.rand(m, generator=torch.Generator().manual_seed(1)) ** 4
    kept = kept_candidates(errors, rays, candidates)[torch.argsort(errors)]

    def per_bin(values: Tensor) -> Tensor:
        return values.reshape(20, -1).sum(dim=1)

    bound = 5.45 * per_bin(inclusion * (1 - inclusion)).sqrt()  # ALPHA over 20 bins
    assert ((per_bin(kept) - per_bin(inclusion)).abs() < bound).all()
    assert not ((rays / 20 - per_bin(inclusion)).abs() < bound).all()  # all alike would be seen


def test_an_error_that_is_not_finite_stops_the_step() -> None:
    def diverged(candidates: dict[str, Any]) -> Tensor:
        errors = brightness(candidates)
        errors[3] = torch.nan
        return errors

    with pytest.raises(FloatingPointError, match="1 of 128 candidates"):
        following(LATE, squared_error=diverged).sample(batch_of())


@pytest.mark.parametrize("wrong", [lambda e: e[:-1], lambda e: torch.cat((e, e))])
def test_one_error_a_candidate(wrong: Any) -> None:
    with pytest.raises(ValueError, match="128"):
        following(LATE, squared_error=lambda candidates: wrong(brightness(candidates))).sample(batch_of())


def test_edge_tables_are_given_back_in_the_late_phase() -> None:
    sampler = following(0)
    edges = sampler.strategies["edge"].distribution
    sampler.sample(batch_of())
    assert len(edges._table) == 3
    sampler.set_step(LATE)
    sampler.sample(batch_of())
    assert len(edges._table) == 0
