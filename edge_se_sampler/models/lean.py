"""The lean model: one small network on a grid of features, evaluated only where the scene is.

h       size of a cell at level 0, world units
sigma   exp(raw) / h, density: independent of the scene's scale, and never 0, so that no network can die
"""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.models.config import LeanModelConfig
from edge_se_sampler.models.field import encoded_size, initialize_linear, linear, positional_encoding
from edge_se_sampler.models.packed_rendering import (
    accumulate_along_rays,
    expand_to_samples,
    render_packed,
    transmittance,
)
from edge_se_sampler.models.ray_model import ParameterGroup, RayModel
from edge_se_sampler.occupancy.features import FeatureGrid
from edge_se_sampler.occupancy.grid import MAX_OCCUPIED_CELLS, OccupancyGrid, dilate, upsample

DENSITY_BIAS = -1.0
"""Raw density at first: thin enough to see through the object, dense enough to have a gradient. In an uncarved box it
would be an opaque fog: there, the box has an optical depth of 1 across."""
UPDATE_INTERVAL = 128
"""Steps between prunings: long enough for the cells to be seen. Half as many as long as the cells may be subdivided."""
ALPHA_THRESHOLD = 0.01
"""Opacity of a cell of the finest level below which it counts as empty."""
MIN_OPTICAL_DEPTH = 0.5
"""Optical depth above which a cell counts as surface; while no cell of a grid that may be subdivided has it, pruning is
suspended."""


class LeanField(nn.Module):
    """Position, features and direction -> density and color. `rng` draws the initial weights."""

    def __init__(self, config: LeanModelConfig, rng: np.random.Generator) -> None:
        super().__init__()
        preset = config.preset
        self.position_frequencies = preset.position_frequencies
        self.direction_frequencies = preset.direction_frequencies
        width, in_dim = preset.width, encoded_size(3, preset.position_frequencies) + config.feature_dim
        self.layers = nn.ModuleList(linear(width if i else in_dim, width) for i in range(preset.depth))
        self.density = linear(width, 1)
        self.view = linear(width + encoded_size(3, self.direction_frequencies), width)
        self.color = linear(width, 3)
        initialize_linear(self, config.initialization, rng)

    def forward(
        self, positions: Tensor, features: Tensor, directions: Tensor, ray_starts: Tensor, ray_indices: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Raw density (m,) and color (m, 3) in [0, 1] of packed samples (`Samples`).

        Args:
            positions: (m, 3), -1 .. 1 along the longest edge of the box.
            features: (m, F).
            directions: (n, 3) unit.
        """
        h = torch.cat((positional_encoding(positions, self.position_frequencies), features), dim=1)
        for layer in self.layers:
            h = F.relu(layer(h), inplace=True)
        width = h.shape[1]
        encoded = positional_encoding(directions, self.direction_frequencies)
        per_ray = F.linear(encoded, self.view.weight[:, width:], self.view.bias)
        seen = F.linear(h, self.view.weight[:, :width]) + expand_to_samples(per_ray, ray_starts, ray_indices)
        seen = F.relu(seen, inplace=True)
        return self.density(h)[:, 0] + DENSITY_BIAS, torch.sigmoid(self.color(seen))


class LeanModel(RayModel):
    """One network, evaluated in the grid's occupied cells alone; features lie at their corners. Training prunes and
    subdivides them. `rng` draws the initial weights."""

    config: LeanModelConfig
    grid: OccupancyGrid

    def __init__(self, config: LeanModelConfig, rng: np.random.Generator, grid: OccupancyGrid) -> None:
        super().__init__(config, grid)
        self.fine = LeanField(config, rng)
        box = grid.static_mask_at(0)[1:-1, 1:-1, 1:-1]  # without the rim
        if box.float().mean() > 0.9:  # uncarved: the object may be anywhere
            with torch.no_grad():
                self.fine.density.bias.sub_(math.log(max(box.shape)) + DENSITY_BIAS)
        self.features = FeatureGrid(grid, config.feature_dim) if config.feature_dim else None

    @property
    def rays_per_chunk(self) -> int:
        return 4096

    def parameter_groups(self) -> list[ParameterGroup]:
        if self.features is None:
            return super().parameter_groups()
        # the features learn faster than the network: each sees few samples
        network, table = list(self.fine.parameters()), [self.features.table]
        return [ParameterGroup(network), ParameterGroup(table, self.config.feature_lr_scale)]

    def begin_step(self, step: int, seed: int) -> None:
        """As `RayModel`; at intervals, prunes and subdivides the grid."""
        super().begin_step(step, seed)
        grid = self.grid
        if not self.config.prunes_cells:
            return
        subdivisible = bool(grid.level < grid.max_level)
        interval = UPDATE_INTERVAL // 2 if subdivisible else UPDATE_INTERVAL
        if step < interval or step % interval:
            return
        surface = grid.max_density * grid.cell_size > MIN_OPTICAL_DEPTH
        if step == interval or (subdivisible and not surface.any()):  # the first densities mean nothing
            grid.max_density.zero_()
            return
        fraction = 0.02 / 2 ** int(grid.level)  # of the empty cells; a level has eight times those of the one before
        reactivated = torch.rand(grid.occupied.shape, generator=self.random, device=self.device) < fraction
        min_density = -math.log1p(-ALPHA_THRESHOLD) / float(grid.initial_cell_size / 2**grid.max_level)
        dense = grid.prune(min_density, reactivated)
        self._refine(dense, surface)

    def _refine(self, dense: Tensor, surface: Tensor) -> None:
        """Subdivide the grid, at level 0 always, later when its cells are few enough; else refine surface cells that
        pruning had missed, if they are above 1 % of all. Both (X, Y, Z) bool: cells that pruning has kept, and those
        that count as surface."""
        grid, features, level = self.grid, self.features, int(self.grid.level)
        if level < grid.max_level and (level == 0 or 8 * dense.sum() <= MAX_OCCUPIED_CELLS):
            grid.subdivide() if features is None else features.refine(upsample(dense) & grid.static_mask_at(level + 1))
        elif features is not None and level:
            missed = surface & ~grid.refined
            refined = grid.refined | (dilate(missed) & grid.static_mask)
            if missed.sum() > 0.01 * surface.sum() and refined.sum() <= MAX_OCCUPIED_CELLS:
                features.refine(refined)

    def forward(self, rays: RayBundle) -> dict[str, Tensor]:
        """As `RayModel`; depth_fine in evaluation alone."""
        grid = self.grid
        step = self.config.step_size_voxels * float(grid.cell_size)
        jitter = self.uniform(len(rays), 1) if self.training else None
        samples = grid.march(rays, step, jitter, (self.config.near, self.config.far))
        positions = samples.positions
        features = positions[:, :0] if self.features is None else self.features(positions, samples.cell_indices)
        centered = (positions - grid.center) / grid.half_extent
        raw, color = self.fine(centered, features, rays.directions, samples.ray_starts, samples.ray_indices)
        density = torch.exp(raw.clamp(max=8)) / float(grid.initial_cell_size)  # more is as opaque
        if self.training and self.config.prunes_cells:
            grid.update_max_density(samples, density)
        rgb, accumulation = render_packed(density, color, step, samples.ray_starts, samples.ray_indices)
        background = self.get_background(rays)
        outputs = {"rgb_fine": rgb + (1 - accumulation) * background, "accumulation_fine": accumulation}
        if not self.training:
            tau = density * step
            weight = transmittance(tau, samples.ray_starts, samples.ray_indices) * -torch.expm1(-tau)
            far = self.config.far * rays.metadata["directions_norm"]
            depth = accumulate_along_rays((weight * samples.t)[:, None], samples.ray_starts)
            outputs["depth_fine"] = depth + (1 - accumulation) * far
        return outputs | {"background": background}
