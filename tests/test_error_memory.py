"""What training found at a pixel is remembered, fades, and decides which pixels are kept."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from batches import LATE, MIXED, NUMBERS, SAME, batch_of, brightness, following, half_masks
from torch import Tensor

from edge_se_sampler.sampling import error_map
from edge_se_sampler.sampling.error_map import FADES, ErrorMap
from edge_se_sampler.sampling.schedule import AdaptiveSchedule

EVERY = [(number, row, column) for number, size in zip(NUMBERS, MIXED, strict=True) for row, column in np.ndindex(size)]


def memory_of(sizes: Any = MIXED) -> ErrorMap:
    memory = ErrorMap()
    memory.add(dict(zip(NUMBERS, sizes, strict=True)))
    return memory


def all_pixels() -> np.ndarray:
    return np.array(EVERY)


# -- the memory


def test_every_pixel_has_its_own_place() -> None:
    memory, pixels = memory_of(), all_pixels()
    rng = np.random.default_rng(0)
    found, order = rng.random(len(pixels)), rng.permutation(len(pixels))
    assert len(memory) == len(pixels)
    memory.note(pixels[order], found[order], 4)
    np.testing.assert_allclose(memory.recall(pixels, 4, 0), found, atol=1e-6)


def test_the_last_error_counts_for_half_and_one_step_for_once() -> None:
    memory, pixel = memory_of(), np.array([[3, 2, 1]])
    memory.note(np.repeat(pixel, 3, axis=0), np.array([1.0, 2.0, 6.0]), 0)
    assert memory.recall(pixel, 0, 0) == pytest.approx(3)
    memory.note(pixel, np.array([1.0]), 1)
    assert memory.recall(pixel, 1, 0) == pytest.approx(2)


def test_what_is_not_refreshed_fades_to_what_is_usual() -> None:
    memory, pixels = memory_of(), all_pixels()
    memory.note(pixels[:2], np.array([4.0, 2.0]), 10)
    a_pass = len(pixels) / 7  # steps of 7 pixels
    ages = np.array([0, 5, round(FADES * a_pass), 100_000])
    told = [memory.recall(pixels[:1], 10 + age, 7)[0] for age in ages]
    np.testing.assert_allclose(told, 3 + np.exp(-ages / (FADES * a_pass)), rtol=1e-6)
    assert told[-1] == pytest.approx(3)


def test_what_was_never_seen_is_taken_to_be_usual() -> None:
    memory, pixels = memory_of(), all_pixels()
    np.testing.assert_array_equal(memory.recall(pixels, 0, 5), np.zeros(len(pixels)))
    memory.note(pixels[:4], np.array([1.0, 2.0, 3.0, 6.0]), 0)
    np.testing.assert_allclose(memory.recall(pixels[4:], 1, 5), 3.0)
    for step in range(1, 40):  # the mean is kept along, not added up anew
        memory.note(pixels[step : step + 5], np.random.default_rng(step).random(5), step)
    known = memory.seen > 0
    assert memory.recall(pixels[60:61], 40, 5) == pytest.approx(memory.values[known].mean(dtype=float), rel=1e-6)


def test_many_pixels_share_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(error_map, "MAX_BLOCKS", 60)
    memory = memory_of()
    assert memory.side == 3
    assert len(memory) == 3 * 5 + 7 * 2 + 2 * 2
    memory.note(np.array([[7, 4, 4]]), np.array([2.0]), 0)
    memory.note(np.array([[7, 0, 0]]), np.array([1.0]), 0)
    block = np.array([[7, row, column] for row in (3, 4, 5) for column in (3, 4, 5)])
    np.testing.assert_allclose(memory.recall(block, 0, 0), 2.0)
    np.testing.assert_allclose(memory.recall(np.array([[7, 6, 4], [7, 4, 6]]), 0, 0), 1.5)


def test_images_that_come_later_do_not_disturb_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = ErrorMap()
    memory.add({7: (9, 14)})
    memory.note(np.array([[7, 3, 3]]), np.array([2.0]), 0)
    memory.add({3: (20, 6), 7: (9, 14)})
    assert memory.recall(np.array([[7, 3, 3]]), 0, 0) == pytest.approx(2)
    monkeypatch.setattr(error_map, "MAX_BLOCKS", 60)
    memory.add({11: (5, 5)})  # blocks have to grow
    assert len(memory) < 60
    assert memory.recall(np.array([[7, 3, 3]]), 0, 0) == pytest.approx(0)


def test_a_saved_memory_goes_on_as_it_was() -> None:
    one, other, rng = memory_of(), ErrorMap(), np.random.default_rng(2)
    pixels = all_pixels()
    for step in range(20):
        one.note(pixels[rng.integers(len(pixels), size=9)], rng.random(9), step)
    other.load(one.state())
    for memory in (one, other):
        memory.note(pixels[:3], np.array([0.1, 0.2, 0.3]), 20)
    np.testing.assert_array_equal(one.recall(pixels, 25, 9), other.recall(pixels, 25, 9))


# -- what a sampler makes of it


def trained(sampler: Any, host: dict[str, Any], steps: range) -> list[Tensor]:
    """Steps whose errors are the pixels' brightness; what they were trained on."""
    drawn = []
    for step in steps:
        sampler.set_step(step)
        pixels = sampler.sample(host)
        sampler.observe(brightness(pixels))
        drawn.append(pixels["indices"])
    return drawn


def never(_: Any) -> Tensor:
    raise AssertionError("nobody is to be rendered")


def test_nothing_is_rendered_and_what_was_wrong_is_trained_on() -> None:
    host = batch_of()
    sampler = following(LATE, rays=40, error_source="cached", squared_error=never, images_per_step="all")
    trained(sampler, host, range(LATE, LATE + 60))
    later = torch.cat(trained(sampler, host, range(LATE + 60, LATE + 160)))
    place = {number: k for k, number in enumerate(host["image_idx"].tolist())}
    bright = host["image"].float().mean(-1)[[place[int(n)] for n in later[:, 0]], later[:, 1], later[:, 2]].mean()
    plain = host["image"].float().mean()
    # ranks 1 .. 2N of half kept: their mean is 0.619 of the way up instead of a half, in closed form about
    assert float(bright) > float(plain) * 1.05
    assert len(later) == 4000


def test_remembered_errors_rank_as_true_ones_do() -> None:
    host = batch_of()
    sampler = following(LATE, rays=40, error_source="cached", squared_error=never, images_per_step="all")
    trained(sampler, host, range(LATE, LATE + 80))
    every = {"indices": torch.cat([address.reshape(-1, 3) for address in host["address"]])}
    true = brightness({"image": host["image"].reshape(-1, 3)})
    assert sampler.memory is not None
    told = sampler.memory.recall(every["indices"].numpy(), LATE + 80, 40)
    ranks = np.stack([np.argsort(np.argsort(values)) for values in (told, true.numpy())])
    assert float(np.corrcoef(ranks).min()) > 0.9


def test_the_early_phase_fills_the_memory() -> None:
    sampler = following(0, error_source="cached", squared_error=never)
    trained(sampler, batch_of(), range(5))
    assert sampler.memory is not None
    assert np.count_nonzero(sampler.memory.seen) > 50


@pytest.mark.parametrize("late", ["uniform", "se"])
def test_others_remember_nothing(late: Any) -> None:
    sampler = following(LATE, late=late)
    sampler.sample(batch_of())
    sampler.observe(torch.ones(64))
    assert sampler.memory is None


def test_masked_pixels_are_neither_drawn_nor_remembered() -> None:
    masks = half_masks(SAME)
    sampler = following(LATE, error_source="cached", squared_error=never)
    for drawn in trained(sampler, batch_of(masks=masks), range(LATE, LATE + 30)):
        for number, row, column in drawn.tolist():
            assert masks[NUMBERS.index(number)][row, column]


def test_the_watch_hears_of_uniform_pixels_though_only_the_wrong_ones_are_trained(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Weighted by how likely each was kept, what is trained on tells the mean error of all: U[e]."""
    said: list[float] = []
    monkeypatch.setattr(AdaptiveSchedule, "observe", lambda self, *told: said.append(told[3]))
    host = batch_of(channels=4)
    sampler = following(
        LATE, rays=60, schedule="adaptive", error_source="cached", squared_error=never, images_per_step="all"
    )
    assert sampler.watch is not None
    sampler.watch.phase = "late"
    trained(sampler, host, range(40))
    said.clear()
    trained(sampler, host, range(40, 440))
    true = float(brightness({"image": host["image"].reshape(-1, 4)}).mean())
    deviation = np.std(said) / np.sqrt(len(said))
    assert np.mean(said) == pytest.approx(true, abs=5 * deviation)
    assert deviation < 0.01 * true
