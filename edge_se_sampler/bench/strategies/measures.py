"""What is measured of a training's renderings, on objects and on captures, whose images have no alpha."""

from __future__ import annotations

from typing import Any

import numpy as np

from edge_se_sampler.bench.outcomes import classify, measure_outcome
from edge_se_sampler.bench.results import Run
from edge_se_sampler.engine.metrics import compute_metrics
from edge_se_sampler.engine.rendering import Picture


def measure(images: list[dict[str, Any]], pictures: list[Picture], color: float) -> Run:
    """By the metrics of a model's images of pictures, in front of a gray background: what `measure_outcome` returns,
    and the means of PSNR on the object and in the band around edges, None where no picture has such."""
    is_object = any(picture.image.shape[2] == 4 for picture in pictures)
    outcome = measure_outcome(images, pictures, color) if is_object else _outcome_of_capture(images, pictures)
    return {**outcome, **{key: _mean(images, key) for key in ("foreground_psnr", "edge_band_psnr")}}


def _outcome_of_capture(images: list[dict[str, Any]], pictures: list[Picture]) -> dict[str, Any]:
    """As `measure_outcome`, where no alpha tells an object: beside the mean color of each picture."""
    plain = [np.broadcast_to(p.image.mean(axis=(0, 1)), p.image.shape) for p in pictures]
    of_plain = [compute_metrics(image, p.image, 1.0, p.mask) for image, p in zip(plain, pictures, strict=True)]
    psnr, plain_psnr = _mean(images, "psnr"), _mean(of_plain, "psnr")
    assert psnr is not None
    assert plain_psnr is not None
    outcome = classify(psnr, plain_psnr, foreground_share=0.0)
    return {"psnr": psnr, "background_psnr": plain_psnr, "foreground_share": None, "outcome": outcome}


def _mean(images: list[dict[str, Any]], key: str) -> float | None:
    """Of a metric over the images that have it."""
    values = [image[key] for image in images if image[key] is not None]
    return float(np.mean(values)) if values else None
