"""When a sampler changes from its early strategy to its late one, and what each draws."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from batches import batch_of, brightness, following

from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import STRATEGIES
from edge_se_sampler.sampling.parts import Distribution, PixelBatch, Selector, TrainingStep
from edge_se_sampler.sampling.registry import BOTH, PIXEL_STRATEGIES, PixelStrategy, strategy_names
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


class ByColumn(Distribution):
    """A custom distribution: the further to the right, the likelier."""

    name = "by-column"

    def strength(self, image: np.ndarray, background_color: Any) -> np.ndarray:
        return np.broadcast_to(np.arange(image.shape[1], dtype=np.float32), image.shape[:2]).copy()


class Brightest(Selector):
    """A custom selector: the candidates with the largest squared errors."""

    candidates_per_pixel = 3

    def select(self, candidates: PixelBatch, count: int, step: TrainingStep) -> PixelBatch:
        assert step.squared_error is not None
        rows = step.squared_error(candidates).topk(count).indices
        return candidates.take(rows, torch.ones(count))


@pytest.mark.parametrize(("step", "settings"), [(0, {"early": "by-column"}), (500, {"late": "by-column"})])
def test_a_custom_distribution(step: int, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PIXEL_STRATEGIES, "by-column", PixelStrategy(ByColumn, BOTH, ""))
    sampler = following(step, rays=20_000, **settings)
    assert sampler.strategy == "by-column"
    columns = sampler.sample(batch_of())["indices"][:, 2]
    assert columns.min() == 1
    assert columns.double().mean() == pytest.approx(9, abs=0.15)  # sum j^2 / sum j of 0 .. 13


def test_a_custom_selector(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PIXEL_STRATEGIES, "brightest", PixelStrategy(f"{__name__}:Brightest", ("late",), ""))
    scores = []

    def score(candidates: dict[str, Any]) -> torch.Tensor:
        scores.append(brightness(candidates))
        return scores[-1]

    trained = following(500, late="brightest", rays=50, squared_error=score).sample(batch_of())
    torch.testing.assert_close(brightness(trained), scores[0].sort(descending=True).values[:50])


@pytest.mark.parametrize(("phase", "name"), [("early", "egde"), ("early", "se"), ("late", "edge")])
def test_an_unknown_strategy_or_one_of_the_other_phase_is_refused_in_a_line(phase: Any, name: str) -> None:
    known = (*strategy_names(phase), *(["auto"] if phase == "early" else []))
    with pytest.raises(InputError) as refusal:
        EdgeSEPixelSamplerConfig(**{phase: name}).setup()  # pyright: ignore[reportArgumentType]
    assert str(refusal.value) == f"--pixel-sampler.{phase}: {name!r} is none of {', '.join(known)}"


class NoPart:
    """What another package may take for a strategy."""

    def __init__(self, settings: Any) -> None: ...


def test_what_is_no_strategy_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PIXEL_STRATEGIES, "typo", PixelStrategy("edge_se_sampler:EdgePixels", BOTH, ""))
    with pytest.raises(InputError, match=r"edge_se_sampler:EdgePixels cannot be imported: .* no attribute"):
        following(late="typo")
    monkeypatch.setitem(PIXEL_STRATEGIES, "number", PixelStrategy(NoPart, BOTH, ""))
    with pytest.raises(InputError, match="'number': NoPart is no Distribution and no Selector"):
        following(late="number")


def test_what_a_strategy_refuses_and_settings_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    refusals = (("images_per_step", ("all",), "compares images"),)
    strategy = PixelStrategy(ByColumn, BOTH, "", ("edge_epsilon",), refusals)
    monkeypatch.setitem(PIXEL_STRATEGIES, "by-column", strategy)
    following(early="by-column", images_per_step="all", edge_epsilon=0.02)
    following(images_per_step="one")
    refused: list[tuple[dict[str, Any], str]] = [
        ({"late": "by-column"}, "images-per-step is 'one': compares images"),
        ({"edge_epsilon": 0.02}, "edge-epsilon is 0.02: has no effect without early or late by-column"),
    ]
    for settings, problem in refused:
        with pytest.raises(InputError, match=problem):
            following(**settings)
