"""Vectors of sixteen numbers in compiled functions, against numpy."""

# pyright: reportCallIssue=false
from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numba import njit

from edge_se_sampler.models.voxel_kernels.simd import (
    load,
    minimum,
    prefetch,
    sigmoid,
    splat,
    store,
    total,
    where_positive,
)


@njit
def add(array: Any, other: Any, out: Any) -> None:
    store(out, 0, load(array, 3) + load(other, 5))


@njit
def subtract(array: Any, other: Any, out: Any) -> None:
    store(out, 0, load(array, 3) - load(other, 5))


@njit
def multiply(array: Any, other: Any, out: Any) -> None:
    store(out, 0, load(array, 3) * load(other, 5))


@njit
def accumulate(array: Any, other: Any, out: Any) -> None:
    result = splat(array[3])
    for i in range(5, 8):
        result += load(other, i)
    store(out, 0, result)


@njit
def least(array: Any, other: Any, out: Any) -> None:
    prefetch(array, 3)
    store(out, 0, minimum(load(array, 3), load(other, 5)))


@njit
def masked(array: Any, other: Any, out: Any) -> None:
    store(out, 0, where_positive(load(array, 3), load(other, 5)))


@njit
def summed(array: Any, other: Any, out: Any) -> None:
    out[:] = total(load(array, 3))


REFERENCES = {
    add: lambda a, b: a[3:19] + b[5:21],
    subtract: lambda a, b: a[3:19] - b[5:21],
    multiply: lambda a, b: a[3:19] * b[5:21],
    accumulate: lambda a, b: a[3] + b[5:21] + b[6:22] + b[7:23],
    least: lambda a, b: np.minimum(a[3:19], b[5:21]),
    masked: lambda a, b: np.where(a[3:19] > 0, b[5:21], 0),
    summed: lambda a, b: np.full(16, a[3:19].sum()),
}


@pytest.mark.parametrize("function", REFERENCES, ids=lambda function: function.__name__)
def test_a_vector_is_sixteen_numbers(function: Any) -> None:
    rng = np.random.default_rng(0)
    one, other = (rng.normal(size=40).astype(np.float32) for _ in range(2))
    out = np.zeros(18, np.float32)
    function(one, other, out[:16])
    expected = REFERENCES[function](one.astype(np.float64), other.astype(np.float64))
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(out[:16], expected, rtol=2e-5, atol=1e-6)
    assert (out[16:] == 0).all()  # nothing beside it is written to


@njit
def activate(array: Any, out: Any) -> None:
    for i in range(0, len(array), 16):
        store(out, i, sigmoid(load(array, i)))


def test_sigmoids_are_numpys() -> None:
    values = np.concatenate((np.linspace(-86, 86, 16001), np.linspace(-2, 2, 15999))).astype(np.float32)
    out = np.zeros_like(values)
    activate(values, out)
    np.testing.assert_allclose(out, 1 / (1 + np.exp(-values.astype(np.float64))), rtol=4e-7)


def test_sigmoids_of_what_is_hardly_a_number() -> None:
    infinity = np.float32(np.inf)
    values = np.array([-infinity, -1e30, -87, 0, 87, 1e30, infinity, np.nan] * 2, np.float32)
    out = np.zeros_like(values)
    activate(values, out)
    least = 1 / (1 + np.exp(87.0))
    np.testing.assert_allclose(out, [least, least, least, 0.5, 1, 1, 1, np.nan] * 2, rtol=1e-6)
