"""Which code renders a voxel model: compiled kernels, or plain torch."""

from __future__ import annotations

import sys
from functools import cache
from importlib.util import find_spec
from types import ModuleType

import torch
from torch import Tensor

from edge_se_sampler.models import voxel_ops


def choose_ops(weight: Tensor) -> ModuleType:
    """What renders a model with such weights: `voxel_kernels`, with as many threads as torch has, for float32 on a CPU
    where numba is installed; else plain torch."""
    ops = compiled_ops() if weight.device.type == "cpu" and weight.dtype == torch.float32 else None
    if ops is None:
        return voxel_ops
    ops.set_num_threads(torch.get_num_threads())
    return ops


@cache
def compiled_ops() -> ModuleType | None:
    """`voxel_kernels`; None, and a line that says why, where numba is not installed or cannot be used."""
    if find_spec("numba") is None:
        hint = 'pip install "edge-se-sampler[fast]" makes this model much faster on a CPU'
        print(f"edge-se: numba is not installed; {hint}", file=sys.stderr)
        return None
    num_threads = torch.get_num_threads()
    try:
        from edge_se_sampler.models import voxel_kernels
    except ImportError as problem:  # as where it does not know this version of numpy
        _warn(problem, 'pip install --upgrade "edge-se-sampler[fast]" may help')
        return None
    except RuntimeError as problem:  # it finds no folder for what it compiles
        _warn(problem, "set NUMBA_CACHE_DIR to a folder that it may write to")
        return None
    voxel_kernels.set_num_threads(num_threads)
    torch.set_num_threads(num_threads)  # as numba begins it sets OpenMP's number, which is torch's too
    return voxel_kernels


def _warn(problem: Exception, remedy: str) -> None:
    reason = " ".join(str(problem).split())
    print(f"edge-se: numba cannot be used ({reason}), and plain torch is much slower; {remedy}", file=sys.stderr)
