"""Distributed runs: ranks slice one draw; and no draw depends on the order in which a host collates its images."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from batches import LATE, MIXED, NUMBERS, SAME, batch_of, brightness, following, half_masks
from torch import Tensor

WORLD, RAYS = 3, 40


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("images_per_step", ["one", "all"])
@pytest.mark.parametrize("early", ["uniform", "precrop", "edge"])
def test_the_union_over_ranks_is_one_draw(early: str, images_per_step: str, masked: bool) -> None:
    batch = batch_of(SAME, masks=half_masks(SAME) if masked else None)
    settings = {"early": early, "images_per_step": images_per_step, "precrop_fraction": 0.7}
    whole = following(2, rays=WORLD * RAYS, **settings).sample(batch)["indices"]
    parts = [following(2, rays=RAYS, rank=k, world=WORLD, **settings).sample(batch)["indices"] for k in range(WORLD)]
    assert torch.equal(torch.stack(parts, dim=1).reshape(-1, 3), whole)
    assert not torch.equal(parts[0], parts[1])


def test_candidates_are_one_draw_and_each_rank_chooses_among_its_own() -> None:
    batch = batch_of()
    scored: list[Tensor] = []

    def score(candidates: dict[str, Any]) -> Tensor:
        scored.append(candidates["indices"])
        return brightness(candidates)

    following(LATE, rays=WORLD * RAYS, squared_error=score).sample(batch)
    for rank in range(WORLD):
        sampler = following(LATE, rays=RAYS, squared_error=score, rank=rank, world=WORLD)
        kept = sampler.sample(batch)["indices"]
        assert len(kept) == RAYS
        assert set(map(tuple, kept.tolist())) <= set(map(tuple, scored[-1].tolist()))
    whole, *parts = scored
    assert torch.equal(torch.stack(parts, dim=1).reshape(-1, 3), whole)


def test_ranks_choose_with_random_numbers_of_their_own() -> None:
    batch = batch_of([(1, 1)], [0])  # one pixel: every rank has the same candidates
    weights = []  # the weight of a row says which rank its error had
    for rank in range(2):
        sampler = following(
            LATE, squared_error=lambda c: torch.arange(len(c["indices"])), rank=rank, world=2, importance_weight=1.0
        )
        weights.append(sampler.sample(batch)["weight"])
    assert not torch.equal(*weights)


@pytest.mark.parametrize("sizes", [SAME, MIXED])
@pytest.mark.parametrize("step", [0, LATE])
@pytest.mark.parametrize("images_per_step", ["one", "all"])
def test_the_order_of_the_images_does_not_matter(images_per_step: str, step: int, sizes: list) -> None:
    order = [2, 0, 1]
    batch = batch_of(sizes, NUMBERS)
    permuted = batch_of([sizes[i] for i in order], [NUMBERS[i] for i in order])
    drawn = [following(step, images_per_step=images_per_step).sample(b) for b in (batch, permuted)]
    for key in ("indices", "image", "address"):
        assert torch.equal(drawn[0][key], drawn[1][key]), key
