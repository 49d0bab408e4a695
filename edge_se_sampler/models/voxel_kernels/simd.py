"""Sixteen float32 numbers as one value in compiled functions: numba leaves loops over them to chance, and processors
calculate with all sixteen (AVX-512), eight (AVX2) or four (SSE, NEON) at once.

Arrays are one-dimensional, contiguous and of float32, and are not checked for their length.
"""

# pyright: reportCallIssue=false, reportOptionalCall=false
from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.extending import intrinsic, lower_builtin, models, register_model
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature

LANES = 16
CONTRACT = {"contract"}
"""A product and a sum may be rounded together. No other freedom: what is compiled would depend on what is around it."""
_FLAGS = tuple(CONTRACT)
_FLOAT, _INT = ir.FloatType(), ir.IntType(32)
_VECTOR = ir.VectorType(_FLOAT, LANES)


class Vector(types.Type):
    """The type of such a value."""

    def __init__(self) -> None:
        super().__init__("float32x16")


vector = Vector()


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, _VECTOR)


def _define_operator(function: Callable, instruction: str) -> None:
    """Let `function` of two vectors be an instruction of LLVM's."""

    @infer_global(function)
    class _(ConcreteTemplate):
        cases = (signature(vector, vector, vector),)

    @lower_builtin(function, vector, vector)
    def _(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, instruction)(*args, flags=_FLAGS)


_INSTRUCTIONS = {"add": "fadd", "iadd": "fadd", "sub": "fsub", "mul": "fmul"}
for _name, _instruction in _INSTRUCTIONS.items():
    _define_operator(getattr(operator, _name), _instruction)


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, offset: Any, to: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [offset]), to.as_pointer())


def _spread(builder: Any, value: Any) -> Any:
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    one = builder.insert_element(undefined, value, _INT(0))
    return builder.shuffle_vector(one, undefined, ir.Constant(ir.VectorType(_INT, LANES), [0] * LANES))


@intrinsic
def load(typing: Any, array: Any, offset: Any) -> Any:
    """array[offset : offset + 16]."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_pointer(context, builder, sig.args[0], *args, _VECTOR), align=4)

    return vector(array, types.int64), generate


@intrinsic
def store(typing: Any, array: Any, offset: Any, value: Any) -> Any:
    """array[offset : offset + 16] = value."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _pointer(context, builder, sig.args[0], *args[:2], _VECTOR), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, vector), generate


@intrinsic
def prefetch(typing: Any, array: Any, offset: Any) -> Any:
    """Have the processor fetch what will soon be loaded from there."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        byte = ir.IntType(8)
        kind = ir.FunctionType(ir.VoidType(), [byte.as_pointer(), _INT, _INT, _INT])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [_pointer(context, builder, sig.args[0], *args, byte), _INT(0), _INT(3), _INT(1)])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


@intrinsic
def splat(typing: Any, value: Any) -> Any:
    """The same number sixteen times."""
    return vector(types.float32), lambda context, builder, sig, args: _spread(builder, args[0])


@intrinsic
def total(typing: Any, value: Any) -> Any:
    """The sum of the sixteen numbers."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.FunctionType(_FLOAT, [_FLOAT, _VECTOR])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.vector.reduce.fadd.v16f32")
        return builder.call(function, [ir.Constant(_FLOAT, 0.0), args[0]], fastmath=("reassoc",))

    return types.float32(vector), generate


@intrinsic
def where_positive(typing: Any, condition: Any, value: Any) -> Any:
    """Each value where the condition is above 0; else 0."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        zero = ir.Constant(_VECTOR, [0.0] * LANES)
        return builder.select(builder.fcmp_ordered(">", args[0], zero), args[1], zero)

    return vector(vector, vector), generate


@intrinsic
def minimum(typing: Any, one: Any, other: Any) -> Any:
    """The lesser of each two."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return vector(vector, vector), generate


@intrinsic
def sigmoid(typing: Any, value: Any) -> Any:
    """1 / (1 + exp(-value)) of each, to some units of the last place; of what is beyond 87 as of 87, on both sides."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        def constant(number: float) -> Any:
            return ir.Constant(_VECTOR, [number] * LANES)

        def multiply_add(one: Any, other: Any, more: Any) -> Any:
            return builder.fadd(builder.fmul(one, other, _FLAGS), more, _FLAGS)

        kind = ir.FunctionType(_VECTOR, [_VECTOR])
        floor = cgutils.get_or_insert_function(builder.module, kind, "llvm.floor.v16f32")
        x = builder.fneg(args[0])
        for bound, order in ((87.0, "<"), (-87.0, ">")):
            x = builder.select(builder.fcmp_unordered(order, x, constant(bound)), x, constant(bound))  # NaN stays NaN
        # exp(x) = 2^n exp(r) with |r| < 0.35: Taylor's polynomial is as exact as float32
        n = builder.call(floor, [multiply_add(x, constant(1 / math.log(2)), constant(0.5))])
        r = multiply_add(n, constant(-0.693359375), x)  # ln 2 in two parts, of which the first has few digits
        r = multiply_add(n, constant(0.693359375 - math.log(2)), r)
        exponential = constant(1 / math.factorial(6))
        for k in range(5, -1, -1):
            exponential = multiply_add(exponential, r, constant(1 / math.factorial(k)))
        integers = ir.VectorType(_INT, LANES)
        exponent = builder.add(builder.fptosi(n, integers), ir.Constant(integers, [127] * LANES))
        power = builder.bitcast(builder.shl(exponent, ir.Constant(integers, [23] * LANES)), _VECTOR)
        return builder.fdiv(constant(1.0), multiply_add(power, exponential, constant(1.0)))

    return vector(vector), generate
