"""Rays through a `BrickGrid`: samples, values at them, and their colors. Plain torch, on any device; the reference of
`voxel_kernels`, which has the same functions for a CPU.

n      rays
m      samples, of all rays one after the other
c      colored samples: those of the m whose weight in their ray's color is worth asking the network
tau    optical depth of a sample: density times step
T      transmittance: share of the light that passes all samples before one
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from edge_se_sampler.devices import has_float64
from edge_se_sampler.occupancy.bricks import BRICK, OFFSETS, BrickGrid, pack_bits

NUM_HARMONICS = 16
"""Spherical harmonics up to degree 3."""


@dataclass(frozen=True)
class Marching:
    """How rays are sampled."""

    step: float
    """Distance between samples, in sides of a cell."""
    density_scale: float
    """tau of a sample is this times exp of its raw density."""
    alpha_min: float
    """Samples of less opacity are left out."""
    weight_min: float
    """Samples of less weight have no color: black, at their full opacity."""
    transmittance_min: float
    """A ray ends where less light passes."""
    visible_min: float
    """Densities of samples that less light reaches have no gradient."""

    @property
    def density_min(self) -> float:
        """Raw density of samples that are left out."""
        return math.log(-math.log1p(-self.alpha_min) / self.density_scale) if self.alpha_min else -math.inf


@dataclass(frozen=True)
class RaySpans:
    """n rays in units of cells, and the part of each in the box and between the depths."""

    origins: Tensor  # (n, 3)
    directions: Tensor  # (n, 3) unit vectors
    begin: Tensor  # (n,)
    end: Tensor  # (n,)


@dataclass(frozen=True)
class Samples:
    """Samples of n rays."""

    t: Tensor
    """(m,) distance from the ray's origin, in sides of a cell."""
    ray_indices: Tensor
    """(m,) int64."""
    rows: Tensor
    """(m, 8) int32: rows of the corners of its cell, the first being the cell's own."""
    weights: Tensor
    """(m, 8): their shares in what is interpolated."""
    colored: Tensor
    """(c,) int64: which samples have a color."""
    visible: Tensor
    """(m,) bool: which samples' densities have a gradient."""


@dataclass(frozen=True)
class Rendered:
    """n rays in front of black."""

    rgb: Tensor
    """(n, 3)."""
    accumulation: Tensor
    """(n, 1) opacity."""
    distance: Tensor
    """(n, 1): weights times distances of all samples, in sides of a cell; without a gradient."""
    cells: Tensor
    """(c,) int64: rows of the cells of samples that have a color; kernels leave it empty where nothing is trained."""
    weights: Tensor
    """(c,): weights of those in their ray's color; without a gradient."""


def render(
    grid: BrickGrid, density: Tensor, features: Tensor, network: NetworkWeights,
    spans: RaySpans, jitter: Tensor | None, marching: Marching,
) -> Rendered:  # fmt: skip
    """Colors of n rays (NeRF, equation 3).

    Args:
        density: (64 K, 1) raw density at the corners; its gradient is sparse.
        features: (64 K, F) at the corners; their gradient is sparse, and has the same rows.
        jitter: (n,) in [0, 1): share of a step before the first sample; None: half a step.
    """
    num_rays, samples = len(spans.begin), march(grid, density, spans, jitter, marching)
    colored = samples.colored
    tau = torch.exp(interpolate(density, samples.rows, samples.weights)[:, 0]) * marching.density_scale
    tau = torch.where(samples.visible, tau, tau.detach())
    values = interpolate(features, samples.rows, samples.weights)[colored]
    color = shade(values, spans.directions, samples.ray_indices[colored], network)
    rgb, accumulation, weights = composite(tau, color, samples, num_rays)
    distance = torch.zeros_like(accumulation)
    distance.index_add_(0, samples.ray_indices, (samples.t * weights)[:, None])
    return Rendered(rgb, accumulation, distance, samples.rows[colored, 0].long(), weights[colored])


def march(grid: BrickGrid, density: Tensor, spans: RaySpans, jitter: Tensor | None, marching: Marching) -> Samples:
    """The samples of rays in the cells that are sampled, as far as light passes; see `render`."""
    begin, end = spans.begin[:, None], spans.end[:, None]
    count = int(((end - begin).clamp(min=0).max() / marching.step).ceil()) + 1 if len(begin) else 0
    offsets = torch.arange(count, device=begin.device, dtype=begin.dtype)
    t = begin + (offsets + (0.5 if jitter is None else jitter[:, None])) * marching.step
    ray, index = torch.nonzero(t < end, as_tuple=True)
    position = spans.origins[ray] + t[ray, index][:, None] * spans.directions[ray]
    cell = position.floor().long()
    inside = ((cell >= 0) & (cell < grid.size)).all(dim=1)
    ray, index, position, cell = ray[inside], index[inside], position[inside], cell[inside]
    brick = grid.table[tuple((cell // BRICK).T)].long()
    in_brick = (cell % BRICK * torch.tensor([BRICK * BRICK, BRICK, 1], device=cell.device)).sum(dim=1)
    sampled = (brick >= 0) & ((grid.sampled[brick.clamp(min=0)] >> in_brick) & 1 > 0)
    ray, index, brick, in_brick = ray[sampled], index[sampled], brick[sampled], in_brick[sampled]
    rows = grid.corner_rows(brick, in_brick)
    weights = corner_weights(position[sampled] - cell[sampled])
    raw = interpolate(density.detach(), rows, weights)[:, 0]
    alpha = 1 - torch.exp(-torch.exp(raw) * marching.density_scale)
    opaque = raw > marching.density_min
    transmittance = torch.ones_like(t)
    transmittance[ray, index] = torch.where(opaque, 1 - alpha, 1.0)
    transmittance = torch.cat((torch.ones_like(begin), transmittance.cumprod(dim=1)), dim=1)[ray, index]
    kept = opaque & (transmittance >= marching.transmittance_min)
    colored = torch.nonzero((transmittance * alpha > marching.weight_min)[kept])[:, 0]
    visible = (transmittance >= marching.visible_min)[kept]
    return Samples(t[ray, index][kept], ray[kept], rows[kept].int(), weights[kept], colored, visible)


def find_dense_cells(grid: BrickGrid, density: Tensor, least: float) -> Tensor:
    """Occupied cells with a corner of more than that raw density (64 K, 1): (K,) int64, a bit for each of a brick's."""
    dense = torch.zeros_like(grid.occupied)
    for some in torch.arange(len(grid.bricks), device=density.device).split(2**13):
        brick, cell = torch.nonzero(grid.occupied[some], as_tuple=True)
        rows = grid.corner_rows(some[brick], cell)
        dense[some[brick], cell] = density.detach()[rows, 0].amax(dim=1) > least
    return pack_bits(dense)


def corner_weights(fraction: Tensor) -> Tensor:
    """(m, 8) shares of a cell's corners at positions (m, 3) in it, in [0, 1)."""
    (x, y, z), (u, v, w) = fraction.unbind(dim=1), (1 - fraction).unbind(dim=1)
    uv, uy, xv, xy = u * v, u * y, x * v, x * y
    return torch.stack((uv * w, uv * z, uy * w, uy * z, xv * w, xv * z, xy * w, xy * z), dim=1)


def interpolate(values: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """(m, F) of values (64 K, F) at the corners, by rows and weights (m, 8). The gradient of the values is sparse."""
    return (F.embedding(rows.long(), values, sparse=True) * weights[:, :, None]).sum(dim=1)


@dataclass(frozen=True)
class NetworkWeights:
    """A network of one hidden layer of H neurons: features and spherical harmonics of the direction -> color."""

    hidden: Tensor  # (F, H)
    view: Tensor  # (16, H)
    view_bias: Tensor  # (H,)
    color: Tensor  # (3, H)
    color_bias: Tensor  # (3,)


def shade(features: Tensor, directions: Tensor, ray_indices: Tensor, weights: NetworkWeights) -> Tensor:
    """Colors (c, 3) in [0, 1] of features (c, F), on rays ray_indices (c,), ascending, of unit directions (n, 3)."""
    view = torch.addmm(weights.view_bias, spherical_harmonics(directions), weights.view)
    hidden = F.relu(features @ weights.hidden + view.index_select(0, ray_indices))
    return torch.sigmoid(F.linear(hidden, weights.color, weights.color_bias))


def spherical_harmonics(directions: Tensor) -> Tensor:
    """(n, 16) real spherical harmonics up to degree 3 of unit vectors (n, 3)."""
    x, y, z = directions.unbind(dim=1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        (
            torch.full_like(x, 0.28209479),
            -0.48860251 * y,
            0.48860251 * z,
            -0.48860251 * x,
            1.09254843 * x * y,
            -1.09254843 * y * z,
            0.31539157 * (2 * zz - xx - yy),
            -1.09254843 * x * z,
            0.54627421 * (xx - yy),
            -0.59004359 * y * (3 * xx - yy),
            2.89061144 * x * y * z,
            -0.45704579 * y * (4 * zz - xx - yy),
            0.37317633 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.45704579 * x * (4 * zz - xx - yy),
            1.44530572 * z * (xx - yy),
            -0.59004359 * x * (xx - 3 * yy),
        ),
        dim=1,
    )


def composite(tau: Tensor, color: Tensor, samples: Samples, num_rays: int) -> tuple[Tensor, Tensor, Tensor]:
    """Colors (n, 3), accumulated opacity (n, 1) and weights (m,), without a gradient, by tau (m,) and the color (c, 3)
    of colored samples (NeRF, equation 3)."""
    before, total = sum_along_rays(tau, samples.ray_indices, num_rays)
    weight = (torch.exp(-before) * -torch.expm1(-tau.to(before.dtype))).to(tau.dtype)
    of_colored = weight[samples.colored, None]
    rgb = tau.new_zeros((num_rays, 3)).index_add(0, samples.ray_indices[samples.colored], of_colored * color)
    return rgb, -torch.expm1(-total)[:, None].to(tau.dtype), weight.detach()


def sum_along_rays(tau: Tensor, ray_indices: Tensor, num_rays: int) -> tuple[Tensor, Tensor]:
    """Sums of tau (m,) over the samples before each on its ray, (m,), and over rays, (n,); by ray_indices (m,),
    ascending. In float64, where the device has it."""
    if has_float64(tau.device):
        total = torch.zeros(num_rays, dtype=torch.float64, device=tau.device)
        total = total.index_add(0, ray_indices, tau.double())
        return tau.double().cumsum(0) - tau - (total.cumsum(0) - total)[ray_indices], total
    # float32 cannot hold a ray's part of the sum over all: a row for each ray
    count = torch.bincount(ray_indices, minlength=num_rays)
    column = torch.arange(len(tau), device=tau.device) - (count.cumsum(0) - count)[ray_indices]
    sums = tau.new_zeros((num_rays, 1 + (int(count.max()) if num_rays else 0)))
    sums = sums.index_put((ray_indices, column + 1), tau).cumsum(dim=1)
    return sums[ray_indices, column], sums[:, -1]


def resample(bricks: Tensor, ratio: float, parents: Tensor, values: Tensor) -> Tensor:
    """Values (64 K, F) at the corners of cells, interpolated between the corners of larger cells, as far as these are
    stored.

    Args:
        bricks: (K, 3) int64: positions of the bricks, in bricks.
        ratio: size of the cells, as a part of that of the larger ones.
        parents: `BrickGrid.numbers` of the larger cells.
        values: (64 K', F) at the corners of the larger cells.
    """
    cells = torch.cartesian_prod(*[torch.arange(BRICK, device=bricks.device)] * 3)
    strides = torch.tensor([BRICK * BRICK, BRICK, 1], device=bricks.device)
    chunks = []
    for some in bricks.split(2**13):
        position = (BRICK * some[:, None] + cells).reshape(-1, 3) * ratio
        cell = position.long()
        share = corner_weights(position - cell)
        around = cell[:, None] + OFFSETS.to(bricks.device)
        parent = parents[tuple((around // BRICK).unbind(dim=2))].long()
        row = 64 * parent + (around % BRICK * strides).sum(dim=2)
        share = (share * (parent >= 0)).to(values.dtype)
        share = share / share.sum(dim=1, keepdim=True).clamp(min=1e-6)
        chunks.append((values[row.clamp(min=0)] * share[:, :, None]).sum(dim=1))
    return torch.cat(chunks)


def adam_rows(
    values: Tensor, mean: Tensor, square: Tensor, gradient: Tensor,
    *, lr: float, betas: tuple[float, float], eps: float, maximum: float, total_variation: float,
) -> None:  # fmt: skip
    """A step of Adam without bias correction on those rows of values (64 K, F) that a sparse gradient has.

    Args:
        mean: (64 K, F) running mean of the gradients.
        square: (64 K, 1) running mean of their squares, over the F values, too: less memory, the same result.
        maximum: what values become at most.
        total_variation: weight of the squared differences to neighbors in the same brick, half of which each row adds
            to the loss.
    """
    gradient = gradient.coalesce()
    rows, gradient = gradient.indices()[0], gradient.values()
    if total_variation:
        gradient = gradient + total_variation * difference_to_neighbors(values, rows)
    mean[rows] = torch.lerp(gradient, mean[rows], betas[0])
    square[rows] = torch.lerp(gradient.square().mean(dim=1, keepdim=True), square[rows], betas[1])
    values[rows] = (values[rows] - lr * mean[rows] / (square[rows].sqrt() + eps)).clamp(max=maximum)


def difference_to_neighbors(values: Tensor, rows: Tensor) -> Tensor:
    """Sum over a row's up to six neighbors in its brick of values[row] - values[neighbor], (k, F) for rows (k,)."""
    total = torch.zeros_like(values[rows])
    for stride in (1, BRICK, BRICK * BRICK):
        position = rows // stride % BRICK
        for offset, inside in ((stride, position < BRICK - 1), (-stride, position > 0)):
            neighbors = torch.where(inside, rows + offset, rows)
            total += values[rows] - values[neighbors]
    return total
