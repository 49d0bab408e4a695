"""Loss weights that undo the sampling: the weighted mean over a batch is unbiased for the uniform mean."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from batches import LATE, MIXED, NUMBERS, SAME, batch_of, brightness, following, half_masks
from goodness import mean_is
from torch import Tensor

from edge_se_sampler.sampling.edges import WHITE, edge_strength


def batch_with_loss(sizes: Any, masks: list[Tensor]) -> dict[str, Any]:
    """A batch, and a loss (H, W) of every pixel that goes with its edge and its brightness."""
    host = batch_of(sizes, masks=masks, stacked=False)
    host["loss"] = [
        torch.from_numpy(edge_strength(image.numpy())).double() + (image.double().mean(dim=2) / 255) ** 3
        for image in host["image"]
    ]
    return host


def batch_means(host: dict[str, Any], weighted: bool, step: int, **settings: Any) -> np.ndarray:
    """The (weighted) loss of many batches."""
    sampler = following(step, rays=40, planned=10**6, importance_weight=1.0, **settings)
    means = []
    for number in range(500):
        sampler.set_step(step + number)
        pixels = sampler.sample(host)
        assert pixels["weight"].shape == (40,)
        weight = pixels["weight"].double() if weighted else 1
        means.append(float((weight * pixels["loss"]).mean()))
    return np.array(means)


CASES = [
    ("edge", 0, SAME, {"images_per_step": "one"}),
    ("edge", 0, MIXED, {"images_per_step": "all"}),
    ("se", 10**6 // 2, SAME, {"images_per_step": "one"}),
    ("se", 10**6 // 2, MIXED, {"images_per_step": "all", "se_candidates": 3}),
]


@pytest.mark.parametrize(("strategy", "step", "sizes", "settings"), CASES)
@pytest.mark.parametrize("weighted", [True, False])
def test_weighted_batches_are_unbiased_and_plain_ones_are_not(
    strategy: str, step: int, sizes: Any, settings: dict[str, Any], weighted: bool
) -> None:
    masks = half_masks(sizes)
    host = batch_with_loss(sizes, masks)
    truth = float(np.mean([float(loss[mask].mean()) for loss, mask in zip(host["loss"], masks, strict=True)]))
    assert mean_is(batch_means(host, weighted, step, **settings), truth) == weighted, strategy


@pytest.mark.parametrize("step", [0, LATE])
@pytest.mark.parametrize("power", [0.25, 0.5])
def test_a_power_between_is_that_power(step: int, power: float) -> None:
    full = following(step, importance_weight=1.0).sample(batch_of())
    part = following(step, importance_weight=power).sample(batch_of())
    assert torch.equal(full["indices"], part["indices"])
    torch.testing.assert_close(part["weight"], full["weight"] ** power)


@pytest.mark.parametrize("step", [0, LATE])
def test_weights_do_not_change_what_is_drawn(step: int) -> None:
    plain = following(step).sample(batch_of())
    weighted = following(step, importance_weight=1.0).sample(batch_of())
    assert "weight" not in plain
    assert weighted["weight"].dtype == torch.float32
    assert all(torch.equal(plain[key], weighted[key]) for key in plain)


def test_edge_weights_are_the_inverse_of_probability_times_pixels() -> None:
    sampler = following(0, importance_weight=1.0, rays=300, images_per_step="all")
    pixels = sampler.sample(batch_of(MIXED))
    for weight, (number, row, column) in zip(pixels["weight"].tolist(), pixels["indices"].tolist(), strict=True):
        image = batch_of(MIXED)["image"][NUMBERS.index(number)].numpy()
        strength = sampler.strategies["edge"].distribution.strength(image, WHITE).astype(np.float64)
        assert weight == pytest.approx(strength.mean() / strength[row, column], rel=1e-5)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(("step", "early"), [(0, "uniform"), (LATE, "edge"), (0, "precrop")])
def test_pixels_drawn_alike_weigh_one(masked: bool, step: int, early: str) -> None:
    host = batch_of(masks=half_masks(SAME) if masked else None)
    pixels = following(step, early=early, late="se" if step == 0 else "uniform", importance_weight=1.0).sample(host)
    torch.testing.assert_close(pixels["weight"], torch.ones(64), rtol=1e-6, atol=0)


def test_equal_errors_still_weigh_by_the_rank_they_happened_to_get() -> None:
    pixels = following(LATE, importance_weight=1.0, squared_error=lambda c: brightness(c) * 0).sample(batch_of())
    assert pixels["weight"].min() < 0.7  # 1 / (2 * 0.797)
    assert pixels["weight"].max() > 1
