"""Goodness of fit, by Pearson's chi-square: does a sampler draw what it should?

A sampler that is right fails one test in 1/ALPHA; the seeds are fixed, so a test that passes passes for ever. What a
test is worth shows in its negative controls: wrong samplers that it must reject.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

ALPHA = 1e-6
Z = 4.892
"""|z| of a normal variable that ALPHA of all draws exceed."""


def p_value(counts: np.ndarray, probability: np.ndarray) -> float:
    """Chance of counts at least as unlikely as these, if the cells had these probabilities.

    0 where a cell of probability 0 was hit. Every other cell must be expected 5 times, or the test has no meaning.
    """
    counts, probability = counts.ravel(), probability.ravel()
    assert math.isclose(probability.sum(), 1, abs_tol=1e-9)
    possible = probability > 0
    if counts[~possible].any():
        return 0.0
    expected = probability[possible] * counts.sum()
    assert expected.min() >= 5, f"too few draws: {expected.min():.2f} expected in the rarest cell"
    if len(expected) == 1:
        return 1.0
    statistic = float(((counts[possible] - expected) ** 2 / expected).sum())
    freedom = torch.tensor(len(expected) - 1, dtype=torch.float64)
    return float(torch.special.gammaincc(freedom / 2, torch.tensor(statistic / 2, dtype=torch.float64)))


def pixel_counts(drawn: Tensor, shape: tuple[int, ...]) -> np.ndarray:
    """How often each cell of an array of this shape was drawn; drawn: (n, len(shape)) int64."""
    return np.bincount(np.ravel_multi_index(drawn.numpy().T, shape), minlength=math.prod(shape)).reshape(shape)


def mean_is(samples: np.ndarray, truth: float) -> bool:
    """Whether independent samples may have this mean (normal approximation, at ALPHA)."""
    return abs(samples.mean() - truth) <= Z * samples.std(ddof=1) / math.sqrt(len(samples))
