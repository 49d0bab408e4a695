"""Whether a checkpoint's numbers are those of a grid: compiled kernels, which know no bounds, follow them."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from edge_se_sampler.data.memory import available_memory
from edge_se_sampler.occupancy.bricks import BRICK, BrickGrid, pack_bits

MAX_SIZE = 2**20
"""Cells along an axis: float32 tells positions in them apart."""
BYTES_PER_BRICK = 16
"""Of the box, stored or not: `numbers`, `table`, and what they are derived with."""


def check_grid(state: Mapping[str, Tensor]) -> None:
    """ValueError if the `state_dict` of a `BrickGrid` is none, or its box takes more memory than is available; KeyError
    if parts are missing."""
    own = BrickGrid.from_cells(torch.zeros(3), 1.0, torch.zeros((1, 1, 1), dtype=torch.bool)).state_dict()
    state = {"focus": own["focus"], **state}
    k = len(state["bricks"]) if state["bricks"].ndim else 0
    lengths = {"bricks": k, "occupied": k, "sampled": k, "max_weight": BRICK**3 * k}
    for name, value in own.items():
        shape = (lengths.get(name, len(value)), *value.shape[1:]) if value.ndim else ()
        if state[name].dtype != value.dtype or state[name].shape != shape:
            raise ValueError(f"{name} is no grid's")
    if not (state["focus"].abs() < 1e30).all() or not 0 <= state["focus"][3] <= 1 or state["focus"][4] < 0:
        raise ValueError("its focus is none")
    scales = torch.stack((state["cell_size"], state["finest_size"]))
    if not ((scales > 1e-30) & (scales < 1e30)).all() or not (state["aabb_min"].abs() < 1e30).all():
        raise ValueError("its box is none")
    if not 0 <= int(state["level"]) <= int(state["max_level"]) < 128:
        raise ValueError("its level is none")
    size, bricks = state["size"], state["bricks"]
    if not ((size >= 1) & (size <= MAX_SIZE)).all():
        raise ValueError("its size is none")
    shape = size // BRICK + 1
    needed, available = BYTES_PER_BRICK * math.prod(shape.tolist()), available_memory() or 2**35
    if needed > available:
        raise ValueError(f"its box takes {needed / 2**30:.1f} GiB of memory, {available / 2**30:.1f} are available")
    numbers = (bricks[:, 0] * shape[1] + bricks[:, 1]) * shape[2] + bricks[:, 2]
    if not ((bricks >= 0) & (bricks < shape)).all() or not (numbers[1:] > numbers[:-1]).all():
        raise ValueError("its bricks are not in its box, once each")
    if not state["occupied"].any() or (state["sampled"] & ~pack_bits(state["occupied"])).any():
        raise ValueError("its cells are not occupied")
