"""Where along its ray the field is evaluated.

n, s   rays, samples along a ray
t      distances from the origin, (n, s), ascending
w      weights of the coarse rendering, a histogram over the ray (see volume)
"""

from __future__ import annotations

import torch
from torch import Tensor


def stratified(near: Tensor, far: Tensor, count: int, jitter: Tensor | None) -> Tensor:
    """`count` distances between near and far: one uniform draw in each of as many bins (NeRF, equation 2).

    Args:
        near, far: (n, 1).
        jitter: (n, count) uniform in [0, 1); None: evenly spaced from near to far, as NeRF's evaluation does.

    Returns:
        (n, count), ascending.
    """
    u = torch.linspace(0, 1, count, dtype=near.dtype, device=near.device)
    even = near * (1 - u) + far * u
    if jitter is None:
        return even
    middle = (even[:, 1:] + even[:, :-1]) / 2
    lower = torch.cat((even[:, :1], middle), dim=1)
    upper = torch.cat((middle, even[:, -1:]), dim=1)
    return lower + (upper - lower) * jitter


def importance(edges: Tensor, weights: Tensor, uniform: Tensor) -> Tensor:
    """Draws from a piecewise constant density by its inverse CDF (NeRF, section 5.2).

    Args:
        edges: (n, b + 1), ascending: ends of the bins.
        weights: (n, b) in [0, 1]; 1e-5 is added, so that an empty ray is sampled evenly.
        uniform: (n, m) in [0, 1].

    Returns:
        (n, m), each between the first and the last edge; ascending where `uniform` is.
    """
    density = weights + 1e-5
    cdf = torch.cumsum(density / density.sum(dim=1, keepdim=True), dim=1)
    cdf = torch.nn.functional.pad(cdf, (1, 0))
    above = torch.searchsorted(cdf, uniform.contiguous(), right=True).clamp(1, weights.shape[1])
    lower, upper = cdf.gather(1, above - 1), cdf.gather(1, above)
    within = ((uniform - lower) / (upper - lower)).clamp(0, 1)
    start, stop = edges.gather(1, above - 1), edges.gather(1, above)
    return start + within * (stop - start)
