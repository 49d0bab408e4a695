"""What torch's devices can do."""

from __future__ import annotations

import torch

WITHOUT_FLOAT64 = ["mps"]
"""Types of devices."""


def has_float64(device: torch.device) -> bool:
    return device.type not in WITHOUT_FLOAT64


def exact_type(device: torch.device) -> torch.dtype:
    """float64, or float32 on a device that has none."""
    return torch.float64 if has_float64(device) else torch.float32
