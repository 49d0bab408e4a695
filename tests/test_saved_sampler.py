"""What samplers learned, changed at random: it is refused, or drawn from and learned on as any other."""

from __future__ import annotations

import copy
import random
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
import torch
from batches import MIXED, NUMBERS, batch_of, brightness, following, half_masks
from changes import change_value
from strangers import memory_bound

from edge_se_sampler.engine.saved_state import check_tensors
from edge_se_sampler.errors import InputError
from edge_se_sampler.sampling import actray, instant_ngp
from edge_se_sampler.sampling.pixel_sampler import EdgeSEPixelSampler
from edge_se_sampler.sampling.registry import PIXEL_STRATEGIES, PixelStrategy
from edge_se_sampler.sampling.saved_sampler import is_sampler_state
from edge_se_sampler.sampling.settings import SamplingSettings
from edge_se_sampler.sampling.strategies import Uniform

IMAGES = dict(zip(NUMBERS, MIXED, strict=True))
SETTINGS: dict[str, dict[str, Any]] = {
    **{
        name: {"late": name, "early": "uniform"}
        for name, strategy in PIXEL_STRATEGIES.items()
        if "late" in strategy.phases
    },
    "cached": {"late": "se", "error_source": "cached"},
    "adaptive": {"schedule": "adaptive"},
}


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rebuild after a few steps what is rebuilt after many."""
    monkeypatch.setattr(instant_ngp, "FIRST_INTERVAL", 3)
    monkeypatch.setattr(actray, "REFRESH_STEPS", 2)


def sampler_of(kind: str) -> EdgeSEPixelSampler:
    settings = {"early_fraction": 0.0} if kind != "adaptive" else {}
    return following(500, **settings, **SETTINGS[kind])


def learn(sampler: EdgeSEPixelSampler, steps: int) -> None:
    batch = batch_of(MIXED, channels=4, masks=half_masks(MIXED))
    for step in range(steps):
        pixels = sampler.sample(batch)
        sampler.observe(brightness(pixels))
        sampler.set_step(501 + step)


@pytest.mark.parametrize("steps", [0, 1, 8])
@pytest.mark.parametrize("kind", SETTINGS)
def test_what_was_learned_is_that(kind: str, steps: int) -> None:
    sampler, other = sampler_of(kind), sampler_of(kind)
    learn(sampler, steps)
    assert is_sampler_state(sampler.state_dict(), other, IMAGES)
    other.load_state_dict(sampler.state_dict())
    assert is_sampler_state(sampler.state_dict(), other, IMAGES)  # a viewer's has loaded another before


@pytest.mark.parametrize(
    ("early", "late"),
    [("error-map", "actray"), ("regions", "quadtree"), ("quadtree", "soft-mining"), ("error-cdf", "cached")],
)
def test_an_early_phase_that_learned_and_is_over_is_not_missed(early: str, late: str) -> None:
    settings = {**SETTINGS[late], "early": early, "schedule": "steps", "early_steps": 502}
    sampler, other = (following(step, **settings) for step in (500, 504))
    learn(sampler, 1)
    assert f"{early}.distribution" in sampler.state_dict()
    learn(sampler, 4)
    state = copy.deepcopy(sampler.state_dict())
    assert f"{early}.distribution" not in state
    assert is_sampler_state(state, other, IMAGES)
    other.load_state_dict(state)
    batch = batch_of(MIXED, channels=4, masks=half_masks(MIXED))
    for each in (sampler, other):
        each.set_step(505)
    assert torch.equal(sampler.sample(batch)["indices"], other.sample(batch)["indices"])
    state = {name: part for name, part in state.items() if not name.startswith(late.replace("cached", "se"))}
    with suppress(LookupError):  # which the caller takes for a refusal
        assert not is_sampler_state(state, other, IMAGES)


@pytest.mark.slow
@pytest.mark.parametrize("kind", SETTINGS)
def test_any_change_is_drawn_from_or_refused(kind: str) -> None:
    sampler = sampler_of(kind)
    learn(sampler, 7)
    for seed in range(100):
        changed, state, other = random.Random(seed), copy.deepcopy(sampler.state_dict()), sampler_of(kind)
        change_value(state, changed)
        with memory_bound(2**30):
            try:
                check_tensors(state)
                valid = is_sampler_state(state, other, IMAGES)
            except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError):
                continue  # which the caller refuses
            if valid:
                other.load_state_dict(state)
                learn(other, 4)


class Counting(Uniform):
    """Another package's, whose state grows."""

    def __init__(self, settings: SamplingSettings) -> None:
        super().__init__(settings)
        self.seen: dict[Any, Any] = {}

    def state_dict(self) -> dict[str, Any]:
        return dict(self.seen)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.seen = dict(state)


def test_states_that_no_checkpoint_may_hold_are_refused_before_training(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PIXEL_STRATEGIES, "counting", PixelStrategy(Counting, ("late",), ""))
    sampler, batch = following(late="counting", early="uniform"), batch_of()
    counting = sampler.strategies["counting"].distribution
    assert isinstance(counting, Counting)
    for fine in (7, "many", None, torch.zeros(3), [1.5, (True, {"in": torch.zeros(())})]):
        counting.seen["state"] = fine
        sampler.check_images(batch)
    for value in (np.zeros(3), np.float64(1), Uniform, [np.zeros(3)], {3: {b"bytes": 1}}):
        counting.seen["state"] = value
        with pytest.raises(InputError, match=r"counting\.distribution"):
            sampler.check_images(batch)


def test_other_packages_judge_their_own_states(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PIXEL_STRATEGIES, "counting", PixelStrategy(Counting, ("late",), ""))
    sampler = following(500, late="counting", early="uniform", early_fraction=0.0)
    for valid, state in (
        (True, {}),
        (True, {"counting.distribution": {7: 3, 11: "many"}}),
        (False, {"counts.distribution": {}}),
        (False, {"uniform.distribution": {7: 3}}),
    ):
        assert is_sampler_state(state, sampler, IMAGES) == valid
