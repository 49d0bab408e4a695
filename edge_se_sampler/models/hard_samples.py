"""Hard samples along the rays: all samples are evaluated, few are differentiated (Korhonen et al. 2024, "Efficient NeRF
Optimization - Not All Samples Remain Equally Hard", arXiv 2408.03193).

m   samples that a field is evaluated at together, by all ranks
g   norm of the loss's gradient by a sample's raw outputs, before their activations: how hard the sample is
M   (sum g)^2 / sum g^2, the number of samples that g is effectively spread over
pi  min(1, M g / sum g), probability with which a sample is kept

The first evaluation builds no graph; the loss gives the outputs' gradients, and so g, for the price of volume
rendering; only the kept samples are evaluated again, with a graph. The paper draws by g, with as many samples as the
training still needs and no number to set. Decided here: that number is M, which falls as what is left to learn
concentrates; draws are independent, without replacement; and a kept sample's gradient counts 1 / pi, so that its
expectation is the full gradient. The hardest sample is always kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from edge_se_sampler import ranks
from edge_se_sampler.models.field import NeRFField


def keep_probability(hardness: Tensor) -> Tensor:
    """pi of samples of hardness g >= 0, (m,) -> (m,), among those of all ranks; 0 only where g is."""
    tiny = torch.finfo(hardness.dtype).tiny
    largest = ranks.find_largest(torch.cat((hardness, hardness.new_full((1,), tiny))).amax())
    share = hardness / largest  # else squares underflow
    total, squares = ranks.add_up(torch.stack((share.sum(), share.square().sum())))
    return (share * total / squares.clamp(min=1)).clamp(max=1)


def raw_gradient_norm(field: NeRFField, outputs: Sequence[Tensor], gradients: Sequence[Tensor]) -> Tensor:
    """g (m,), from densities (m,) and colors (m, 3) and the loss's gradients by them."""
    (density, color), (by_density, by_color) = outputs, gradients
    slope = -torch.expm1(-density) if field.softplus else (density > 0).to(density.dtype)
    by_raw_color = by_color * color * (1 - color)
    return torch.sqrt((by_density * slope).square() + by_raw_color.square().sum(dim=1))


class _HardSamples(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, field: NeRFField, uniform: Tensor, points: tuple[Any, ...], *_: Tensor):
        ctx.field = field
        outputs = field(*points)
        ctx.save_for_backward(*points, uniform, *outputs)
        return outputs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        positions, directions, ray_indices, noise, uniform, *outputs = ctx.saved_tensors
        parameters = tuple(ctx.field.parameters())
        probability = keep_probability(raw_gradient_norm(ctx.field, outputs, gradients))
        if len(positions) == 0:  # no ray meets a cell, or this rank has none
            return None, None, None, *map(torch.zeros_like, parameters)
        kept = torch.nonzero(uniform < probability)[:, 0]
        if ray_indices is None:
            rays = torch.div(kept, len(positions) // len(directions), rounding_mode="floor")
        else:
            rays = ray_indices[kept]
        by_density, by_color = (gradient[kept] for gradient in gradients)
        scale = 1 / probability[kept]
        with torch.enable_grad():
            again = ctx.field(positions[kept], directions, rays, None if noise is None else noise[kept])
        by_parameters = torch.autograd.grad(again, parameters, (by_density * scale, by_color * scale[:, None]))
        return None, None, None, *by_parameters


def evaluate_hard_samples(
    field: NeRFField,
    positions: Tensor,
    directions: Tensor,
    ray_indices: Tensor | None,
    noise: Tensor | None,
    uniform: Tensor,
) -> tuple[Tensor, Tensor]:
    """What the field returns, (m,) and (m, 3), with a gradient by its weights through the kept samples alone.

    Args:
        positions, directions, ray_indices, noise: the field's.
        uniform: (m,) draws in [0, 1): a sample is kept where its own is below pi.
    """
    points = (positions, directions, ray_indices, noise)
    return _HardSamples.apply(field, uniform, points, *field.parameters())  # pyright: ignore[reportReturnType]
