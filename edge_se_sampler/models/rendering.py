"""Where along a ray the field is sampled, and volume rendering (NeRF, sections 4 and 5.2).

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


def remove_background(values: Tensor, opacity: Tensor, background: Tensor) -> Tensor:
    """What rays' colors or distances (n, c) would be without that of the background (n, c) behind: means over what is
    seen, of no meaning where the opacity (n, 1) is next to nothing."""
    return (values - (1 - opacity) * background) / opacity.clamp(min=1e-3)


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
