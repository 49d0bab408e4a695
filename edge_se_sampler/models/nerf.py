"""The original NeRF: rays -> colors, by a coarse and a fine network."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.models.config import POINTS_PER_CHUNK, NeRFModelConfig
from edge_se_sampler.models.field import NeRFField
from edge_se_sampler.models.hard_samples import evaluate_hard_samples
from edge_se_sampler.models.ray_model import RayModel
from edge_se_sampler.models.rendering import composite, importance, intervals, sample_weights, stratified
from edge_se_sampler.occupancy.bricks import BrickGrid


class NeRFModel(RayModel):
    """Coarse and fine networks, stratified and importance samples. `rng` draws the initial weights."""

    networks = ("coarse", "fine")
    grid: BrickGrid | None

    def __init__(self, config: NeRFModelConfig, rng: np.random.Generator, grid: BrickGrid | None = None) -> None:
        super().__init__(config, grid)
        self.config = config
        self.num_coarse_samples = config.preset.num_coarse_samples
        self.num_importance_samples = config.preset.num_importance_samples
        self.coarse = NeRFField(config, rng)
        self.fine = NeRFField(config, rng)

    @property
    def rays_per_chunk(self) -> int:
        points_per_ray = 2 * self.num_coarse_samples + self.num_importance_samples
        return max(1, POINTS_PER_CHUNK.get(self.device.type, 2**14) // points_per_ray)

    def forward(self, rays: RayBundle) -> dict[str, Tensor]:
        """As `RayModel`; and density_fine, delta_fine (n, s) of the fine network's samples."""
        t, weights, rgb, background = self._coarse(rays)
        outputs = {"rgb_coarse": rgb, "accumulation_coarse": weights.sum(1, keepdim=True), "background": background}

        count = self.num_importance_samples
        even = torch.linspace(0, 1, count, dtype=t.dtype, device=t.device).expand(len(t), count)
        uniform = self.uniform(len(t), count) if self.training else even
        further = importance((t[:, 1:] + t[:, :-1]) / 2, weights.detach()[:, 1:-1], uniform)
        t = torch.sort(torch.cat((t, further), dim=1)).values
        weights, rgb, (density, delta) = self._render(self.fine, rays, t, background)
        accumulation = weights.sum(1, keepdim=True)
        depth = (weights * t).sum(1, keepdim=True) + (1 - accumulation) * t[:, -1:]
        outputs |= {"rgb_fine": rgb, "accumulation_fine": accumulation, "depth_fine": depth}
        return outputs | {"density_fine": density, "delta_fine": delta}

    def coarse_squared_error(self, rays: RayBundle, image: Tensor) -> Tensor:
        """(n,) `squared_error` of the coarse colors, without evaluating the fine network."""
        _, _, rgb, background = self._coarse(rays)
        return self.squared_error({"rgb_coarse": rgb, "background": background}, image, "coarse")

    def _coarse(self, rays: RayBundle) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Render by the coarse network: t and weights of its samples (n, s), colors and backgrounds (n, 3)."""
        norm = rays.metadata["directions_norm"]
        jitter = self.uniform(len(rays), self.num_coarse_samples) if self.training else None
        near, far = self.config.depths
        t = stratified(near * norm, far * norm, self.num_coarse_samples, jitter)
        background = self.get_background(rays)
        weights, rgb, _ = self._render(self.coarse, rays, t, background)
        return t, weights, rgb, background

    def _render(
        self, field: NeRFField, rays: RayBundle, t: Tensor, background: Tensor
    ) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
        """Weights (n, s), colors (n, 3), and (densities, intervals) (n, s) of rays sampled at t (n, s)."""
        positions = (rays.origins[:, None] + t[..., None] * rays.directions[:, None]).reshape(-1, 3)
        noise = uniform = None
        if self.training and self.config.density_noise:
            noise = self.draw(torch.randn, *t.shape).reshape(-1) * self.config.density_noise
        if self.training and self.config.hard_samples and torch.is_grad_enabled():
            uniform = self.uniform(*t.shape).reshape(-1)
        if self.grid is None:
            density, color = _evaluate(field, positions, rays.directions, None, noise, uniform)
        else:
            packed = torch.nonzero(self.grid.contains(positions))[:, 0]
            ray_indices = torch.div(packed, t.shape[1], rounding_mode="floor")
            noise, uniform = (None if drawn is None else drawn[packed] for drawn in (noise, uniform))
            packed_density, packed_color = _evaluate(
                field, positions[packed], rays.directions, ray_indices, noise, uniform
            )
            density = t.new_zeros(t.numel()).index_put((packed,), packed_density)
            color = t.new_zeros((t.numel(), 3)).index_put((packed,), packed_color)
        # a softplus is never 0: over an endless interval it would hide every background
        delta = intervals(t, endless=self.config.density_activation == "relu")
        density = density.reshape(t.shape)
        weights = sample_weights(density, delta)
        return weights, composite(weights, color.reshape(*t.shape, 3), background), (density, delta)


def _evaluate(
    field: NeRFField,
    positions: Tensor,
    directions: Tensor,
    ray_indices: Tensor | None,
    noise: Tensor | None,
    uniform: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """What the field returns; with a number from [0, 1) for every sample, the gradients of the hard samples only."""
    if uniform is None:
        return field(positions, directions, ray_indices, noise)
    return evaluate_hard_samples(field, positions, directions, ray_indices, noise, uniform)
