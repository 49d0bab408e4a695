"""How far a training is: by steps, by the clock, and by the segments that a clock has left behind."""

from __future__ import annotations

import pytest

from edge_se_sampler.engine.plan import NUM_SEGMENTS, Plan


def follow(plan: Plan, seconds_of: float | list[float], setup: float = 0.0) -> tuple[int, float]:
    """Steps and seconds until the plan ends; a list has the seconds of a step in equal parts of the training."""
    step, elapsed = 0, setup
    plan.decide(step, elapsed)
    while step != plan.num_steps:
        part = plan.progress(step)
        elapsed += seconds_of[int(part * len(seconds_of))] if isinstance(seconds_of, list) else seconds_of
        step += 1
        plan.decide(step, elapsed)
        assert part <= plan.progress(step) <= 1
    return step, elapsed


def test_of_a_number_of_steps_each_counts_alike() -> None:
    plan = Plan(7)
    assert [plan.progress(step) for step in (0, 3, 7)] == [0, 3 / 7, 1]
    assert plan.num_steps == 7


@pytest.mark.parametrize("seconds_of", [0.004, [0.002, 0.01, 0.004], [0.03, 0.001]])
def test_a_time_budget_ends_on_time_whatever_the_speed(seconds_of: float | list[float]) -> None:
    plan = Plan(None, time_budget=20.0)
    steps, elapsed = follow(plan, seconds_of, setup=2.0)
    assert elapsed == pytest.approx(20, rel=0.03)
    assert steps == sum(plan.segments)
    assert len(plan.segments) == NUM_SEGMENTS


def test_progress_follows_the_clock() -> None:
    """Steps of the second half take five times as long: it has a fifth as many."""
    plan = Plan(None, time_budget=30.0)
    follow(plan, [0.003, 0.015])
    first, second = sum(plan.segments[:50]), sum(plan.segments[50:])
    assert first / second == pytest.approx(5, rel=0.1)


def test_a_budget_shorter_than_its_steps_ends_after_the_first() -> None:
    plan = Plan(None, time_budget=1.0)
    steps, _ = follow(plan, 0.9)
    assert steps == 8  # the first segment's
    assert len(plan.segments) == NUM_SEGMENTS


def test_segments_as_short_as_a_step_or_two_still_share_the_training_evenly() -> None:
    plan = Plan(None, time_budget=3.0)
    plan.decide(0, 0.1)
    plan.decide(8, 0.8)  # the first steps are slow
    step, elapsed = 8, 0.8
    while step != plan.num_steps:
        assert plan.progress(step) == pytest.approx((elapsed - 0.8) / 2.2, abs=0.06)
        step, elapsed = step + 1, elapsed + 0.018
        plan.decide(step, elapsed)
    assert elapsed == pytest.approx(3, rel=0.03)


def test_segments_repeat_a_budget() -> None:
    plan = Plan(None, time_budget=20.0)
    steps, _ = follow(plan, [0.002, 0.01, 0.004])
    again = Plan(None, plan.segments)
    assert again.num_steps == steps
    assert [again.progress(step) for step in range(steps)] == [plan.progress(step) for step in range(steps)]


def test_a_clock_that_went_back_is_not_a_speed() -> None:
    """As of a run that an earlier version saved, which did not keep how long setting up took."""
    plan = Plan(None, time_budget=20.0)
    plan.decide(0, 8.0)
    plan.decide(8, 9.0)
    step, elapsed = sum(plan.segments), 2.0
    plan.decide(step, elapsed)
    while step != plan.num_steps:
        step, elapsed = step + 1, elapsed + 0.1
        plan.decide(step, elapsed)
        assert elapsed < 21


def test_a_resumed_plan_goes_on() -> None:
    plan = Plan(None, time_budget=20.0)
    plan.decide(0, 0.0)
    plan.decide(8, 0.4)
    again = Plan(None, time_budget=20.0)
    again.load_state_dict(plan.state_dict())
    for other in (plan, again):
        other.decide(sum(other.segments), 1.0)
    assert again.segments == plan.segments
    assert len(again.segments) > 2
