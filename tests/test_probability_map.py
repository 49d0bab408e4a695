"""The map that `edge-se show` draws is the probability that the sampler draws with."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from batches import MIXED, batch_of, following, half_masks
from goodness import ALPHA, p_value, pixel_counts

from edge_se_sampler.engine.show import probability_map
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig
from edge_se_sampler.sampling.strategies import Edge


@pytest.mark.parametrize("strategy", ["uniform", "precrop", "edge"])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("k", [0, 1, 2])
def test_the_map_is_what_the_sampler_draws_by(strategy: str, masked: bool, k: int) -> None:
    host = batch_of(MIXED, masks=half_masks(MIXED) if masked else None)
    sampler = following(0, early=strategy, edge_epsilon=0.1, rays=60_000)
    shown = probability_map(sampler.strategies[strategy].distribution, ImageBatch.of(host, use_mask=True), k)
    assert shown.shape == MIXED[k]
    assert shown.sum() == pytest.approx(1, abs=1e-12)
    alone = {key: value[k : k + 1] for key, value in host.items()}
    drawn = sampler.sample(alone)["indices"]
    assert p_value(pixel_counts(drawn[:, 1:], MIXED[k]), shown) > ALPHA


def test_a_fully_masked_view_is_dark() -> None:
    host = batch_of(MIXED, masks=[torch.zeros(size, dtype=torch.bool) for size in MIXED])
    shown = probability_map(Edge(EdgeSEPixelSamplerConfig()), ImageBatch.of(host, use_mask=True), 1)
    np.testing.assert_array_equal(shown, np.zeros(MIXED[1]))
