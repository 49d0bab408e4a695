"""Whether a training got anywhere: the one rule behind every claim about stability here.

Opacity tells nothing: with the last interval endless, a ray through white fog is as opaque as one that hits. So the
rule compares with the image of the background alone.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from edge_se_sampler.engine.metrics import compute_metrics
from edge_se_sampler.engine.rendering import Picture
from edge_se_sampler.errors import InputError

Outcome = Literal["learnt", "slow", "background"]


def background_measures(pictures: list[Picture], shade: float) -> list[dict[str, float | None]]:
    """`compute_metrics` of answering every view with the background alone."""
    return [compute_metrics(np.full((*p.image.shape[:2], 3), shade), p.image, shade) for p in pictures]


def foreground_share(results: dict[str, Any], background: list[dict[str, float | None]]) -> float:
    """Error on the object as a share of the error that the background alone has there, a mean over the views.

    Args:
        results: of `evaluate`.
        background: of `background_measures` on the same views.

    Raises:
        InputError: no view tells the object from the background.
    """
    pairs = [
        (own["foreground_psnr"], alone["foreground_psnr"])
        for own, alone in zip(results["images"], background, strict=True)
    ]
    shares = [10 ** ((alone - own) / 10) for own, alone in pairs if own is not None and alone is not None]
    if not shares:
        raise InputError("the held-out views show no object by alpha, which the rule of failure asks for")
    return float(np.mean(shares))


def judged(results: dict[str, Any], pictures: list[Picture], shade: float) -> dict[str, Any]:
    """Of a training by its `evaluate` on pictures: background_psnr, foreground_share and outcome."""
    background = background_measures(pictures, shade)
    background_psnr = sum(alone["psnr"] or 0.0 for alone in background) / len(background)
    share = foreground_share(results, background)
    return {
        "background_psnr": background_psnr,
        "foreground_share": share,
        "outcome": outcome(results["psnr"], background_psnr, share),
    }


def outcome(psnr: float, background_psnr: float, share: float) -> Outcome:
    """ "background": nothing of the object was learnt; "slow": less than 0.5 dB better than the background alone, or
    worse than it; "learnt" otherwise. The first two are failures."""
    if share > 0.9:
        return "background"
    return "slow" if psnr < background_psnr + 0.5 else "learnt"
