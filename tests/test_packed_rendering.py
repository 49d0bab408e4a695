"""Packed rendering against the rendering of whole rays, and its closed-form gradients against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from edge_se_sampler.models.packed_rendering import (
    accumulate_along_rays,
    expand_to_samples,
    render_packed,
    transmittance,
)
from edge_se_sampler.models.rendering import composite, sample_weights

STEP = 0.13


def packed(counts: list[int], seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Density, colour, first, ray of rays with these numbers of samples."""
    rng = np.random.default_rng(seed)
    total = sum(counts)
    density = torch.from_numpy(rng.gamma(0.6, 4, total))
    ray = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    first = torch.tensor(np.cumsum([0, *counts[:-1]]), dtype=torch.int64)
    return density, torch.from_numpy(rng.random((total, 3))), first, ray


def whole(density: Tensor, color: Tensor, counts: list[int]) -> tuple[Tensor, Tensor]:
    """The same by volume.py: every ray filled up with samples of density 0."""
    most = max(counts)
    rows, at = torch.zeros(len(counts), most).double(), 0
    colors = torch.zeros(len(counts), most, 3).double()
    for i, count in enumerate(counts):
        rows[i, :count], colors[i, :count] = density[at : at + count], color[at : at + count]
        at += count
    weights = sample_weights(rows, torch.full_like(rows, STEP))
    return composite(weights, colors, torch.zeros(3).double()), weights.sum(1, keepdim=True)


@pytest.mark.parametrize("counts", [[5, 1, 7, 3], [0, 4, 0, 0, 6, 0], [1], [300, 2, 250]])
def test_packed_rays_are_rendered_as_whole_ones(counts: list[int]) -> None:
    density, color, first, ray = packed(counts)
    density.requires_grad_()
    color.requires_grad_()
    shown = render_packed(density, color, STEP, first, ray)
    expected = whole(density, color, counts)
    toward = torch.from_numpy(np.random.default_rng(1).normal(size=(len(counts), 4)))
    gradients = []
    for rgb, accumulation in (shown, expected):
        gradients.append(torch.autograd.grad((torch.cat((rgb, accumulation), 1) * toward).sum(), (density, color)))
    for one, other in zip(shown, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-12)
    for one, other in zip(*gradients, strict=True):
        assert bool(one.any())
        torch.testing.assert_close(one, other, rtol=0, atol=1e-12)


def test_gradients_against_finite_differences() -> None:
    density, color, first, ray = packed([3, 0, 5])
    inputs = (density.requires_grad_(), color.requires_grad_())
    assert torch.autograd.gradcheck(lambda d, c: render_packed(d, c, STEP, first, ray), inputs)
    values = torch.randn(3, 4, dtype=torch.float64, requires_grad=True, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(lambda v: expand_to_samples(v, first, ray), (values,))


def test_rays_do_not_see_each_other() -> None:
    """A ray that is opaque leaves nothing of the optical depth it has piled up to the next."""
    density, color, first, ray = packed([50, 4, 4])
    density[:50] = 1e4
    rgb, accumulation = render_packed(density, color, STEP, first, ray)
    alone, _ = render_packed(density[50:54], color[50:54], STEP, first[:1], ray[:4])
    torch.testing.assert_close(rgb[1], alone[0], rtol=0, atol=1e-10)
    assert float(accumulation[0]) == pytest.approx(1)
    assert float(transmittance(density * STEP, first, ray)[50]) == pytest.approx(1)


def test_in_float32_many_rays_keep_their_digits() -> None:
    counts = [20] * 5000
    density, color, first, ray = packed(counts)
    shown = render_packed(density.float(), color.float(), STEP, first, ray)
    for one, other in zip(shown, whole(density, color, counts), strict=True):
        torch.testing.assert_close(one.double(), other, rtol=0, atol=2e-6)


def test_no_samples_at_all() -> None:
    density, color, first, ray = packed([0, 0])
    density.requires_grad_()
    rgb, accumulation = render_packed(density, color, STEP, first, ray)
    assert not bool(rgb.any())
    assert not bool(accumulation.any())
    rgb.sum().backward()


def test_sums_along_rays() -> None:
    _, color, first, ray = packed([3, 0, 5, 1])
    expected = torch.zeros(4, 3).double().index_add_(0, ray, color)
    torch.testing.assert_close(accumulate_along_rays(color, first), expected)
    torch.testing.assert_close(expand_to_samples(expected, first, ray), expected[ray])
