"""What holds of the probabilities of any image (hypothesis)."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_se_sampler.sampling.distribution import CDF_SCALE, PixelTable

QUANTUM = 2 / CDF_SCALE


@st.composite
def strengths(draw: st.DrawFn) -> np.ndarray:
    """(H, W) float32 with zeros, long enough for several blocks and sometimes superblocks."""
    height, width = draw(st.integers(1, 48)), draw(st.integers(1, 48))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    spread = draw(st.sampled_from([0, 1, 4]))
    strength = np.exp(spread * rng.normal(size=(height, width))).astype(np.float32)
    strength[rng.random((height, width)) < draw(st.sampled_from([0, 0.3, 0.97, 1]))] = 0
    return strength


def probability(strength: np.ndarray) -> np.ndarray:
    table = PixelTable()
    table.add([torch.from_numpy(strength)])
    return table.probability(0).numpy()


@settings(max_examples=60, deadline=None, derandomize=True)
@given(strengths())
def test_sums_to_one_over_the_pixels_that_have_strength(strength: np.ndarray) -> None:
    before = strength.copy()
    p = probability(strength)
    assert p.min() >= 0
    assert not p[strength == 0].any()
    assert abs(p.sum() - strength.any()) < 1e-12
    if strength.any():
        np.testing.assert_allclose(
            p, strength.astype(np.float64) / strength.sum(dtype=np.float64), rtol=0, atol=QUANTUM
        )
    np.testing.assert_array_equal(strength, before)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(strengths(), st.integers(-60, 60))
def test_scaling_by_a_power_of_two_changes_no_bit(strength: np.ndarray, power: int) -> None:
    np.testing.assert_array_equal(probability(np.ldexp(strength, power)), probability(strength))


@settings(max_examples=40, deadline=None, derandomize=True)
@given(strengths(), st.floats(1e-6, 1e6))
def test_scaling_changes_nothing(strength: np.ndarray, scale: float) -> None:
    np.testing.assert_allclose(probability(strength.astype(np.float64) * scale), probability(strength), atol=QUANTUM)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(strengths(), st.randoms(use_true_random=False))
def test_permuting_pixels_permutes_probabilities(strength: np.ndarray, random) -> None:
    order = list(range(strength.size))
    random.shuffle(order)
    permuted = strength.ravel()[order].reshape(strength.shape)
    np.testing.assert_allclose(probability(permuted).ravel(), probability(strength).ravel()[order], atol=QUANTUM)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.lists(strengths(), min_size=1, max_size=4), st.integers(0, 2**32))
def test_other_images_change_nothing(images: list[np.ndarray], seed: int) -> None:
    table = PixelTable()
    table.add(torch.from_numpy(image) for image in images)
    for k, image in enumerate(images):
        np.testing.assert_allclose(table.probability(k).numpy(), probability(image), atol=1e-12)
    chosen = torch.nonzero(table.drawable(torch.arange(len(images))))[:, 0]
    assert chosen.tolist() == [k for k, image in enumerate(images) if image.any()]
    if len(chosen):
        drawn = table.draw(chosen, 200, np.random.default_rng(seed))
        assert all(images[chosen[k]][row, column] > 0 for k, row, column in drawn.tolist())
