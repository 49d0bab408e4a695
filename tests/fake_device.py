"""A device that is not there: tensors on it compute on the CPU, and refuse what a real one would."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

DEVICE = torch.device("meta")
"""Has no float64 here; of a type for which torch wants no driver."""


class FakeTensor(Tensor):
    """On `DEVICE`, as it says; `on_cpu` holds its values."""

    on_cpu: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> FakeTensor:
        if inner.dtype == torch.float64:
            raise TypeError(f"{DEVICE} has no float64")
        place = {} if inner.is_sparse else {"strides": inner.stride(), "storage_offset": inner.storage_offset()}
        fake = Tensor._make_wrapper_subclass(  # pyright: ignore[reportAttributeAccessIssue]
            cls, inner.shape, dtype=inner.dtype, layout=inner.layout, device=DEVICE, **place
        )
        fake.on_cpu = inner
        return fake

    def __repr__(self, **_: Any) -> str:
        return f"FakeTensor({self.on_cpu!r})"

    __torch_function__ = torch._C._disabled_torch_function_impl  # pyright: ignore[reportAssignmentType]

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(func, args, kwargs or {})

    @property
    def data(self) -> Tensor:
        return self.detach()

    @data.setter
    def data(self, value: FakeTensor) -> None:
        Tensor.data.__set__(self, value)  # pyright: ignore[reportAttributeAccessIssue]
        self.on_cpu = value.on_cpu


class _Operations(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(func, args, kwargs or {})


class _Constants(TorchFunctionMode):
    """torch would make an empty tensor of numbers that it is to put on `DEVICE`."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is Tensor.new_tensor and isinstance(args[0], FakeTensor):
            func, args, kwargs = torch.tensor, args[1:], {"dtype": args[0].dtype, "device": DEVICE} | kwargs
        if func is torch.tensor and torch.device(kwargs.get("device") or "cpu") == DEVICE:
            return torch.tensor(*args, **kwargs | {"device": "cpu"}).to(DEVICE)
        if func is Tensor.__getitem__ and isinstance(args[0], FakeTensor) and isinstance(args[1], list):
            args = args[0], torch.tensor(args[1]).to(DEVICE)
        if func is Tensor.tolist and isinstance(args[0], FakeTensor):
            return args[0].on_cpu.tolist()
        return func(*args, **kwargs)


class _CpuGenerator(torch.Generator):
    def __new__(cls, device: Any = None) -> Any:
        return super().__new__(cls)


@contextmanager
def fake_device() -> Iterator[None]:
    """Meanwhile what is made on `DEVICE`, or copied there, is a `FakeTensor`; generators' numbers are the CPU's."""
    generator = torch.Generator
    torch.Generator = _CpuGenerator  # pyright: ignore[reportAttributeAccessIssue]
    try:
        with _Operations(), _Constants():
            yield
    finally:
        torch.Generator = generator  # pyright: ignore[reportAttributeAccessIssue]


def _compute(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """An operation on the CPU, with its results where they should be. RuntimeError: its tensors are on both devices."""
    tensors = [value for value in tree_flatten((args, kwargs))[0] if isinstance(value, Tensor)]
    fakes = [value for value in tensors if isinstance(value, FakeTensor)]
    copying = func in (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default)
    mixed = [value for value in tensors if value.ndim and not isinstance(value, FakeTensor)]
    if fakes and mixed and not copying:
        raise RuntimeError(f"{func}: expected all tensors to be on the same device, {DEVICE}, but found one on the CPU")
    on_device = bool(fakes)
    if kwargs.get("device") is not None:
        on_device = torch.device(kwargs["device"]).type == DEVICE.type
        kwargs = kwargs | {"device": torch.device("cpu")}
    elif func == torch.ops.aten.copy_.default:
        on_device = isinstance(args[0], FakeTensor)
    inner_args, inner_kwargs = tree_map(lambda x: x.on_cpu if isinstance(x, FakeTensor) else x, (args, kwargs))
    result = func(*inner_args, **inner_kwargs)
    if func == torch.ops.aten._to_copy.default and fakes and result.dtype == torch.float64:
        raise TypeError(f"{DEVICE} has no float64")
    known = {id(value.on_cpu): value for value in fakes}

    def outer(value: Any) -> Any:
        if not isinstance(value, Tensor) or not on_device:
            return value
        return known[id(value)] if id(value) in known else FakeTensor(value)

    return tree_map(outer, result)
