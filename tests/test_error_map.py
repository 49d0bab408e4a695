"""The map of squared errors: what it returns, how its entries decay, and how it decides which candidates are kept."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from batches import LATE, MIXED, NUMBERS, SAME, batch_of, brightness, following, half_masks
from torch import Tensor

from edge_se_sampler.sampling import error_map
from edge_se_sampler.sampling.error_map import DECAY_PASSES, ErrorMap
from edge_se_sampler.sampling.schedule import AdaptiveSchedule
from edge_se_sampler.sampling.strategies import RankedError

ALL_PIXELS = np.array(
    [(number, row, column) for number, size in zip(NUMBERS, MIXED, strict=True) for row, column in np.ndindex(size)]
)


def empty_map() -> ErrorMap:
    errors = ErrorMap()
    errors.add(dict(zip(NUMBERS, MIXED, strict=True)))
    return errors


def test_every_pixel_has_an_entry_of_its_own() -> None:
    errors, rng = empty_map(), np.random.default_rng(0)
    found, order = rng.random(len(ALL_PIXELS)), rng.permutation(len(ALL_PIXELS))
    assert len(errors) == len(ALL_PIXELS)
    errors.update(ALL_PIXELS[order], found[order], 4)
    np.testing.assert_allclose(errors.lookup(ALL_PIXELS, 4, 0), found, atol=1e-6)


def test_the_last_step_counts_for_half_however_often_it_drew_the_pixel() -> None:
    errors, pixel = empty_map(), np.array([[3, 2, 1]])
    errors.update(np.repeat(pixel, 3, axis=0), np.array([1.0, 2.0, 6.0]), 0)
    assert errors.lookup(pixel, 0, 0) == pytest.approx(3)
    errors.update(pixel, np.array([1.0]), 1)
    assert errors.lookup(pixel, 1, 0) == pytest.approx(2)


def test_entries_that_are_not_updated_decay_to_the_mean() -> None:
    errors = empty_map()
    errors.update(ALL_PIXELS[:2], np.array([4.0, 2.0]), 10)
    steps_per_pass = len(ALL_PIXELS) / 7  # 7 pixels a step
    ages = np.array([0, 5, round(DECAY_PASSES * steps_per_pass), 100_000])
    found = [errors.lookup(ALL_PIXELS[:1], 10 + age, 7)[0] for age in ages]
    np.testing.assert_allclose(found, 3 + np.exp(-ages / (DECAY_PASSES * steps_per_pass)), rtol=1e-6)
    assert found[-1] == pytest.approx(3)


def test_pixels_without_an_entry_have_the_mean() -> None:
    errors = empty_map()
    np.testing.assert_array_equal(errors.lookup(ALL_PIXELS, 0, 5), np.zeros(len(ALL_PIXELS)))
    errors.update(ALL_PIXELS[:4], np.array([1.0, 2.0, 3.0, 6.0]), 0)
    np.testing.assert_allclose(errors.lookup(ALL_PIXELS[4:], 1, 5), 3.0)
    for step in range(1, 40):  # the mean is updated incrementally
        errors.update(ALL_PIXELS[step : step + 5], np.random.default_rng(step).random(5), step)
    known = errors.updated > 0
    assert errors.lookup(ALL_PIXELS[60:61], 40, 5) == pytest.approx(errors.values[known].mean(dtype=float), rel=1e-6)


def test_pixels_share_blocks_where_there_are_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(error_map, "MAX_BLOCKS", 60)
    errors = empty_map()
    assert errors.side == 3
    assert len(errors) == 3 * 5 + 7 * 2 + 2 * 2
    errors.update(np.array([[7, 4, 4]]), np.array([2.0]), 0)
    errors.update(np.array([[7, 0, 0]]), np.array([1.0]), 0)
    block = np.array([[7, row, column] for row in (3, 4, 5) for column in (3, 4, 5)])
    np.testing.assert_allclose(errors.lookup(block, 0, 0), 2.0)
    np.testing.assert_allclose(errors.lookup(np.array([[7, 6, 4], [7, 4, 6]]), 0, 0), 1.5)


def test_added_images_leave_the_entries_of_others_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = ErrorMap()
    errors.add({7: (9, 14)})
    errors.update(np.array([[7, 3, 3]]), np.array([2.0]), 0)
    errors.add({3: (20, 6), 7: (9, 14)})
    assert errors.lookup(np.array([[7, 3, 3]]), 0, 0) == pytest.approx(2)
    monkeypatch.setattr(error_map, "MAX_BLOCKS", 60)
    errors.add({11: (5, 5)})  # blocks have to grow
    assert len(errors) < 60
    assert errors.lookup(np.array([[7, 3, 3]]), 0, 0) == pytest.approx(0)


def test_a_loaded_map_continues_as_the_saved_one() -> None:
    saved, loaded, rng = empty_map(), ErrorMap(), np.random.default_rng(2)
    for step in range(20):
        saved.update(ALL_PIXELS[rng.integers(len(ALL_PIXELS), size=9)], rng.random(9), step)
    loaded.load_state_dict(saved.state_dict())
    for errors in (saved, loaded):
        errors.update(ALL_PIXELS[:3], np.array([0.1, 0.2, 0.3]), 20)
    np.testing.assert_array_equal(saved.lookup(ALL_PIXELS, 25, 9), loaded.lookup(ALL_PIXELS, 25, 9))


# ---- a sampler with one


def train(sampler: Any, host: dict[str, Any], steps: range) -> list[Tensor]:
    """Train steps whose squared errors are the pixels' brightness; their indices."""
    drawn = []
    for step in steps:
        sampler.set_step(step)
        pixels = sampler.sample(host)
        sampler.observe(brightness(pixels))
        drawn.append(pixels["indices"])
    return drawn


def refuse_to_score(_: Any) -> Tensor:
    raise AssertionError("no candidate is to be rendered")


def map_of(sampler: Any) -> ErrorMap:
    return sampler.strategies["se"].selector.error_map


def test_pixels_with_large_errors_are_preferred_and_nothing_is_rendered() -> None:
    host = batch_of()
    sampler = following(LATE, rays=40, error_source="cached", squared_error=refuse_to_score, images_per_step="all")
    train(sampler, host, range(LATE, LATE + 60))
    later = torch.cat(train(sampler, host, range(LATE + 60, LATE + 160)))
    position = {number: k for k, number in enumerate(host["image_idx"].tolist())}
    trained = host["image"].float().mean(-1)[[position[int(n)] for n in later[:, 0]], later[:, 1], later[:, 2]].mean()
    # ranks 1 .. 2N of which half are kept: their mean is 0.619 of the way up, in closed form, instead of a half
    assert float(trained) > float(host["image"].float().mean()) * 1.05
    assert len(later) == 4000


def test_cached_errors_rank_pixels_as_the_true_ones_do() -> None:
    host = batch_of()
    sampler = following(LATE, rays=40, error_source="cached", squared_error=refuse_to_score, images_per_step="all")
    train(sampler, host, range(LATE, LATE + 80))
    indices = torch.cat([address.reshape(-1, 3) for address in host["address"]])
    true = brightness({"image": host["image"].reshape(-1, 3)})
    cached = map_of(sampler).lookup(indices.numpy(), LATE + 80, 40)
    ranks = np.stack([np.argsort(np.argsort(values)) for values in (cached, true.numpy())])
    assert float(np.corrcoef(ranks).min()) > 0.9


def test_the_early_phase_fills_the_map() -> None:
    sampler = following(0, error_source="cached", squared_error=refuse_to_score)
    train(sampler, batch_of(), range(5))
    assert np.count_nonzero(map_of(sampler).updated) > 50


@pytest.mark.parametrize("late", ["uniform", "se"])
def test_other_error_sources_need_no_map(late: Any) -> None:
    sampler = following(LATE, late=late)
    assert not sampler.needs_errors
    selector = sampler.strategies[late].selector
    assert not isinstance(selector, RankedError) or selector.error_map is None


def test_masked_pixels_are_never_drawn() -> None:
    masks = half_masks(SAME)
    sampler = following(LATE, error_source="cached", squared_error=refuse_to_score)
    for drawn in train(sampler, batch_of(masks=masks), range(LATE, LATE + 30)):
        for number, row, column in drawn.tolist():
            assert masks[NUMBERS.index(number)][row, column]


def test_the_adaptive_schedule_gets_the_mean_over_all_pixels_though_large_errors_are_preferred(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Weighted by how likely each pixel was kept, those that are trained on give the mean error of all, U[e]."""
    uniform_errors: list[float] = []
    monkeypatch.setattr(AdaptiveSchedule, "observe", lambda self, *means: uniform_errors.append(means[3]))
    host = batch_of(channels=4)
    sampler = following(
        LATE, rays=60, schedule="adaptive", error_source="cached", squared_error=refuse_to_score, images_per_step="all"
    )
    assert isinstance(sampler.schedule, AdaptiveSchedule)
    sampler.schedule.current = "late"
    train(sampler, host, range(40))
    uniform_errors.clear()
    train(sampler, host, range(40, 440))
    true = float(brightness({"image": host["image"].reshape(-1, 4)}).mean())
    deviation = np.std(uniform_errors) / np.sqrt(len(uniform_errors))
    assert np.mean(uniform_errors) == pytest.approx(true, abs=5 * deviation)
    assert deviation < 0.01 * true
