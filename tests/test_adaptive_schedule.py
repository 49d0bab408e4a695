"""The adaptive schedule: the early phase ends when the object is learnt, and returns when it is lost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from batches import batch_of, following

from edge_se_sampler.bench.paper.trials import Settings, synthetic_scene
from edge_se_sampler.bench.schedule.trials import Trial, build_config
from edge_se_sampler.bench.train import train_and_measure
from edge_se_sampler.engine.config import SAMPLER, override
from edge_se_sampler.sampling.background import PlainBackgrounds, summarize_errors
from edge_se_sampler.sampling.distribution import PixelTable, UniformPixels
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.schedule import (
    GAIN_TO_END,
    GAIN_TO_RETURN,
    REMAINING_TO_END,
    REMAINING_TO_RETURN,
    WINDOW_STEPS,
    AdaptiveSchedule,
)
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig
from edge_se_sampler.sampling.strategies import Edge

LEARNING = np.concatenate((np.linspace(1, 0.2, 100), np.full(200, 0.2)))
"""R of a training that goes well."""


def new_schedule(kind: type[AdaptiveSchedule] = AdaptiveSchedule) -> AdaptiveSchedule:
    return kind(Edge(EdgeSEPixelSamplerConfig()))


def phases(
    remaining: Any, count: int = 64, noise: float = 0.0, schedule: AdaptiveSchedule | None = None, gain: float = 1.0
) -> list[str]:
    """The phase after each step of a trace of R, the error as a share of an empty scene's; gain is E[e] / U[e]."""
    schedule, rng = schedule or new_schedule(), np.random.default_rng(0)
    found = []
    for step, share in enumerate(remaining):
        background = float(rng.uniform(0.2, 0.8)) if noise else 0.5  # images differ
        error = share * background * float(np.exp(noise * rng.normal()))
        schedule.observe(count, error, background, error / gain)
        found.append(schedule.phase(step))
    return found


def test_the_early_phase_ends_once_when_the_object_is_learnt() -> None:
    found = phases(LEARNING)
    first = found.index("late")
    crossed = int(np.argmax(LEARNING < REMAINING_TO_END))
    assert crossed <= first <= crossed + 2 * WINDOW_STEPS
    assert set(found[first:]) == {"late"}


@pytest.mark.parametrize("remaining", [1.0, 0.9, 0.7])
def test_it_does_not_end_while_the_object_is_not_learnt(remaining: float) -> None:
    assert set(phases(np.full(2000, remaining), noise=0.3)) == {"early"}


def test_it_returns_when_the_object_is_lost() -> None:
    found = phases(np.concatenate((np.full(100, 0.2), np.full(100, 1.0), np.full(100, 0.2))))
    changes = [i for i in range(1, 300) if found[i] != found[i - 1]]
    assert [found[i] for i in changes] == ["late", "early", "late"]
    assert changes[0] < 40
    assert 100 < changes[1] < 160
    assert 200 < changes[2] < 260


def test_noise_does_not_change_the_phase() -> None:
    """A learnt object seen by one or two pixels a step, each error off by a factor of two: no false alarm."""
    assert set(phases(np.full(20_000, 0.3), count=2, noise=0.7)[200:]) == {"late"}


def test_between_the_thresholds_the_phase_stays_what_it_was() -> None:
    middle = np.full(500, (REMAINING_TO_END + REMAINING_TO_RETURN) / 2)
    assert set(phases(middle)) == {"early"}
    schedule = new_schedule()
    phases(np.full(100, 0.2), schedule=schedule)
    assert set(phases(middle, schedule=schedule)) == {"late"}


def test_steps_that_miss_the_object_change_nothing() -> None:
    schedule = new_schedule()
    for _ in range(1000):
        schedule.observe(0, 0.0, 0.0, 0.0)
    assert schedule.phase(0) == "early"
    assert schedule.remaining == 1


def test_the_rarer_the_object_the_longer_the_window() -> None:
    def steps_until_late(count: int) -> int:
        return phases(np.full(3000, 0.2), count=count).index("late") + 1

    assert steps_until_late(64) == steps_until_late(16) == WINDOW_STEPS  # 1 - (1 - 1/16)^16 > 1 - 1/e
    assert 250 <= steps_until_late(1) <= 260


def test_a_fog_is_not_an_object() -> None:
    """A gray fog is nearer to a dark object than the white background, but hides the white as well."""
    error, distance = np.array([0.5] * 10 + [0.7] * 30), np.array([2.0] * 10 + [0.0] * 30)
    means = summarize_errors(error, distance, np.ones(40), np.ones(40))
    assert error[:10].mean() < 0.5 * distance[:10].mean()
    schedule = new_schedule()
    for _ in range(500):
        schedule.observe(*means)
    assert schedule.phase(0) == "early"


def test_the_early_phase_lasts_while_edges_pay() -> None:
    learnt = np.full(300, 0.2)
    assert set(phases(learnt, gain=GAIN_TO_END + 0.1)) == {"early"}
    assert phases(learnt, gain=GAIN_TO_END - 0.1)[-1] == "late"


def test_the_early_phase_returns_when_edges_pay_again() -> None:
    schedule = new_schedule()
    assert phases(np.full(100, 0.2), schedule=schedule)[-1] == "late"
    assert set(phases(np.full(100, 0.2), schedule=schedule, gain=GAIN_TO_RETURN - 0.1)) == {"late"}
    assert phases(np.full(100, 0.2), schedule=schedule, gain=GAIN_TO_RETURN + 0.1)[-1] == "early"


def test_a_loaded_schedule_continues_as_the_saved_one() -> None:
    trace = np.concatenate((np.linspace(1, 0.2, 40), np.full(60, 1.0), np.full(60, 0.3)))
    whole = phases(trace)
    for cut in range(0, 160, 7):  # in the middle of every phase
        first, second = new_schedule(), new_schedule()
        before = phases(trace[:cut], schedule=first)
        second.load_state_dict(first.state_dict())
        assert before + phases(trace[cut:], schedule=second) == whole, cut


# ---- negative controls


class Stuck(AdaptiveSchedule):
    """Never leaves its early phase."""

    def observe(self, count: float, edge_error: float, edge_background: float, uniform_error: float) -> None:
        super().observe(count, edge_error, edge_background, uniform_error)
        self.current = "early"


class Hasty(AdaptiveSchedule):
    """Leaves it at once."""

    def observe(self, count: float, edge_error: float, edge_background: float, uniform_error: float) -> None:
        super().observe(count, edge_error, edge_background, uniform_error)
        self.current = "late"


def adapts(kind: type[AdaptiveSchedule]) -> bool:
    """Whether it leaves when the object is learnt, stays while it is not, and returns when it is lost."""
    return (
        phases(LEARNING, schedule=new_schedule(kind))[-1] == "late"
        and set(phases(np.full(300, 0.95), schedule=new_schedule(kind))) == {"early"}
        and phases(np.concatenate((np.full(100, 0.2), np.full(100, 1.0))), schedule=new_schedule(kind))[-1] == "early"
    )


def test_schedules_that_do_not_adapt_are_caught() -> None:
    assert adapts(AdaptiveSchedule)
    assert not adapts(Stuck)
    assert not adapts(Hasty)


# ---- what an empty scene would show


def test_squared_distance_from_the_background_with_alpha() -> None:
    image = np.array([[1.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.5], [0.3, 0.4, 0.5, 0.0]], dtype=np.float32)
    numbers = np.zeros(3, dtype=np.int64)
    on_white = PlainBackgrounds().squared_distance(image, numbers, (1.0, 1.0, 1.0))
    np.testing.assert_allclose(on_white, [2.0, 0.5, 0.0])
    on_black = PlainBackgrounds().squared_distance(image, numbers, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(on_black, [1.0, 0.25, 0.0])


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_without_alpha_the_background_is_the_border_s_median(dtype: torch.dtype) -> None:
    batch = batch_of(dtype=dtype)
    full = 255 if dtype == torch.uint8 else 1
    colors = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    for image, color in zip(batch["image"], colors, strict=True):
        image[:] = (color * full).to(dtype)
        image[2:5, 2:5] = 0  # the object
    backgrounds = PlainBackgrounds()
    backgrounds.add(ImageBatch.of(batch, use_mask=False))
    backgrounds.add(ImageBatch.of(batch, use_mask=False))
    for row, expected in ((0, 0.0), (3, 1.0)):
        pixels = torch.stack([image[row, 3] for image in batch["image"]]).numpy()
        distance = backgrounds.squared_distance(pixels, batch["image_idx"].numpy(), (1.0, 1.0, 1.0))
        np.testing.assert_allclose(distance, (expected * colors.square().sum(dim=1)).numpy(), atol=1e-6)


def test_means_of_a_step_by_hand() -> None:
    error, distance = np.array([0.5, 9.0, 0.1, 0.4]), np.array([1.0, 0.0, 0.5, 0.009])
    edge_ratio = np.array([4.0, 0.5, 2.0, 1.0])
    assert summarize_errors(error, distance, edge_ratio, np.ones(4)) == (  # drawn uniformly
        2,
        pytest.approx((2 + 4.5 + 0.2 + 0.4) / 4),
        pytest.approx((4 + 0 + 1 + 0.009) / 4),
        pytest.approx(2.5),
    )
    assert summarize_errors(error, distance, edge_ratio, edge_ratio) == (  # drawn by edges
        2,
        pytest.approx(2.5),
        pytest.approx(1.509 / 4),
        pytest.approx((0.125 + 18 + 0.05 + 0.4) / 4),
    )


def test_pixels_drawn_either_way_give_the_same_means() -> None:
    """E[e], E[b] and U[e] from a hundred thousand pixels drawn either way, and exactly from all of them."""
    rng = np.random.default_rng(0)
    strength = torch.from_numpy(rng.random((40, 30)) ** 3 + 0.01)
    error, distance = rng.random((40, 30)), rng.random((40, 30))
    p = (strength / strength.sum()).numpy()
    truth = [float((p * error).sum()), float((p * distance).sum()), float(error.mean())]
    table, image = PixelTable(), torch.tensor([0])
    table.add([strength])
    for source in (table, UniformPixels([(40, 30)])):
        drawn = source.draw(image, 100_000, np.random.default_rng(1))
        pixels = (drawn[:, 1].numpy(), drawn[:, 2].numpy())
        ratios = [distribution.density_ratio(image, drawn).numpy() for distribution in (table, source)]
        _, *means = summarize_errors(error[pixels], distance[pixels], *ratios)
        assert means == pytest.approx(truth, rel=0.02), type(source)


# ---- the sampler under it


def empty_scene_error(image: torch.Tensor) -> torch.Tensor:
    """Squared errors of RGBA pixels where white is rendered everywhere."""
    image = image.float() / 255
    return (image[:, 3:] * (image[:, :3] - 1)).square().sum(dim=1)


class Training:
    """A sampler under the adaptive schedule, and a model whose errors are a share of an empty scene's."""

    def __init__(self, **settings: Any) -> None:
        self.share = 1.0
        self.sampler = following(schedule="adaptive", squared_error=self.errors, **settings)
        assert isinstance(self.sampler.schedule, AdaptiveSchedule)
        self.schedule = self.sampler.schedule

    def errors(self, pixels: dict[str, Any]) -> torch.Tensor:
        return self.share * empty_scene_error(pixels["image"])

    def train(self, share: float, steps: int = 40) -> list[str]:
        """Strategies of the steps."""
        self.share, strategies = share, []
        for step in range(steps):
            self.sampler.set_step(step)
            strategies.append(self.sampler.strategy)
            self.sampler.observe(self.errors(self.sampler.sample(batch_of(channels=4))))
        return strategies


def test_the_sampler_follows_the_schedule() -> None:
    training = Training()
    assert set(training.train(1.0)) == {"edge"}
    learning = training.train(0.2)
    assert (learning[0], learning[-1]) == ("edge", "se")
    assert training.train(1.0)[-1] == "edge"


def test_in_the_late_phase_scored_candidates_are_observed_instead_of_trained_pixels(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The candidates are uniform, and twice as many."""
    training = Training()
    training.train(0.2)
    sampler, schedule = training.sampler, training.schedule
    assert sampler.strategy == "se"
    counts, before, observe = [], schedule.observations, schedule.observe
    monkeypatch.setattr(schedule, "observe", lambda *means: (counts.append(means[0]), observe(*means)))
    assert len(sampler.sample(batch_of(channels=4))["indices"]) == 64
    assert schedule.observations == before + 1
    assert counts[0] > 64  # of 128 random pixels nearly all show an object
    sampler.observe(torch.zeros(64))  # not wanted
    assert schedule.observations == before + 1


def test_in_a_late_uniform_phase_trained_pixels_are_observed() -> None:
    training = Training(late="uniform")
    assert training.train(0.2, steps=60)[-1] == "uniform"
    assert training.schedule.observations == 60
    assert training.train(1.0, steps=60)[-1] == "edge"


def test_under_a_fixed_schedule_nothing_is_observed() -> None:
    sampler = following(step=500)
    sampler.sample(batch_of(channels=4))
    assert not sampler.needs_errors
    assert sampler.pending_batch is None
    sampler.observe(torch.ones(64))
    assert sampler.state_dict() == {}
    assert sampler.strategy == "se"


@pytest.mark.slow
def test_a_run_without_an_early_phase_dies_and_one_without_a_late_phase_is_worse(tmp_path: Path) -> None:
    """300 steps. Off centre a run without an early phase dies; centred, one without a late phase leaves a fog."""

    def trained(table: int, scene: str, **settings: Any) -> dict[str, Any]:
        data = synthetic_scene(table, scene, Settings(), tmp_path)
        config = build_config(Trial("lengths", table, scene, 300, "adaptive", 100), data, tmp_path / "runs")
        return train_and_measure(override(config, {f"{SAMPLER}.{name}": value for name, value in settings.items()}))

    no_early = {"schedule": "fraction", "early_fraction": 0.0}
    no_late = {"schedule": "fraction", "early_fraction": 1.0}
    assert trained(2, "mic", **no_early)["outcome"] == "collapsed"
    assert trained(2, "mic")["outcome"] == "converged"
    assert trained(1, "drums")["psnr"] > trained(1, "drums", **no_late)["psnr"] + 0.3
