"""Values and combinations of settings that have no meaning are refused, in a sentence that names the flag."""

from __future__ import annotations

import re
from typing import Any

import pytest

from edge_se_sampler.errors import InputError
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig, SamplingSettings

NAN, INF = float("nan"), float("inf")

REFUSED: list[tuple[str, dict[str, Any]]] = [
    *[("precrop-fraction", {"precrop_fraction": value}) for value in (0, -0.5, 1.01, NAN)],
    *[("early-fraction", {"early_fraction": value}) for value in (-0.01, 1.01, NAN)],
    *[("early-steps", {"schedule": "steps", "early_steps": value}) for value in (0, -1)],
    ("early-steps", {"early_steps": 100}),  # schedule "fraction"
    *[("edge-epsilon", {"edge_epsilon": value}) for value in (0, -1e-3, 1e-7, 1e7, INF, NAN)],
    *[("se-candidates", {"se_candidates": value}) for value in (1, 0, -2)],
    *[("importance-weight", {"importance_weight": value}) for value in (-0.1, 1.1, NAN)],
    *[
        ("importance-weight", {"importance_weight": 0.5, "early": early, "late": "uniform"})
        for early in ("uniform", "precrop")
    ],
]


@pytest.mark.parametrize(("flag", "settings"), REFUSED)
def test_refused(flag: str, settings: dict[str, Any]) -> None:
    message = rf"^pixel-sampler\.{flag} is {re.escape(repr(settings[flag.replace('-', '_')]))}: \w.*$"
    with pytest.raises(InputError, match=message) as refusal:
        SamplingSettings(**settings).check()
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(("flag", "settings"), REFUSED)
def test_a_sampler_refuses_them_when_it_is_made(flag: str, settings: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=flag):
        EdgeSEPixelSamplerConfig(**settings).setup()


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"precrop_fraction": 1},
        {"precrop_fraction": 1e-6},
        {"early_fraction": 0},
        {"early_fraction": 1},
        {"schedule": "steps", "early_steps": 1},
        {"schedule": "adaptive"},
        {"edge_epsilon": 1e-6},
        {"edge_epsilon": 1e6},
        {"se_candidates": 2},
        {"importance_weight": 1.0},
        {"importance_weight": 0.5, "early": "uniform"},
        {"importance_weight": 0.5, "late": "uniform"},
        {"early": "uniform", "late": "uniform"},
    ],
)
def test_values_at_their_limits_are_accepted(settings: dict[str, Any]) -> None:
    checked = SamplingSettings(**settings)
    checked.check()
    assert checked == SamplingSettings(**settings)


@pytest.mark.parametrize(
    ("settings", "has_masks", "early", "schedule"),
    [
        ({"early": "auto"}, True, "uniform", "fraction"),
        ({"early": "auto"}, False, "edge", "adaptive"),
        ({"early": "auto", "schedule": "adaptive"}, True, "edge", "adaptive"),
        ({"early": "auto", "schedule": "steps", "early_steps": 9}, False, "edge", "steps"),
        ({"early": "precrop"}, True, "precrop", "fraction"),
        ({"early": "uniform"}, False, "uniform", "fraction"),
    ],
)
def test_auto_is_resolved_by_whether_masks_tell_where_the_object_is(
    settings: dict[str, Any], has_masks: bool, early: str, schedule: str
) -> None:
    config = EdgeSEPixelSamplerConfig(**settings)
    resolved = config.resolve_auto(has_masks)
    assert (resolved.early, resolved.schedule) == (early, schedule)
    resolved.check()
    if not has_masks:  # nor does a sampler know of any
        assert config.setup().config == resolved


def test_defaults_are_the_papers_edge_and_squared_error() -> None:
    config = EdgeSEPixelSamplerConfig()
    assert (config.early, config.late, config.schedule, config.early_fraction) == ("edge", "se", "fraction", 0.1)
    assert (config.precrop_fraction, config.edge_filter, config.edge_source) == (0.5, "sobel", "color")
    assert (config.edge_epsilon, config.se_candidates, config.importance_weight) == (0.01, 2, 0.0)
    assert (config.images_per_step, config.num_rays_per_batch) == ("one", 1024)
