"""The lean model: one small network on features kept where the scene is.

h       side of a cell before any split, world units
sigma   exp(raw) / h: of its own scale, never 0, so that no network can die
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.models.config import LeanModelConfig
from edge_se_sampler.models.encoding import encoded_size, positional_encoding
from edge_se_sampler.models.field import initialize_all, linear
from edge_se_sampler.models.packed_rendering import (
    accumulate_along_rays,
    expand_to_samples,
    render_packed,
    transmittance,
)
from edge_se_sampler.models.ray_model import RayModel
from edge_se_sampler.occupancy.features import FeatureGrid
from edge_se_sampler.occupancy.grid import MAX_OCCUPIED_CELLS, OccupancyGrid, dilate, upsample

RAYS_PER_CHUNK = 4096
DENSITY_BIAS = -1.0
"""Raw density at first: thin enough to see the middle of the object, dense enough to have a gradient. In a box of which
nothing is known it would be an opaque fog: there, the box has an optical depth of 1 across. (Bricks without alpha, seed
2: after 15 CPU seconds 13.8 and 27.9 dB.)"""
UNCARVED_FRACTION = 0.9
"""Share of a box's cells from which on nothing is known of it."""
MAX_LOG_DENSITY = 8.0
"""Raw density above which a cell is opaque whatever it is."""
UPDATE_INTERVAL = 128
"""Steps in which cells are seen long enough to be judged; half as many do as long as they are large. What was seen in
the first does not count: densities mean nothing yet."""
ALPHA_THRESHOLD = 0.01
"""Of the smallest cell that there may be: below, it is taken to be empty."""
MIN_OPTICAL_DEPTH = 0.5
"""Optical depth of a cell that holds something, rather than haze. As long as there is none in a box of which nothing
was known, nothing is learnt, and nothing judged."""
REACTIVATION_FRACTION = 0.02
"""Share of the empty cells that are tried again until the next judgement; half of it after each split, for there are
eight times as many, and one of them is enough to find what was missed."""
MISJUDGED = 0.01
"""Solid cells beside those that were split, as a share of all, from which on they get corners of their own, too."""


class LeanField(nn.Module):
    """Position, features and direction -> density and colour.

    Args:
        config: resolved, without None.
        rng: of the initial weights.
    """

    def __init__(self, config: LeanModelConfig, rng: np.random.Generator) -> None:
        super().__init__()
        self.position_frequencies = config.position_frequencies or 0
        self.direction_frequencies = config.direction_frequencies or 0
        width, depth = config.width or 0, config.depth or 0
        first = encoded_size(3, self.position_frequencies) + config.feature_dim
        self.layers = nn.ModuleList(linear(width if i else first, width) for i in range(depth))
        self.density = linear(width, 1)
        self.view = linear(width + encoded_size(3, self.direction_frequencies), width)
        self.color = linear(width, 3)
        initialize_all(self, config.initialization, rng)

    def forward(
        self, positions: Tensor, features: Tensor, directions: Tensor, ray_starts: Tensor, ray_indices: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Evaluate packed samples.

        Args:
            positions: (m, 3), -1 .. 1 along the longest edge of the box.
            features: (m, F).
            directions: (n, 3) unit.
            ray_starts, ray_indices: (n,) and (m,) int64, see `Samples`.

        Returns:
            raw density (m,), colour (m, 3) in [0, 1].
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
    """One network, asked in occupied cells alone. `settle` gives it its cells and features.

    Args:
        config: resolved, without None.
        rng: of the initial weights.
    """

    config: LeanModelConfig

    def __init__(self, config: LeanModelConfig, rng: np.random.Generator) -> None:
        super().__init__(config)
        self.fine = LeanField(config, rng)
        self.features: FeatureGrid | None = None
        """None where the network is to do without."""

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return self.fine.density.weight.device

    def chunks(self, rays: int) -> Iterator[slice]:
        """Rows of that many rays, as many at a time as are worth rendering at once."""
        return (slice(start, start + RAYS_PER_CHUNK) for start in range(0, rays, RAYS_PER_CHUNK))

    @property
    def needs_cells(self) -> bool:
        """Always: it has features in them."""
        return True

    def settle(self, grid: OccupancyGrid) -> None:
        """Features at the corners of the grid's cells, and a density to begin with."""
        super().settle(grid)
        inside = grid.possible[1:-1, 1:-1, 1:-1]
        if inside.float().mean() > UNCARVED_FRACTION:
            with torch.no_grad():
                self.fine.density.bias.sub_(math.log(max(inside.shape)) + DENSITY_BIAS)
        if self.config.feature_dim:
            self.features = FeatureGrid(grid, self.config.feature_dim).to(self.device, self.dtype)

    def parameter_groups(self) -> list[tuple[list[nn.Parameter], float]]:
        """The features learn faster: each sees few samples."""
        if self.features is None:
            return super().parameter_groups()
        return [(list(self.fine.parameters()), 1.0), ([self.features.table], self.config.feature_lr_scale)]

    def begin_step(self, step: int, seed: int) -> None:
        """As `RayModel`; now and then, cells that have shown no density are left out."""
        super().begin_step(step, seed)
        grid = self.grid
        if grid is None or not self.config.learns_cells:
            return
        large = bool(grid.splits[1])
        every = UPDATE_INTERVAL // 2 if large else UPDATE_INTERVAL
        if step < every or step % every:
            return
        solid = grid.largest * grid.side > MIN_OPTICAL_DEPTH
        if step == every or (large and not solid.any()):
            grid.largest.zero_()
            return
        share = REACTIVATION_FRACTION / 2 ** int(grid.splits[0])
        again = torch.rand(grid.occupied.shape, generator=self.random, device=self.device) < share
        kept = grid.judge(-math.log1p(-ALPHA_THRESHOLD) / float(grid.finest_side), again)
        self._refine(grid, kept, solid)

    def _refine(self, grid: OccupancyGrid, kept: Tensor, solid: Tensor) -> None:
        """Split the cells that are kept, at first and then once they are few enough; later, see to those left out by
        mistake.

        Args:
            kept, solid: (X, Y, Z) bool.
        """
        features = self.features
        done, left = grid.splits.tolist()
        if left and (done == 0 or 8 * kept.sum() <= MAX_OCCUPIED_CELLS):
            grid.split() if features is None else features.own(upsample(kept) & grid.possible_after(done + 1))
        elif features is not None and done:
            missed = solid & ~features.owned
            owned = features.owned | (dilate(missed) & grid.possible)
            if missed.sum() > MISJUDGED * solid.sum() and owned.sum() <= MAX_OCCUPIED_CELLS:
                features.own(owned)

    def forward(self, rays: RayBundle) -> dict[str, Tensor]:
        """As `RayModel`."""
        grid = self.grid
        assert grid is not None, "settle comes first"
        step = self.config.step_size_voxels * float(grid.side)
        jitter = self.uniform(len(rays), 1) if self.training else None
        samples = grid.march(rays, step, jitter, (self.config.near, self.config.far))
        positions = samples.positions
        features = positions[:, :0] if self.features is None else self.features(positions, samples.cell_indices)
        centered = (positions - grid.middle) / grid.reach
        raw, color = self.fine(centered, features, rays.directions, samples.ray_starts, samples.ray_indices)
        density = torch.exp(raw.clamp(max=MAX_LOG_DENSITY)) / float(grid.first_side)
        if self.training and self.config.learns_cells:
            grid.remember(samples, density)
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
