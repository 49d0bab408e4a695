"""Whether a training got anywhere: the one rule behind every claim about stability here.

Opacity tells nothing: with the last interval endless, a ray through white fog is as opaque as one that hits the object.
So the rule compares with a rendering of the background alone.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from edge_se_sampler.engine.metrics import compute_metrics
from edge_se_sampler.engine.rendering import Picture
from edge_se_sampler.errors import InputError

Outcome = Literal["converged", "underfit", "collapsed"]
COLLAPSED_SHARE = 0.9
"""Share of the background's error on the object above which nothing of the object was learnt."""
MIN_GAIN = 0.5
"""dB above the background alone, below which a training is underfit."""
FAILURE_RULE = (
    f"A training *failed* if it learnt nothing of the object (its error there is above {COLLAPSED_SHARE:.0%} of the "
    f"plain background's) or ended less than {MIN_GAIN} dB above the background alone."
)


def classify(psnr: float, background_psnr: float, foreground_share: float) -> Outcome:
    """How a training ended, by FAILURE_RULE: "collapsed" and "underfit" are failures."""
    if foreground_share > COLLAPSED_SHARE:
        return "collapsed"
    return "underfit" if psnr < background_psnr + MIN_GAIN else "converged"


def failed(run: dict[str, Any]) -> bool:
    return run["outcome"] != "converged"


def measure_outcome(images: list[dict[str, Any]], pictures: list[Picture], color: float) -> dict[str, Any]:
    """Compare a training, by the metrics of its images of pictures, with a plain grey background (0 black, 1 white).

    Returns its outcome, psnr, background_psnr, and foreground_share: the error on the object as a share of the
    background's there; means over views. InputError if no view tells the object from the background.
    """
    background = [compute_metrics(np.full_like(p.image[..., :3], color), p.image, color, p.mask) for p in pictures]
    key = "foreground_psnr"
    views = zip(images, background, strict=True)
    gains = [rendered[key] - empty[key] for rendered, empty in views if None not in (rendered[key], empty[key])]
    if not gains:
        raise InputError("the held-out views show no object by alpha, which the rule of failure needs")
    psnr, background_psnr = (float(np.mean([view["psnr"] or 0.0 for view in views])) for views in (images, background))
    share = float(np.mean([10 ** (-gain / 10) for gain in gains]))
    outcome = classify(psnr, background_psnr, share)
    return {"psnr": psnr, "background_psnr": background_psnr, "foreground_share": share, "outcome": outcome}
