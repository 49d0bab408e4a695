"""Volume rendering of packed samples, in closed form.

n, m   rays; samples of all rays one after the other, those of a ray by ascending distance
tau    sigma delta, optical depth of a sample
T      exp(-sum of the tau before it on its ray), transmittance
w      T (1 - exp(-tau)), weight
g      gradient of the loss by a ray's (color, accumulation)
s      w (c, 1) . g: what a sample contributes to the loss, to first order

d loss / d c_i = w_i g, and d loss / d tau_i = T_i exp(-tau_i) (c_i, 1) . g - (sum of the s_j after i): more depth at
i shows more of its own color and less of everything after it. Sums along a ray are differences of one running sum,
in float64, for it runs over all rays.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def render_packed(
    density: Tensor, color: Tensor, step: float, ray_starts: Tensor, ray_indices: Tensor
) -> tuple[Tensor, Tensor]:
    """Colors (n, 3) in front of black and accumulations (n, 1).

    Args:
        density: (m,) >= 0, per world unit.
        color: (m, 3).
        step: length of every sample's interval, world units.
        ray_starts: (n,) int64: sample at which each ray begins; a ray may have none.
        ray_indices: (m,) int64, ascending.
    """
    rendered = _Render.apply(density * step, color, ray_starts, ray_indices)
    return rendered[:, :3], rendered[:, 3:]


def transmittance(tau: Tensor, ray_starts: Tensor, ray_indices: Tensor) -> Tensor:
    """T of every sample, (m,)."""
    before = torch.cumsum(tau, 0, dtype=torch.float64) - tau
    if not len(tau):
        return tau
    return torch.exp(before[ray_starts.clamp(max=len(tau) - 1)][ray_indices] - before).to(tau.dtype)


def accumulate_along_rays(values: Tensor, ray_starts: Tensor) -> Tensor:
    """Sums over each ray's samples: (m, k) -> (n, k)."""
    order = torch.arange(len(values), device=values.device)
    return torch.nn.functional.embedding_bag(order, values, ray_starts, mode="sum")


def expand_to_samples(values: Tensor, ray_starts: Tensor, ray_indices: Tensor) -> Tensor:
    """Each ray's row for each of its samples: (n, k) -> (m, k)."""
    return _ExpandToSamples.apply(values, ray_starts, ray_indices)


class _ExpandToSamples(torch.autograd.Function):
    """values[ray_indices]; torch's own gradient does not know that the samples of a ray lie together."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, ray_starts: Tensor, ray_indices: Tensor) -> Tensor:
        ctx.save_for_backward(ray_starts)
        return values[ray_indices]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (ray_starts,) = ctx.saved_tensors
        return accumulate_along_rays(gradient, ray_starts), None, None


class _Render(torch.autograd.Function):
    """tau (m,), color (m, 3) -> color and accumulation (n, 4)."""

    @staticmethod
    def forward(ctx: Any, tau: Tensor, color: Tensor, ray_starts: Tensor, ray_indices: Tensor) -> Tensor:
        before = transmittance(tau, ray_starts, ray_indices)
        weight = before * -torch.expm1(-tau)
        ctx.save_for_backward(tau, color, ray_starts, ray_indices, before, weight)
        return accumulate_along_rays(torch.cat((color * weight[:, None], weight[:, None]), dim=1), ray_starts)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        tau, color, ray_starts, ray_indices, before, weight = ctx.saved_tensors
        gradient = gradient[ray_indices]  # of each sample's ray
        toward = (color * gradient[:, :3]).sum(dim=1) + gradient[:, 3]
        upto = torch.cumsum(weight * toward, 0, dtype=torch.float64)
        last = torch.cat((ray_starts[1:], ray_starts.new_tensor([len(tau)]))) - 1
        after = (upto[last.clamp(min=0)][ray_indices] - upto).to(tau.dtype) if len(tau) else tau
        return before * torch.exp(-tau) * toward - after, weight[:, None] * gradient[:, :3], None, None
