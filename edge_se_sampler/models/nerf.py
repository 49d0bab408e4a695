"""The original NeRF: rays -> colours, by a coarse and a fine network."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.models.config import NeRFModelConfig
from edge_se_sampler.models.field import NeRFField
from edge_se_sampler.models.ray_model import RayModel
from edge_se_sampler.models.ray_samples import importance, stratified
from edge_se_sampler.models.rendering import composite, intervals, sample_weights
from edge_se_sampler.occupancy.grid import OccupancyGrid

POINTS_PER_CHUNK = {"cpu": 2**14, "cuda": 2**19}
"""Network evaluations rendered at once, by device: it bounds the memory. Each chunk draws its own jitter, so another
value gives another (equally good) training run."""


class NeRFModel(RayModel):
    """Coarse and fine networks, stratified and importance samples.

    Args:
        config: resolved, without None.
        rng: of the initial weights.
    """

    networks = ("coarse", "fine")

    def __init__(self, config: NeRFModelConfig, rng: np.random.Generator) -> None:
        super().__init__(config)
        self.config = config
        self.coarse = NeRFField(config, rng)
        self.fine = NeRFField(config, rng)
        self.occupied: Callable[[Tensor], Tensor] | None = None
        """Positions (m, 3) -> (m,) bool; where False, the density is 0 and no network is asked. None: everywhere."""

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return self.coarse.density.weight.device

    def chunks(self, rays: int) -> Iterator[slice]:
        """Rows of that many rays, as many at a time as are worth rendering at once."""
        points = 2 * (self.config.num_coarse_samples or 0) + (self.config.num_importance_samples or 0)
        size = max(1, POINTS_PER_CHUNK.get(self.device.type, 2**14) // points)
        return (slice(start, start + size) for start in range(0, rays, size))

    def settle(self, grid: OccupancyGrid) -> None:
        """Ask both networks only in the grid's cells from now on."""
        super().settle(grid)
        self.occupied = grid.contains

    def forward(self, rays: RayBundle) -> dict[str, Tensor]:
        """As `RayModel`; and density_fine, delta_fine (n, s) of the fine network's samples."""
        t, weights, rgb, background = self._coarse(rays)
        outputs = {"rgb_coarse": rgb, "accumulation_coarse": weights.sum(1, keepdim=True), "background": background}

        t = torch.sort(torch.cat((t, self._importance(t, weights.detach())), dim=1)).values
        weights, rgb, samples = self._render(self.fine, rays, t, background)
        accumulation = weights.sum(1, keepdim=True)
        depth = (weights * t).sum(1, keepdim=True) + (1 - accumulation) * t[:, -1:]
        fine = {"rgb_fine": rgb, "accumulation_fine": accumulation, "depth_fine": depth}
        return outputs | fine | dict(zip(("density_fine", "delta_fine"), samples, strict=True))

    def coarse_squared_error(self, rays: RayBundle, image: Tensor) -> Tensor:
        """(n,) `squared_error` of the coarse colours, without asking the fine network."""
        _, _, rgb, background = self._coarse(rays)
        return self.squared_error({"rgb_coarse": rgb, "background": background}, image, "coarse")

    def _coarse(self, rays: RayBundle) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Of the coarse network: t and weights of its samples (n, s), colours, and backgrounds (n, 3)."""
        config, count = self.config, len(rays)
        samples = config.num_coarse_samples or 0
        norm = rays.metadata["directions_norm"]
        jitter = self.uniform(count, samples) if self.training else None
        t = stratified(config.near * norm, config.far * norm, samples, jitter)
        background = self.get_background(rays)
        weights, rgb, _ = self._render(self.coarse, rays, t, background)
        return t, weights, rgb, background

    def _importance(self, t: Tensor, weights: Tensor) -> Tensor:
        count = self.config.num_importance_samples or 0
        if self.training:
            uniform = self.uniform(len(t), count)
        else:
            uniform = torch.linspace(0, 1, count, dtype=t.dtype, device=t.device).expand(len(t), count)
        return importance((t[:, 1:] + t[:, :-1]) / 2, weights[:, 1:-1], uniform)

    def _render(
        self, field: NeRFField, rays: RayBundle, t: Tensor, background: Tensor
    ) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
        """Weights (n, s) and colours (n, 3) of rays sampled at t (n, s), and density and interval of each sample."""
        positions = (rays.origins[:, None] + t[..., None] * rays.directions[:, None]).reshape(-1, 3)
        noise = self._noise(t.numel())
        if self.occupied is None:
            density, color = field(positions, rays.directions, None, noise)
        else:
            packed = torch.nonzero(self.occupied(positions))[:, 0]
            ray = torch.div(packed, t.shape[1], rounding_mode="floor")
            noise = None if noise is None else noise[packed]
            some_density, some_color = field(positions[packed], rays.directions, ray, noise)
            density = t.new_zeros(t.numel()).index_put((packed,), some_density)
            color = t.new_zeros((t.numel(), 3)).index_put((packed,), some_color)
        # a softplus is never 0: over an endless interval it would hide every background
        delta = intervals(t, endless=self.config.density_activation == "relu")
        density = density.reshape(t.shape)
        weights = sample_weights(density, delta)
        return weights, composite(weights, color.reshape(*t.shape, 3), background), (density, delta)

    def _noise(self, count: int) -> Tensor | None:
        """(count,) noise on the raw density, in training only."""
        if not (self.training and self.config.density_noise):
            return None
        dtype = self.coarse.density.weight.dtype
        standard = torch.randn(count, generator=self.random, device=self.device, dtype=dtype)
        return standard * self.config.density_noise
