"""Values, tensors and bytes that are changed at random."""

from __future__ import annotations

import copy
import random
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

NUMBERS = (0, 1, -1, 2, 17, 2**31, 2**62, 10**30, 0.5, -0.25, 1e-300, 1e300, float("nan"), float("inf"))
VALUES = (*NUMBERS, None, True, "", "x", "../x", "/", "a\0b", "\n", "\ud800", [], {}, [[1]], "x" * 5000, [0.0] * 4)


def places(value: Any, path: tuple = ()) -> Iterator[tuple]:
    """Where a nested value has others."""
    children = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, (list, tuple)) else ()
    )
    for key, child in children:
        yield (*path, key)
        yield from places(child, (*path, key))


def change_value(value: Any, rng: random.Random) -> None:
    """Replace, remove or repeat something in a nested value."""
    paths = list(places(value))
    if not paths:
        return
    path = rng.choice(paths)
    for key in path[:-1]:
        value = value[key]
    key, old = path[-1], value[path[-1]]
    if isinstance(value, tuple):
        return
    if isinstance(old, Tensor):
        value[key] = changed_tensor(old, rng)
    elif rng.random() < 0.1:
        del value[key]
    elif rng.random() < 0.1 and isinstance(value, list):
        value.append(old)
    elif isinstance(old, (int, float)) and rng.random() < 0.3:
        value[key] = rng.choice((-old, 2 * old, old + 1, old / 3, old * 1e10))
    else:
        value[key] = copy.deepcopy(rng.choice(VALUES))


def changed_tensor(tensor: Tensor, rng: random.Random) -> Any:
    """Another shape, type or number."""
    if tensor.is_sparse or tensor.numel() > 2**24:  # it was changed before, or repeats its numbers
        return tensor
    ways: list[Callable[[], Any]] = [
        lambda: tensor.double(),
        lambda: tensor.to(torch.int16),
        lambda: tensor[None],
        lambda: tensor.flatten()[: rng.randrange(tensor.numel() + 1)].clone(),
        lambda: torch.cat((tensor, tensor)) if tensor.ndim else tensor,
        lambda: tensor.flatten()[:1].expand(2**40),
        lambda: tensor.to_sparse() if tensor.ndim and tensor.dtype != torch.bool else None,
    ]
    if tensor.numel() and rng.random() < 0.7:
        changed, number = tensor.clone(), rng.choice(NUMBERS)
        integer = not changed.dtype.is_floating_point
        number = int(min(max(number, -(2**62)), 2**62)) if integer and number == number else 3 if integer else number
        limits = {torch.uint8: 255, torch.int32: 2**31 - 1}
        number = number if integer else float(min(number, 3e38))
        changed.view(-1)[rng.randrange(tensor.numel())] = min(number, limits.get(changed.dtype, number))
        return changed
    return rng.choice(ways)()


def change_bytes(data: bytes, rng: random.Random) -> bytes:
    """Flip, cut, insert or repeat some bytes."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 3)):
        start, length = rng.randrange(len(changed) + 1), rng.choice((0, 1, 1, 2, 8, 100))
        changed[start : start + length] = rng.choice((b"", b"\0", b"\xff" * 8, rng.randbytes(rng.randint(1, 9))))
    return bytes(changed[: rng.randrange(len(changed) + 1)] if rng.random() < 0.1 else changed)
