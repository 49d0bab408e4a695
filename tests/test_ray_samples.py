"""Where samples fall along a ray: stratified bins, and importance draws against the CDF that they follow.

A draw is accepted if its empirical CDF stays within the Dvoretzky-Kiefer-Wolfowitz bound of the analytic one, at
alpha 1e-6; the same test must reject samplers that are wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from edge_se_sampler.models.rendering import importance, stratified

COUNT = 200_000
ALPHA = 1e-6
BOUND = math.sqrt(math.log(2 / ALPHA) / (2 * COUNT))

EDGES = np.array([2.0, 2.1, 2.5, 2.6, 3.4, 4.0, 4.9, 5.0, 6.0])
WEIGHTS = np.array([0.05, 0.0, 0.3, 0.1, 0.02, 0.0, 0.25, 0.08])

Sampler = Callable[[Tensor, Tensor, Tensor], Tensor]


def distance(draws: np.ndarray, edges: np.ndarray, weights: np.ndarray) -> float:
    """Kolmogorov's: the largest gap between the draws' CDF and that of the histogram, 1e-5 added to its bars."""
    bars = weights + 1e-5
    ordered = np.sort(draws)
    analytic = np.interp(ordered, edges, np.concatenate(([0], np.cumsum(bars) / bars.sum())))
    steps = np.arange(len(ordered) + 1) / len(ordered)
    return float(max((steps[1:] - analytic).max(), (analytic - steps[:-1]).max()))


def drawn(sampler: Sampler, dtype: torch.dtype = torch.float64) -> float:
    """The distance of many seeded draws of a sampler."""
    uniform = torch.from_numpy(np.random.default_rng(0).random((1, COUNT))).to(dtype)
    edges, weights = (torch.from_numpy(values)[None].to(dtype) for values in (EDGES, WEIGHTS))
    return distance(sampler(edges, weights, uniform)[0].double().numpy(), EDGES, WEIGHTS)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_draws_follow_the_weights(dtype: torch.dtype) -> None:
    assert drawn(importance, dtype) < BOUND


WRONG: dict[str, Sampler] = {
    "uniform in distance": lambda edges, weights, u: edges[:, :1] + u * (edges[:, -1:] - edges[:, :1]),
    "uniform in bins": lambda edges, weights, u: importance(edges, torch.ones_like(weights), u),
    "reversed": lambda edges, weights, u: importance(edges, weights.flip(1), u),
    "off by one bin": lambda edges, weights, u: importance(edges, weights.roll(1, dims=1), u),
    "squared weights": lambda edges, weights, u: importance(edges, weights.square(), u),
    "softmax": lambda edges, weights, u: importance(edges, torch.softmax(weights, dim=1), u),
    "bins' middles": lambda edges, weights, u: (importance(edges, weights, u) * 2).round() / 2,
    "half a bin early": lambda edges, weights, u: importance(edges, weights, (u - 0.01).clamp(0, 1)),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_sampler_is_found_out(name: str) -> None:
    assert drawn(WRONG[name]) > BOUND


def test_every_ray_follows_its_own_weights() -> None:
    rng = np.random.default_rng(1)
    edges = np.sort(rng.uniform(2, 6, (4, 11)), axis=1)
    weights = rng.dirichlet(np.full(10, 0.3), 4)
    draws = importance(torch.from_numpy(edges), torch.from_numpy(weights), torch.from_numpy(rng.random((4, COUNT))))
    for i in range(4):
        assert distance(draws[i].numpy(), edges[i], weights[i]) < BOUND
        assert distance(draws[i].numpy(), edges[i], weights[(i + 1) % 4]) > BOUND


def test_an_empty_ray_is_sampled_evenly() -> None:
    edges = torch.linspace(2, 6, 9, dtype=torch.float64)[None]
    u = torch.linspace(0, 1, 101, dtype=torch.float64)[None]
    torch.testing.assert_close(importance(edges, torch.zeros(1, 8, dtype=torch.float64), u), 2 + 4 * u)


def test_one_bright_bin_takes_all_but_the_floor() -> None:
    edges = torch.linspace(0, 10, 11, dtype=torch.float64)[None]
    weights = torch.zeros(1, 10, dtype=torch.float64)
    weights[0, 3] = 0.5
    u = (torch.arange(100_000, dtype=torch.float64)[None] + 0.5) / 100_000
    draws = importance(edges, weights, u)
    inside = float(((draws >= 3) & (draws <= 4)).double().mean())
    assert inside == pytest.approx((0.5 + 1e-5) / (0.5 + 1e-4), abs=1e-5)
    assert float(draws.min()) < 3  # the floor reaches every bin
    assert float(draws.max()) > 4


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_draws_stay_inside_and_ascend_with_the_uniform_numbers(dtype: torch.dtype) -> None:
    """Weights of real renderings: many empty bins, sums up to 1; uniform numbers with both ends."""
    rng = np.random.default_rng(2)
    edges = torch.from_numpy(np.sort(rng.uniform(2, 6, (300, 63)), axis=1)).to(dtype)
    weights = torch.from_numpy(rng.dirichlet(np.full(62, 0.02), 300) * rng.uniform(0, 1, (300, 1))).to(dtype)
    ends = np.concatenate((np.zeros((300, 1)), np.sort(rng.random((300, 200)), axis=1), np.ones((300, 1))), axis=1)
    draws = importance(edges, weights, torch.from_numpy(ends).to(dtype))
    assert bool(torch.isfinite(draws).all())
    assert bool((draws >= edges[:, :1]).all())
    assert bool((draws <= edges[:, -1:]).all())
    assert bool((draws[:, 1:] >= draws[:, :-1] - 4 * torch.finfo(dtype).eps).all())
    torch.testing.assert_close(draws[:, 0], edges[:, 0])


def test_evaluation_samples_are_evenly_spaced_with_both_ends() -> None:
    near, far = torch.tensor([[2.0], [1.0]]), torch.tensor([[6.0], [3.0]])
    t = stratified(near, far, 5, None)
    assert t.tolist() == [[2, 3, 4, 5, 6], [1, 1.5, 2, 2.5, 3]]


def test_one_jittered_sample_falls_in_each_bin() -> None:
    """Bins end halfway between the evaluation's samples (the outer two at near and far)."""
    near, far = torch.tensor([[2.0], [1.0]]).double(), torch.tensor([[6.0], [3.0]]).double()
    u = torch.from_numpy(np.random.default_rng(3).random((2, 5)))
    t = stratified(near, far, 5, u)
    for ray, bounds in enumerate(([2, 2.5, 3.5, 4.5, 5.5, 6], [1, 1.25, 1.75, 2.25, 2.75, 3])):
        assert np.histogram(t[ray], bounds)[0].tolist() == [1, 1, 1, 1, 1]
        within = (t[ray].numpy() - bounds[:-1]) / np.diff(bounds)
        np.testing.assert_allclose(within, u[ray], atol=1e-12)  # so uniform in its bin
