"""Volume rendering (NeRF, equations 3 and 5): densities and colors along a ray -> its color.

n, s   rays, samples along a ray
t      distance of a sample from the origin, (n, s), ascending
delta  distance to the next sample, (n, s); the last reaches to infinity (1e10)
sigma  density, >= 0
alpha  1 - exp(-sigma delta), opacity of an interval
T      product of the 1 - alpha before it, transmittance
w      T alpha, weight of a sample; the sum over a ray is its accumulation
"""

from __future__ import annotations

import torch
from torch import Tensor


def intervals(t: Tensor, *, endless: bool = True) -> Tensor:
    """delta: (n, s) -> (n, s); the last reaches to infinity, or is as long as the one before it."""
    delta = t[:, 1:] - t[:, :-1]
    return torch.cat((delta, torch.full_like(t[:, :1], 1e10) if endless else delta[:, -1:]), dim=1)


def sample_weights(sigma: Tensor, delta: Tensor) -> Tensor:
    """w of every sample, (n, s); each in [0, 1], together at most 1."""
    depth = sigma * delta
    before = torch.cumsum(depth[:, :-1], dim=1)
    transmittance = torch.exp(-torch.nn.functional.pad(before, (1, 0)))
    return transmittance * -torch.expm1(-depth)


def composite(weights: Tensor, colors: Tensor, background: Tensor) -> Tensor:
    """Colors (n, 3) of rays, from their samples' weights (n, s) and colors (n, s, 3), on background (3,) or (n, 3)."""
    rendered = (weights[:, None, :] @ colors)[:, 0]
    return rendered + (1 - weights.sum(dim=1, keepdim=True)) * background
