"""Positional encoding (NeRF, equation 4): a point -> its sines and cosines at doubling frequencies.

x    (..., d)
L    number of frequencies, 2^0 .. 2^(L-1); as in NeRF's code, without its paper's factor pi
"""

from __future__ import annotations

import torch
from torch import Tensor


def encoded_size(dimensions: int, frequencies: int) -> int:
    """Length of the encoding of a d-vector: d (1 + 2L)."""
    return dimensions * (1 + 2 * frequencies)


def positional_encoding(x: Tensor, frequencies: int) -> Tensor:
    """(..., d) -> (..., d (1 + 2L)): x itself, then all sines, then all cosines."""
    scale = 2.0 ** torch.arange(frequencies, dtype=x.dtype, device=x.device)
    angles = (x[..., None, :] * scale[:, None]).flatten(-2)
    return torch.cat((x, torch.sin(angles), torch.cos(angles)), dim=-1)
