"""The rule that says whether a training got anywhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from edge_se_sampler.bench.outcomes import classify, failed, measure_outcome
from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.engine.metrics import composite_on, compute_metrics
from edge_se_sampler.engine.rendering import Picture, to_pictures


@pytest.fixture
def pictures(scene: Path) -> list[Picture]:
    return to_pictures(read_blender(scene, "train"))


def measure(pictures: list[Picture], whiten: float) -> list[dict[str, Any]]:
    """Metrics of answering with the images themselves, mixed with white."""
    rendered = [whiten + (1 - whiten) * composite_on(picture.image) for picture in pictures]
    return [compute_metrics(image, picture.image, 1.0) for image, picture in zip(rendered, pictures, strict=True)]


@pytest.mark.parametrize(("whiten", "share"), [(1.0, 1.0), (0.5, 0.25), (0.01, 1e-4)])
def test_the_error_on_the_object_is_a_share_of_the_backgrounds(
    whiten: float, share: float, pictures: list[Picture]
) -> None:
    outcome = measure_outcome(measure(pictures, whiten), pictures, 1.0)
    assert outcome["foreground_share"] == pytest.approx(share, rel=0.01)


@pytest.mark.parametrize(
    ("psnr", "share", "expected"),
    [
        (20, 1.0, "collapsed"),
        (25, 0.95, "collapsed"),
        (20.4, 0.5, "underfit"),
        (15, 0.5, "underfit"),
        (20.6, 0.5, "converged"),
    ],
)
def test_outcomes(psnr: float, share: float, expected: str) -> None:
    assert classify(psnr, 20.0, share) == expected
    assert failed({"outcome": expected}) == (expected != "converged")


def test_the_background_alone_is_collapsed(pictures: list[Picture]) -> None:
    results = measure(pictures, 1.0)
    outcome = measure_outcome(results, pictures, 1.0)
    assert outcome["outcome"] == "collapsed"
    assert outcome["background_psnr"] == pytest.approx(outcome["psnr"])
    assert measure_outcome(measure(pictures, 0.1), pictures, 1.0)["outcome"] == "converged"
