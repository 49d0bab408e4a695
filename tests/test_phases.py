"""When a sampler changes from its early strategy to its late one, and what each draws."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from batches import NUMBERS, SAME, batch_of, brightness, following

from edge_se_sampler.methods import STRATEGIES
from edge_se_sampler.sampling.pixel_sampler import EdgeSEPixelSampler
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig


def in_box(indices: torch.Tensor) -> bool:
    """Whether all lie in the precrop box of a 9 x 14 image."""
    rows, columns = indices[:, 1], indices[:, 2]
    return bool(((rows >= 3) & (rows <= 6) & (columns >= 4) & (columns <= 10)).all())


@pytest.mark.parametrize(
    ("settings", "planned", "last_early"),
    [
        ({}, 1000, 99),
        ({}, 200_000, 19_999),
        ({}, 5, 0),
        ({"early_fraction": 0.5}, 7, 3),
        ({"early_fraction": 0.25}, 1000, 249),
        ({"schedule": "steps", "early_steps": 17}, 1000, 16),
        ({"schedule": "steps", "early_steps": 17, "early_fraction": 0.9}, 20, 16),
    ],
)
@pytest.mark.parametrize("method", STRATEGIES)
def test_the_phase_changes_exactly_once_and_there(method: str, settings: dict, planned: int, last_early: int) -> None:
    early, late, _ = STRATEGIES[method]
    sampler = following(planned=planned, early=early, late=late, **settings)
    for step, expected in [
        (0, early),
        (last_early, early),
        (last_early + 1, late),
        (planned - 1, late),
        (3 * planned, late),
    ]:
        sampler.set_step(step)
        assert sampler.strategy == expected


def test_a_fraction_of_zero_has_no_early_phase_and_of_one_no_late() -> None:
    assert following(0, early="edge", late="uniform", early_fraction=0).strategy == "uniform"
    assert following(999, early="edge", late="uniform", early_fraction=1).strategy == "edge"


def test_the_drawn_pixels_change_with_the_phase() -> None:
    sampler, host = following(early="precrop", late="uniform", rays=500), batch_of()
    sampler.set_step(99)
    assert in_box(sampler.sample(host)["indices"])
    sampler.set_step(100)
    assert not in_box(sampler.sample(host)["indices"])
    sampler.set_step(99)  # steps may go back, as a resumed run's do
    assert in_box(sampler.sample(host)["indices"])


@pytest.mark.parametrize("late", ["uniform", "se"])
def test_early_edges_come_back_the_same_after_the_late_phase(late: str) -> None:
    sampler, host = following(0, late=late), batch_of()
    before = sampler.sample(host)["indices"]
    sampler.set_step(500)
    sampler.sample(host)
    sampler.set_step(0)
    assert torch.equal(sampler.sample(host)["indices"], before)


def test_late_uniform_is_uniform_of_the_same_seed() -> None:
    late = [following(500, early=early, late="uniform").sample(batch_of()) for early in ("edge", "precrop", "uniform")]
    assert all(torch.equal(late[0]["indices"], other["indices"]) for other in late[1:])


class ByColumn(EdgeSEPixelSampler):
    """A seventh way of choosing pixels: the further to the right, the likelier."""

    def strength(self, strategy: str, image: Any) -> Any:
        if strategy != "right":
            return super().strength(strategy, image)
        return torch.arange(image.shape[1]).float().expand(image.shape[:2]).numpy()


@pytest.mark.parametrize(("step", "settings"), [(0, {"early": "right"}), (500, {"late": "right"})])
def test_a_seventh_way_joins_by_overriding_strength(step: int, settings: dict[str, Any]) -> None:
    sampler = ByColumn(EdgeSEPixelSamplerConfig(**settings), num_rays_per_batch=20_000)
    sampler.bind(squared_error=brightness, planned_steps=1000, seed=0)
    sampler.set_step(step)
    columns = sampler.sample(batch_of(SAME, NUMBERS))["indices"][:, 2]
    assert columns.min() == 1
    assert columns.double().mean() == pytest.approx(9, abs=0.15)  # sum j^2 / sum j of 0 .. 13
