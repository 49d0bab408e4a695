"""Volume rendering of packed samples, in closed form.

n, m   rays; samples of all rays one after the other, those of a ray by ascending distance
tau    sigma delta, optical depth of a sample
T      exp(-sum of the tau before it on its ray), transmittance
w      T (1 - exp(-tau)), weight
g      gradient of the loss by a ray's (colour, accumulation)
s      w (c, 1) . g: what a sample contributes to the loss, to first order

d loss / d c_i = w_i g, and d loss / d tau_i = T_i exp(-tau_i) (c_i, 1) . g - (sum of the s_j behind i): more depth at
i shows more of its own colour and less of everything behind it. Sums along a ray are differences of one running sum,
in float64, for it runs over all rays.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def render_packed(density: Tensor, color: Tensor, step: float, first: Tensor, ray: Tensor) -> tuple[Tensor, Tensor]:
    """Colours (n, 3) in front of black and accumulations (n, 1).

    Args:
        density: (m,) >= 0, per world unit.
        color: (m, 3).
        step: length of every sample's interval, world units.
        first: (n,) int64: sample at which each ray begins; a ray may have none.
        ray: (m,) int64, ascending.
    """
    rendered = _Render.apply(density * step, color, first, ray)
    return rendered[:, :3], rendered[:, 3:]


def transmittance(tau: Tensor, first: Tensor, ray: Tensor) -> Tensor:
    """T of every sample, (m,)."""
    before = torch.cumsum(tau, 0, dtype=torch.float64) - tau
    if not len(tau):
        return tau
    return torch.exp(before[first.clamp(max=len(tau) - 1)][ray] - before).to(tau.dtype)


def accumulate_along_rays(values: Tensor, first: Tensor) -> Tensor:
    """Sums over each ray's samples: (m, k) -> (n, k)."""
    order = torch.arange(len(values), device=values.device)
    return torch.nn.functional.embedding_bag(order, values, first, mode="sum")


def expand_to_samples(values: Tensor, first: Tensor, ray: Tensor) -> Tensor:
    """Each ray's row for each of its samples: (n, k) -> (m, k)."""
    return _Spread.apply(values, first, ray)


class _Spread(torch.autograd.Function):
    """values[ray]; torch's own gradient does not know that the samples of a ray lie together."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, first: Tensor, ray: Tensor) -> Tensor:
        ctx.save_for_backward(first)
        return values[ray]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (first,) = ctx.saved_tensors
        return accumulate_along_rays(gradient, first), None, None


class _Render(torch.autograd.Function):
    """tau (m,), colour (m, 3) -> colour and accumulation (n, 4)."""

    @staticmethod
    def forward(ctx: Any, tau: Tensor, color: Tensor, first: Tensor, ray: Tensor) -> Tensor:
        before = transmittance(tau, first, ray)
        weight = before * -torch.expm1(-tau)
        ctx.save_for_backward(tau, color, first, ray, before, weight)
        return accumulate_along_rays(torch.cat((color * weight[:, None], weight[:, None]), dim=1), first)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        tau, color, first, ray, before, weight = ctx.saved_tensors
        mine = gradient[ray]
        toward = (color * mine[:, :3]).sum(dim=1) + mine[:, 3]
        share = weight * toward
        upto = torch.cumsum(share, 0, dtype=torch.float64)
        last = torch.cat((first[1:], first.new_tensor([len(tau)]))) - 1
        behind = (upto[last.clamp(min=0)][ray] - upto).to(tau.dtype) if len(tau) else tau
        return before * torch.exp(-tau) * toward - behind, weight[:, None] * mine[:, :3], None, None
