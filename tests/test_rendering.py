"""Volume rendering against integrals that can be written down."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from edge_se_sampler.models.rendering import composite, intervals, sample_weights

BACKGROUND = torch.tensor([0.9, 0.5, 0.1], dtype=torch.float64)
RED = torch.tensor([0.8, 0.1, 0.2], dtype=torch.float64)
BLUE = torch.tensor([0.1, 0.3, 0.7], dtype=torch.float64)


def rendered(t: Tensor, sigma: Tensor, colors: Tensor, background: Tensor = BACKGROUND) -> Tensor:
    """(3,) colour of one ray with samples t (s,)."""
    return composite(sample_weights(sigma[None], intervals(t[None])), colors[None], background)[0]


def unit_draws(count: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random(count))


def test_intervals_reach_to_the_next_sample_and_the_last_to_infinity() -> None:
    assert intervals(torch.tensor([[1.0, 2.0, 4.0]])).tolist() == [[1.0, 2.0, 1e10]]


def test_one_slab_is_exact_however_it_is_sampled() -> None:
    """Density 1.3 between 1 and 3: Beer-Lambert, if samples lie on both faces, wherever the others are."""
    inside = 1 + 2 * unit_draws(20)
    t = torch.cat((torch.tensor([0.5, 1.0]), inside, torch.tensor([3.0, 3.7]))).sort().values
    sigma = 1.3 * ((t >= 1) & (t < 3)).double()
    through = math.exp(-1.3 * 2)
    color = rendered(t, sigma, RED.expand(len(t), 3))
    torch.testing.assert_close(color, RED * (1 - through) + BACKGROUND * through, rtol=0, atol=1e-14)


def test_two_slabs_of_different_density_and_colour_are_exact() -> None:
    t = torch.cat((torch.tensor([0.2, 1.0, 2.0, 2.5, 4.0]), 1 + 3.5 * unit_draws(40, 1))).sort().values
    first, second = (t >= 1) & (t < 2), (t >= 2.5) & (t < 4)
    sigma = 0.7 * first.double() + 1.9 * second.double()
    colors = torch.where(first[:, None], RED, BLUE)
    past_first, past_second = math.exp(-0.7 * 1), math.exp(-1.9 * 1.5)
    expected = RED * (1 - past_first) + past_first * (BLUE * (1 - past_second) + past_second * BACKGROUND)
    torch.testing.assert_close(rendered(t, sigma, colors), expected, rtol=0, atol=1e-14)


def test_colour_that_changes_along_the_ray_converges_to_its_integral() -> None:
    """Density s in [a, b], colour t: the integral of s exp(-s (t - a)) t is a + 1/s - exp(-s (b - a)) (b + 1/s)."""
    a, b, s = 1.0, 3.0, 1.7
    expected = a + 1 / s - math.exp(-s * (b - a)) * (b + 1 / s)
    errors = []
    for count in (50, 500, 5000):
        t = torch.linspace(a, b, count, dtype=torch.float64)
        sigma = torch.full_like(t, s)
        sigma[-1] = 0
        color = rendered(t, sigma, t[:, None].expand(-1, 3), torch.zeros(3, dtype=torch.float64))
        errors.append(abs(float(color[0]) - expected))
    assert errors[2] < 5e-4
    for coarse, fine in pairwise(errors):  # first order
        assert 8 < coarse / fine < 12


def test_faces_between_samples_converge() -> None:
    """Slabs of the ordinary case: no sample on a face."""
    t = torch.from_numpy(np.sort(np.random.default_rng(2).uniform(0, 5, 20_000)))
    sigma = 1.3 * ((t >= 1) & (t < 3)).double()
    through = math.exp(-1.3 * 2)
    expected = RED * (1 - through) + BACKGROUND * through
    torch.testing.assert_close(rendered(t, sigma, RED.expand(len(t), 3)), expected, rtol=0, atol=1e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("density", [1e-8, 1e-3, 1.0, 1e20])
def test_the_last_sample_is_opaque_at_any_positive_density(density: float, dtype: torch.dtype) -> None:
    t = torch.linspace(2, 6, 5, dtype=dtype)[None]
    sigma = torch.zeros_like(t)
    sigma[0, -1] = density
    weights = sample_weights(sigma, intervals(t))
    torch.testing.assert_close(weights, torch.eye(5, dtype=dtype)[4:], rtol=0, atol=1e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nothing_shows_the_background_to_the_last_bit(dtype: torch.dtype) -> None:
    t = torch.linspace(2, 6, 64, dtype=dtype).expand(3, 64)
    backgrounds = torch.rand(3, 3, generator=torch.Generator().manual_seed(1)).to(dtype)
    weights = sample_weights(torch.zeros_like(t), intervals(t))
    assert torch.equal(composite(weights, torch.rand(3, 64, 3).to(dtype), backgrounds), backgrounds)
    assert torch.equal(composite(weights, torch.rand(3, 64, 3).to(dtype), backgrounds[0]), backgrounds[:1].expand(3, 3))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_weights_are_shares(dtype: torch.dtype) -> None:
    rng = np.random.default_rng(3)
    t = torch.from_numpy(np.sort(rng.uniform(2, 6, (500, 64)), axis=1)).to(dtype)
    sigma = torch.from_numpy(rng.choice([0, 1e-12, 0.1, 1, 30, 1e6, 1e30], (500, 64))).to(dtype)
    weights = sample_weights(sigma, intervals(t))
    assert bool(((weights >= 0) & (weights <= 1)).all())
    rounding = 64 * torch.finfo(dtype).eps
    assert float(weights.sum(1).max()) <= 1 + rounding
    assert float(weights.sum(1)[sigma[:, -1] > 0.01].min()) >= 1 - rounding  # the last is opaque: all of the light


def test_weights_against_the_product_of_the_original_code() -> None:
    """alpha_i prod_{j < i} (1 - alpha_j), multiplied out in numpy."""
    rng = np.random.default_rng(4)
    t = np.sort(rng.uniform(2, 6, (200, 32)), axis=1)
    sigma = rng.exponential(1, (200, 32)) * rng.integers(0, 2, (200, 32))
    expected = np.empty_like(sigma)
    for ray in range(200):
        light = 1.0
        for i in range(32):
            delta = t[ray, i + 1] - t[ray, i] if i < 31 else 1e10
            alpha = 1 - math.exp(-sigma[ray, i] * delta)
            expected[ray, i] = light * alpha
            light *= 1 - alpha
    weights = sample_weights(torch.from_numpy(sigma), intervals(torch.from_numpy(t)))
    np.testing.assert_allclose(weights, expected, rtol=0, atol=1e-14)


def test_thin_densities_keep_their_digits() -> None:
    """1 - exp(-x) in float32 would round x = 1e-9 to nothing; the weight is x."""
    weights = sample_weights(torch.full((1, 3), 1e-9), torch.ones(1, 3))
    torch.testing.assert_close(weights, torch.full((1, 3), 1e-9), rtol=1e-5, atol=0)


def test_gradients_in_empty_space_are_the_closed_form() -> None:
    """Around density 0 the colour is bg + sum sigma_i delta_i (c_i - bg): how a dead ray could come back."""
    t = torch.tensor([1.0, 1.5, 2.5, 3.0], dtype=torch.float64)
    colors = torch.from_numpy(np.random.default_rng(5).random((4, 3)))
    sigma = torch.zeros(4, dtype=torch.float64, requires_grad=True)
    rendered(t, sigma, colors)[0].backward()
    delta = torch.tensor([0.5, 1.0, 0.5, 1e10], dtype=torch.float64)
    torch.testing.assert_close(sigma.grad, delta * (colors[:, 0] - BACKGROUND[0]))


def test_gradients_against_finite_differences() -> None:
    rng = np.random.default_rng(6)
    sigma = torch.from_numpy(rng.uniform(0.1, 2, (2, 5))).requires_grad_()
    colors = torch.from_numpy(rng.random((2, 5, 3))).requires_grad_()
    delta = torch.from_numpy(rng.uniform(0.1, 1, (2, 5)))

    def color(sigma: Tensor, colors: Tensor) -> Tensor:
        return composite(sample_weights(sigma, delta), colors, BACKGROUND)

    assert torch.autograd.gradcheck(color, (sigma, colors))
