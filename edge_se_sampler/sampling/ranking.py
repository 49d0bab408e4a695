"""Squared errors -> ranks -> selected candidates: equations 6 and 7 of the paper.

m      candidates, drawn uniformly (the paper: m = 2N)
N      candidates kept for training
w_i    weight of candidate i: its rank by ascending squared error, 1 .. m (equation 7 without its normalisation)
e_i    independent Exponential(1); e_i / w_i is the time at which candidate i arrives
tau    arrival time of the (N + 1)-th

The N first arrivals are a weighted draw without replacement (Efraimidis and Spirakis 2006): one sort, no loop.
Equation 6 says argsort, literally the indices that sort, which have nothing to do with the error; ranks are meant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


def error_ranks(squared_error: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Ranks 1 .. m by ascending squared error, a float32 >= 0, ties broken at random; (m,) -> (m,) int64."""
    shuffled = rng.permutation(len(squared_error))
    # floats >= 0 are ordered as their bits are; with the position below them no two are equal, and any sort will do
    bits = squared_error[shuffled].astype(np.float32).view(np.int32).astype(np.int64)
    ascending = shuffled[np.sort(bits << 32 | np.arange(len(bits))) & 0xFFFFFFFF]
    ranks = np.empty(len(squared_error), dtype=np.int64)
    ranks[ascending] = np.arange(1, len(squared_error) + 1)
    return ranks


@dataclass(frozen=True)
class Selection:
    """The candidates that are trained on."""

    rows: Tensor
    """(N,) int64, ascending: rows of the candidates, on the device of the errors."""
    inclusion: Tensor
    """(N,) float32: probability with which each was kept, given tau: 1 - exp(-w_i tau). Weighting by its inverse
    makes a mean over the kept unbiased for the mean over the candidates; 1 / p of equation 7 does not."""


def sample_by_rank(squared_error: Tensor, keep: int, rng: np.random.Generator) -> Selection:
    """Keep N of m candidates, without replacement, in proportion to the rank of their squared error.

    Args:
        squared_error: (m,) any device, >= 0.
        keep: N, 1 <= N <= m.

    Raises:
        ValueError: N is out of range.
        FloatingPointError: an error that is not finite; it must never win a top rank.
    """
    errors = squared_error.detach().cpu().double().numpy()
    if not 1 <= keep <= len(errors):
        raise ValueError(f"cannot keep {keep} of {len(errors)} candidates")
    if bad := np.count_nonzero(~np.isfinite(errors)):
        raise FloatingPointError(f"the squared errors of {bad} of {len(errors)} candidates are not finite")
    weights = error_ranks(errors, rng)
    arrival = rng.standard_exponential(len(errors)) / weights
    order = np.argpartition(arrival, keep) if keep < len(errors) else np.arange(keep)
    first = np.sort(order[:keep])
    tau = arrival[order[keep]] if keep < len(errors) else np.inf
    inclusion = -np.expm1(-weights[first] * tau)
    device = squared_error.device
    return Selection(torch.from_numpy(first).to(device), torch.from_numpy(inclusion).float().to(device))
