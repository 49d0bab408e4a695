"""Which phase a step is in under a fixed schedule."""

from __future__ import annotations

import pytest

from edge_se_sampler.engine.plan import Plan
from edge_se_sampler.sampling.schedule import FixedSchedule
from edge_se_sampler.sampling.settings import SamplingSettings


@pytest.mark.parametrize(
    ("step", "early_steps", "phase"),
    [
        (0, 0, "late"),
        (0, 1, "early"),
        (1, 1, "late"),
        (99, 100, "early"),
        (100, 100, "late"),
        (0, 0.5, "early"),  # a tenth of 5 steps
        (1, 0.5, "late"),
        (2, 2.5, "early"),
        (3, 2.5, "late"),
    ],
)
def test_early_while_the_step_is_below_the_length(step: int, early_steps: float, phase: str) -> None:
    assert FixedSchedule(early_steps).phase(step) == phase


@pytest.mark.parametrize("planned", [1, 9, 10, 11, 70, 230, 1000, 15_000, 200_000, 300_007])
def test_the_papers_tenth_is_exact(planned: int) -> None:
    schedule = FixedSchedule(SamplingSettings().early_fraction, Plan(planned).progress)
    tenth = -(-planned // 10)  # step < planned / 10 holds for this many steps
    around = range(max(tenth - 2, 0), tenth + 3)
    assert [schedule.phase(step) == "early" for step in around] == [step < tenth for step in around]


def test_of_a_plan_in_segments_the_early_phase_lasts_a_tenth_of_the_segments() -> None:
    """As a time budget decides on them: the first ones are shorter, because nothing is known of their speed."""
    schedule = FixedSchedule(0.1, Plan(None, [8] + 99 * [20]).progress)
    assert [schedule.phase(step) for step in (0, 7, 187, 188, 1000)] == ["early", "early", "early", "late", "late"]
