"""The radiance field (NeRF, figure 7): position and direction -> density and color.

m   points that are evaluated, packed: point i lies on ray ray_indices[i]
n   rays; what depends on the direction alone is computed once for each
L   number of frequencies that encode a vector, 2^0 .. 2^(L-1); as in NeRF's code, without its paper's factor pi
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from edge_se_sampler.models.config import NeRFModelConfig

SKIP_LAYER = 5
"""Number of the layer, from 0, that takes the encoded position again (a skip connection)."""


class NeRFField(nn.Module):
    """The MLP: `depth` layers for the position, one more for the direction. `rng` draws the initial weights."""

    def __init__(self, config: NeRFModelConfig, rng: np.random.Generator) -> None:
        super().__init__()
        preset, width = config.preset, config.preset.width
        self.position_frequencies = preset.position_frequencies
        self.direction_frequencies = preset.direction_frequencies
        self.softplus = config.density_activation == "softplus"
        encoded = encoded_size(3, self.position_frequencies)
        in_sizes = [encoded] + [width + encoded if i == SKIP_LAYER else width for i in range(1, preset.depth)]
        self.layers = nn.ModuleList(linear(in_size, width) for in_size in in_sizes)
        self.density = linear(width, 1)
        self.feature = linear(width, width)
        self.view = linear(width + encoded_size(3, self.direction_frequencies), width // 2)
        self.color = linear(width // 2, 3)
        initialize_linear(self, config.initialization, rng)

    def forward(self, positions: Tensor, directions: Tensor, ray_indices: Tensor | None, noise: Tensor | None = None):
        """Evaluate points.

        Args:
            positions: (m, 3).
            directions: (n, 3) unit.
            ray_indices: (m,) int64; None: the points are all samples of ray 0, then all of ray 1, ...
            noise: (m,) added to the raw density, or None.

        Returns:
            density (m,) >= 0, color (m, 3) in [0, 1].
        """
        encoded = positional_encoding(positions, self.position_frequencies)
        h = encoded
        for i, layer in enumerate(self.layers):
            h = torch.cat((encoded, h), dim=1) if i == SKIP_LAYER else h
            h = F.relu(layer(h), inplace=True)
        raw = self.density(h)[:, 0]
        raw = raw if noise is None else raw + noise
        density = F.softplus(raw - 1) if self.softplus else F.relu(raw)

        # the layer of the direction, on (feature, encoded direction): its second half is computed once a ray
        width, encoded = h.shape[1], positional_encoding(directions, self.direction_frequencies)
        per_ray = F.linear(encoded, self.view.weight[:, width:], self.view.bias)
        h = F.linear(self.feature(h), self.view.weight[:, :width])
        if ray_indices is None:
            samples = len(h) // max(1, len(directions))
            h = (h.reshape(len(directions), samples, h.shape[1]) + per_ray[:, None]).reshape(h.shape)
        else:
            h = h + per_ray[ray_indices]
        return density, torch.sigmoid(self.color(F.relu(h, inplace=True)))


def encoded_size(dimensions: int, frequencies: int) -> int:
    """Length of the encoding of a d-vector: d (1 + 2L)."""
    return dimensions * (1 + 2 * frequencies)


def positional_encoding(x: Tensor, frequencies: int) -> Tensor:
    """(..., d) -> (..., d (1 + 2L)): x itself, then all sines, then all cosines (NeRF, equation 4)."""
    scale = 2.0 ** torch.arange(frequencies, dtype=x.dtype, device=x.device)
    angles = (x[..., None, :] * scale[:, None]).flatten(-2)
    return torch.cat((x, torch.sin(angles), torch.cos(angles)), dim=-1)


def linear(in_size: int, out_size: int) -> nn.Linear:
    """A layer without initial weights: torch would draw them from its global generator."""
    layer = nn.utils.skip_init(nn.Linear, in_size, out_size)
    assert isinstance(layer, nn.Linear)
    return layer


@torch.no_grad()
def initialize_linear(module: nn.Module, scheme: str, rng: np.random.Generator) -> None:
    """Draw the initial weights of a module's linear layers. Scheme "xavier": uniform in +-sqrt(6 / (in + out)), zero
    bias, as the original TensorFlow NeRF; "torch": weight and bias uniform in +-1 / sqrt(in), as its PyTorch ports."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            out_size, in_size = layer.weight.shape
            bound = (6 / (in_size + out_size)) ** 0.5 if scheme == "xavier" else in_size**-0.5
            layer.weight.copy_(torch.from_numpy(rng.uniform(-bound, bound, (out_size, in_size))))
            layer.bias.zero_()
            if scheme == "torch":
                layer.bias.copy_(torch.from_numpy(rng.uniform(-bound, bound, out_size)))
