"""The watch over the errors, which ends the early phase when the object is learnt and begins it again when lost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from batches import batch_of, following

from edge_se_sampler.bench.overrides import SAMPLER, override
from edge_se_sampler.bench.paper.trials import PRESETS, synthetic_scene
from edge_se_sampler.bench.schedule.trials import Trial, build_config
from edge_se_sampler.bench.train import train_and_measure
from edge_se_sampler.sampling.background import PlainBackgrounds, summed_up
from edge_se_sampler.sampling.distribution import PixelTable, UniformPixels
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.schedule import LEARNT, LOST, PAYS_AGAIN, PAYS_NO_MORE, WINDOW_STEPS, AdaptiveSchedule


def phases(
    remaining: Any, count: int = 64, noise: float = 0.0, watch: AdaptiveSchedule | None = None, gain: float = 1.0
) -> Any:
    """The phase after each step of a trace of R, the error as a share of an empty scene's; gain is E[e] / U[e]."""
    watch, rng = watch or AdaptiveSchedule(), np.random.default_rng(0)
    told = []
    for share in remaining:
        background = float(rng.uniform(0.2, 0.8)) if noise else 0.5  # images differ
        error = share * background * float(np.exp(noise * rng.normal()))
        watch.observe(count, error, background, error / gain)
        told.append(watch.phase)
    return told


LEARNING = np.concatenate((np.linspace(1, 0.2, 100), np.full(200, 0.2)))


def test_learnt_ends_the_early_phase_once() -> None:
    told = phases(LEARNING)
    first = told.index("late")
    crossed = int(np.argmax(LEARNING < LEARNT))
    assert crossed <= first <= crossed + 2 * WINDOW_STEPS
    assert set(told[first:]) == {"late"}


@pytest.mark.parametrize("remaining", [1.0, 0.9, 0.7])
def test_never_learnt_stays_early(remaining: float) -> None:
    assert set(phases(np.full(2000, remaining), noise=0.3)) == {"early"}


def test_lost_again_begins_it_anew() -> None:
    told = phases(np.concatenate((np.full(100, 0.2), np.full(100, 1.0), np.full(100, 0.2))))
    changes = [i for i in range(1, 300) if told[i] != told[i - 1]]
    assert [told[i] for i in changes] == ["late", "early", "late"]
    assert changes[0] < 40
    assert 100 < changes[1] < 160
    assert 200 < changes[2] < 260


def test_noise_does_not_throw_it_about() -> None:
    """A learnt object seen by one or two pixels a step, each error off by a factor of two: no false alarm."""
    told = phases(np.full(20_000, 0.3), count=2, noise=0.7)
    assert set(told[200:]) == {"late"}


def test_between_the_bounds_a_phase_stays_what_it_was() -> None:
    middle = np.full(500, (LEARNT + LOST) / 2)
    assert set(phases(middle)) == {"early"}
    watch = AdaptiveSchedule()
    phases(np.full(100, 0.2), watch=watch)
    assert set(phases(middle, watch=watch)) == {"late"}


def test_steps_without_the_object_tell_nothing() -> None:
    watch = AdaptiveSchedule()
    for _ in range(1000):
        watch.observe(0, 0.0, 0.0, 0.0)
    assert watch.phase == "early"
    assert watch.remaining == 1


def test_the_rarer_the_object_the_longer_the_window() -> None:
    def steps_to_see(count: int) -> int:
        return phases(np.full(3000, 0.2), count=count).index("late") + 1

    assert steps_to_see(64) == steps_to_see(16) == WINDOW_STEPS  # 1 - (1 - 1/16)^16 > 1 - 1/e
    assert 250 <= steps_to_see(1) <= 260


def test_a_fog_is_not_an_object() -> None:
    """A grey fog is nearer to a dark object than the white behind it, but hides the white as well."""
    error, distance = np.array([0.5] * 10 + [0.7] * 30), np.array([2.0] * 10 + [0.0] * 30)
    said = summed_up(error, distance, np.ones(40), True)
    assert error[:10].mean() < 0.5 * distance[:10].mean()
    watch = AdaptiveSchedule()
    for _ in range(500):
        watch.observe(*said)
    assert watch.phase == "early"


def test_edges_last_while_they_pay() -> None:
    learnt = np.full(300, 0.2)
    assert set(phases(learnt, gain=PAYS_NO_MORE + 0.1)) == {"early"}
    assert phases(learnt, gain=PAYS_NO_MORE - 0.1)[-1] == "late"


def test_edges_begin_again_when_they_pay_again() -> None:
    watch = AdaptiveSchedule()
    assert phases(np.full(100, 0.2), watch=watch)[-1] == "late"
    assert set(phases(np.full(100, 0.2), watch=watch, gain=PAYS_AGAIN - 0.1)) == {"late"}
    assert phases(np.full(100, 0.2), watch=watch, gain=PAYS_AGAIN + 0.1)[-1] == "early"


def test_it_goes_on_from_a_state() -> None:
    trace = np.concatenate((np.linspace(1, 0.2, 40), np.full(60, 1.0), np.full(60, 0.3)))
    whole = phases(trace)
    for cut in range(0, 160, 7):  # in the middle of every phase
        first, second = AdaptiveSchedule(), AdaptiveSchedule()
        begun = phases(trace[:cut], watch=first)
        second.load(first.state())
        assert begun + phases(trace[cut:], watch=second) == whole, cut


# -- what an empty scene would show


def test_distance_from_the_background_with_alpha() -> None:
    image = np.array([[1.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.5], [0.3, 0.4, 0.5, 0.0]], dtype=np.float32)
    numbers = np.zeros(3, dtype=np.int64)
    found = PlainBackgrounds().squared_distance(image, numbers, (1.0, 1.0, 1.0))
    np.testing.assert_allclose(found, [2.0, 0.5, 0.0])
    found = PlainBackgrounds().squared_distance(image, numbers, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(found, [1.0, 0.25, 0.0])


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_without_alpha_the_border_tells_the_background(dtype: torch.dtype) -> None:
    batch = batch_of(dtype=dtype)
    full = 255 if dtype == torch.uint8 else 1
    colors = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    for image, color in zip(batch["image"], colors, strict=True):
        image[:] = (color * full).to(dtype)
        image[2:5, 2:5] = 0  # the object
    backgrounds = PlainBackgrounds()
    backgrounds.look_at(ImageBatch.of(batch, use_mask=False))
    backgrounds.look_at(ImageBatch.of(batch, use_mask=False))
    for row, expected in ((0, 0.0), (3, 1.0)):
        pixels = torch.stack([image[row, 3] for image in batch["image"]]).numpy()
        distance = backgrounds.squared_distance(pixels, batch["image_idx"].numpy(), (1.0, 1.0, 1.0))
        np.testing.assert_allclose(distance, (expected * colors.square().sum(dim=1)).numpy(), atol=1e-6)


def test_a_step_summed_up() -> None:
    error, distance = np.array([0.5, 9.0, 0.1, 0.4]), np.array([1.0, 0.0, 0.5, 0.009])
    relative = np.array([4.0, 0.5, 2.0, 1.0])
    assert summed_up(error, distance, relative, False) == (
        2,
        pytest.approx((2 + 4.5 + 0.2 + 0.4) / 4),
        pytest.approx((4 + 0 + 1 + 0.009) / 4),
        pytest.approx(2.5),
    )
    assert summed_up(error, distance, relative, True) == (
        2,
        pytest.approx(2.5),
        pytest.approx(1.509 / 4),
        pytest.approx((0.125 + 18 + 0.05 + 0.4) / 4),
    )


def test_both_ways_of_drawing_tell_the_same() -> None:
    """E[e], E[b] and U[e] from a hundred thousand pixels drawn either way, and exactly from all of them."""
    rng = np.random.default_rng(0)
    strength = torch.from_numpy(rng.random((40, 30)) ** 3 + 0.01)
    error, distance = rng.random((40, 30)), rng.random((40, 30))
    p = (strength / strength.sum()).numpy()
    truth = [float((p * error).sum()), float((p * distance).sum()), float(error.mean())]
    table = PixelTable()
    table.add([strength])
    for source, by_edge in ((table, True), (UniformPixels([(40, 30)]), False)):
        drawn = source.draw(torch.tensor([0]), 100_000, np.random.default_rng(1))
        at = (drawn[:, 1].numpy(), drawn[:, 2].numpy())
        relative = table.relative(torch.tensor([0]), drawn).numpy()
        _, *said = summed_up(error[at], distance[at], relative, by_edge)
        assert said == pytest.approx(truth, rel=0.02), by_edge


# -- the sampler under it


def auto(**settings: Any) -> Any:
    return following(schedule="adaptive", rays=64, **settings)


def away(image: torch.Tensor) -> torch.Tensor:
    """An empty scene's errors."""
    image = image.float() / 255
    return (image[:, 3:] * (image[:, :3] - 1)).square().sum(dim=1)


def trained(sampler: Any, share: float, steps: int = 40) -> list[str]:
    """Strategies of steps whose errors are this share of an empty scene's."""
    told = []
    host = batch_of(channels=4)
    for step in range(steps):
        sampler.set_step(step)
        told.append(sampler.strategy)
        batch = sampler.sample(host)
        sampler._squared_error = lambda c: share * away(c["image"])
        sampler.observe(share * away(batch["image"]))
    return told


def test_the_sampler_follows_the_watch() -> None:
    sampler = auto()
    assert set(trained(sampler, 1.0)) == {"edge"}
    told = trained(sampler, 0.2)
    assert told[0] == "edge"
    assert told[-1] == "se"
    assert trained(sampler, 1.0)[-1] == "edge"  # lost: its tables are still there, or made again


def test_in_the_late_phase_the_candidates_tell() -> None:
    """They are uniform, and twice as many; what was chosen of them is not asked."""
    sampler = auto()
    trained(sampler, 0.2)
    assert sampler.strategy == "se"
    seen, before = [], sampler.watch.observations
    observe = sampler.watch.observe
    sampler.watch.observe = lambda *said: (seen.append(said), observe(*said))
    batch = sampler.sample(batch_of(channels=4))
    assert len(batch["indices"]) == 64
    assert sampler.watch.observations == before + 1
    assert seen[0][0] > 64  # of 128 random pixels nearly all are visible
    sampler.observe(torch.zeros(64))  # nobody waits for it
    assert sampler.watch.observations == before + 1


def test_a_late_uniform_phase_is_watched_as_it_trains() -> None:
    sampler = auto(late="uniform")
    told = trained(sampler, 0.2, steps=60)
    assert told[-1] == "uniform"
    assert sampler.watch.observations == 60
    assert trained(sampler, 1.0, steps=60)[-1] == "edge"


def test_other_schedules_watch_nothing() -> None:
    sampler = following(step=500)
    sampler.sample(batch_of(channels=4))
    sampler.observe(torch.ones(64))
    assert sampler.watch is None
    assert sampler.pending_batch is None
    assert sampler.strategy == "se"


# -- negative controls: schedules that do not watch


class Stuck(AdaptiveSchedule):
    """Never leaves its early phase."""

    def observe(self, count: float, edge_error: float, edge_background: float, uniform_error: float) -> None:
        super().observe(count, edge_error, edge_background, uniform_error)
        self.phase = "early"


class Hasty(AdaptiveSchedule):
    """Leaves at once."""

    def observe(self, count: float, edge_error: float, edge_background: float, uniform_error: float) -> None:
        super().observe(count, edge_error, edge_background, uniform_error)
        self.phase = "late"


def watches(kind: type[AdaptiveSchedule]) -> bool:
    """Whether it leaves when the object is learnt, stays while it is not, and comes back when it is lost."""
    learnt, never, lost = kind(), kind(), kind()
    return (
        phases(LEARNING, watch=learnt)[-1] == "late"
        and set(phases(np.full(300, 0.95), watch=never)) == {"early"}
        and phases(np.concatenate((np.full(100, 0.2), np.full(100, 1.0))), watch=lost)[-1] == "early"
    )


def test_schedules_that_do_not_watch_are_caught() -> None:
    assert watches(AdaptiveSchedule)
    assert not watches(Stuck)
    assert not watches(Hasty)


@pytest.mark.slow
def test_staying_and_leaving_at_once_cost_what_auto_saves(tmp_path: Path) -> None:
    """300 steps. Off centre a run without an early phase dies; centred, one without a late phase leaves a fog."""

    def trained(table: int, scene: str, **settings: Any) -> dict[str, Any]:
        data = synthetic_scene(table, scene, PRESETS["cpu"], tmp_path)
        config = build_config(Trial("lengths", table, scene, 300, "adaptive", 100), data, tmp_path / "runs")
        return train_and_measure(override(config, {f"{SAMPLER}.{name}": value for name, value in settings.items()}))

    at_once = {"schedule": "fraction", "early_fraction": 0.0}
    for_ever = {"schedule": "fraction", "early_fraction": 1.0}
    assert trained(2, "mic", **at_once)["outcome"] == "collapsed"
    assert trained(2, "mic")["outcome"] == "converged"
    assert trained(1, "drums")["psnr"] > trained(1, "drums", **for_ever)["psnr"] + 0.3
