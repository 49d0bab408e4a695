"""Processes that train one model together, as torchrun starts them, by torch.distributed: gloo on CPUs, nccl on GPUs.

rank   number of a process, 0 .. world_size - 1; rank 0 alone writes files and prints

Every function is called by all ranks at the same point. In a single process none does anything, nor needs torch.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from edge_se_sampler.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

Value = TypeVar("Value")
_rank, _world_size = 0, 1


def rank() -> int:
    return _rank


def world_size() -> int:
    return _world_size


def local_world_size() -> int:
    """How many of the processes share this machine."""
    count = os.environ.get("LOCAL_WORLD_SIZE", "")
    return 1 if _world_size == 1 else int(count) if count.isdecimal() and int(count) else _world_size


def is_main() -> bool:
    """Whether this process writes and prints."""
    return _rank == 0


def join(device: str) -> None:
    """Meet the other processes that torchrun has started, if it has; `device` is "cuda", "mps" or "cpu". InputError:
    there is no GPU for this one."""
    global _rank, _world_size
    world = os.environ.get("WORLD_SIZE", "1")
    if not world.isdecimal():
        raise InputError(f"WORLD_SIZE is {world!r} in the environment: torchrun sets it to a number; unset it")
    world = int(world)
    if world == _world_size or not {"RANK", "MASTER_ADDR"} <= os.environ.keys():
        return
    import torch
    from torch import distributed

    if device == "mps":
        raise InputError("several processes cannot share an Apple GPU; use --machine.device-type cpu")
    if device == "cuda":
        local, count = int(os.environ.get("LOCAL_RANK", 0)), torch.cuda.device_count()
        if local >= count:
            raise InputError(f"--nproc-per-node is above {count}, the GPUs of this machine: one process needs one")
        torch.cuda.set_device(local)
    # imported later, as torch's optimizers do, its functions have the group as an argument's default, and it never ends
    import torch.distributed.nn.functional

    with _lost_ranks_as_connection_errors():
        distributed.init_process_group("cpu:gloo,cuda:nccl" if device == "cuda" else "gloo")
    atexit.register(_leave)  # its threads may abort a process that ends before they do
    _rank, _world_size = distributed.get_rank(), world


def _leave() -> None:
    """End the group and its threads, which may need the interpreter to free their last tensors: before torch 2.8
    (pytorch/pytorch#154976) gloo's own object alone, here the last to end, waits for them without holding it."""
    import torch
    from torch import distributed

    gloo = distributed.distributed_c10d._get_default_group()._get_backend(torch.device("cpu"))
    distributed.destroy_process_group()
    del gloo


def add_up(values: Tensor) -> Tensor:
    """The sum of a tensor over all ranks, in place."""
    return _reduce(values, "SUM")


def find_largest(values: Tensor) -> Tensor:
    """The largest of each of a tensor's values over all ranks, in place."""
    return _reduce(values, "MAX")


def agree(*numbers: float) -> list[float]:
    """The largest of each number over all ranks: what clocks and signals say is then the same on all."""
    if _world_size == 1:
        return list(numbers)
    import torch

    return find_largest(torch.tensor(numbers, dtype=torch.float64)).tolist()


def share(create: Callable[[], Value]) -> Value:
    """What a function returns on rank 0, which alone calls it."""
    if _world_size == 1:
        return create()
    import torch

    box: list[Any] = [create() if is_main() else None]
    with _lost_ranks_as_connection_errors():
        torch.distributed.broadcast_object_list(box, device=torch.device("cpu"))
    return box[0]


def add_up_gradients(weights: Iterable[Tensor], loss: Tensor) -> None:
    """Sum a loss and the weights' gradients over all ranks, in place. Dense ones travel in one buffer; of the sparse
    gradient of a table those rows do that it has on any rank."""
    if _world_size == 1:
        return
    import torch

    gradients = [(weight, weight.grad) for weight in weights if weight.grad is not None]
    dense = [loss, *(gradient for _, gradient in gradients if not gradient.is_sparse)]
    sums = add_up(torch.cat([values.flatten() for values in dense])).split([values.numel() for values in dense])
    for values, summed in zip(dense, sums, strict=True):
        values.copy_(summed.view_as(values))
    for weight, gradient in gradients:
        if gradient.is_sparse:
            weight.grad = _add_up_rows(gradient)


def _add_up_rows(gradient: Tensor) -> Tensor:
    import torch

    own, values = gradient._indices()[0], gradient._values()
    touched = torch.zeros(len(gradient), dtype=torch.uint8, device=own.device)
    touched[own] = 1
    rows = torch.nonzero(find_largest(touched))[:, 0]
    sums = values.new_zeros((len(rows), *values.shape[1:]))
    add_up(sums.index_add_(0, torch.searchsorted(rows, own), values))
    return torch.sparse_coo_tensor(rows[None], sums, gradient.shape, check_invariants=False, is_coalesced=True)


def _reduce(values: Tensor, operation: str) -> Tensor:
    if _world_size > 1:
        from torch import distributed

        with _lost_ranks_as_connection_errors():
            distributed.all_reduce(values, getattr(distributed.ReduceOp, operation))
    return values


@contextmanager
def _lost_ranks_as_connection_errors() -> Iterator[None]:
    """Turn what torch raises when another rank is gone into one error."""
    try:
        yield
    except RuntimeError as problem:
        message = "another process of this training has ended, or does not answer; continue: edge-se resume RUN"
        raise ConnectionError(message) from problem
