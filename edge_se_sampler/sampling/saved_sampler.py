"""Whether a checkpoint's numbers are those of a pixel sampler: what it learned, of the training images."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from edge_se_sampler.sampling.cells import CellTable
from edge_se_sampler.sampling.error_map import ErrorMap
from edge_se_sampler.sampling.pixel_sampler import ImportantPixels
from edge_se_sampler.sampling.quadtree import MAX_LEVEL

MAX_STEP = 2**40
Sizes = Mapping[int, tuple[int, int]]
"""Rows and columns of images, by their numbers."""


def is_sampler_state(state: Mapping[str, Any], sampler: ImportantPixels, images: Sizes) -> bool:
    """Whether a sampler of training images can continue from a state; parts of other packages judge their own. Of an
    early phase that was over there is none."""
    parts, package = sampler.parts(), __name__.partition(".")[0]
    may_lack = f"{sampler.config.early}.distribution"
    return state.keys() <= parts.keys() and all(
        _is_part(state.get(name, {}), part.state_dict(), images)
        for name, part in parts.items()
        if type(part).__module__.partition(".")[0] == package and (name in state or name != may_lack)
    )


def _is_part(state: Any, own: Mapping[str, Any], images: Sizes) -> bool:
    if "cells" in own:
        return _is_learned(state, own, images)
    if "numbers" in own:
        return _is_forest(state, own, images)
    return _is_error_map(state, images) if "sizes" in own else is_alike(state, own)


def _is_learned(state: Any, own: Mapping[str, Any], images: Sizes) -> bool:
    """Of a `LearnedDistribution`: its cells, numbers of each, walkers, and a table that is being filled."""
    if not (isinstance(state, dict) and state.keys() == own.keys() and _is_cell_table(state["cells"], images)):
        return False
    for name in own.keys() - {"cells"}:
        found = state[name]
        if isinstance(own[name], Tensor):
            valid = is_alike(found, own[name].new_zeros(len(state["cells"]["values"])))
            valid = valid and bool(((found >= 0) & (found < MAX_STEP)).all())
        elif name == "walkers":
            valid = isinstance(found, dict) and all(
                type(image) is int and is_alike(rows, torch.zeros((len(rows), 4), dtype=torch.float64))
                for image, rows in found.items()
            )
        elif name == "map":
            valid = found is None or _is_cell_table(found, images)
        elif isinstance(own[name], list):
            valid = _is_of_groups(found, state["cells"])
        else:
            valid = is_alike(found, own[name]) and found >= 0
        if not valid:
            return False
    return True


def _is_of_groups(found: Any, cells: dict[str, Any]) -> bool:
    """Numbers of each image of a table of cells, or of all together, for which earlier versions had it alone."""
    numbers = found if isinstance(found, list) else [found]
    return len(numbers) in {1, 1 if cells["across_images"] else len(cells["sizes"])} and all(
        type(number) in (bool, float) and is_finite(float(number)) and number >= 0 for number in numbers
    )


def _is_cell_table(state: Any, images: Sizes) -> bool:
    sizes = _sizes_of(state, images)
    if sizes is None or not (is_alike(state["side"], 1) and 1 <= state["side"] < MAX_STEP):
        return False
    table = CellTable(state["side"], new_value=state["new_value"], across_images=state["across_images"])
    table.grow(sizes)
    return is_alike(state, table.state_dict())


def _is_error_map(state: Any, images: Sizes) -> bool:
    sizes = _sizes_of(state, images)
    if sizes is None:
        return False
    error_map = ErrorMap()
    error_map.add(sizes)
    return is_alike(state, error_map.state_dict())


def _sizes_of(state: Any, images: Sizes) -> dict[int, tuple[int, int]] | None:
    """The images that a table says that it is of; None if they are none of these, each once."""
    listed = state["sizes"]
    if not isinstance(listed, list) or not is_alike(listed, [[0, 0, 0]] * len(listed)):
        return None
    sizes = {number: (height, width) for number, height, width in listed}
    return sizes if len(sizes) == len(listed) and sizes.items() <= images.items() else None


def _is_forest(state: Any, own: Mapping[str, Any], images: Sizes) -> bool:
    """Of a quadtree's."""
    numbers = state["numbers"]
    grown = {
        name: value.new_zeros((len(numbers), *value.shape[1:])) if isinstance(value, Tensor) else value
        for name, value in own.items()
    }
    return (
        is_alike(state, grown | {"numbers": [0] * len(numbers)})
        and set(numbers) <= images.keys()
        and len(set(numbers)) == len(numbers)
        and 0 <= state["deepest"] <= MAX_LEVEL
        and bool((state["level"] <= state["deepest"]).all())
    )


def is_alike(found: Any, own: Any) -> bool:
    """Whether a value is of another's kind: dicts have the same keys, tensors the same shape, numbers are finite,
    and whole where the other is."""
    if isinstance(own, dict):
        same = isinstance(found, dict) and found.keys() == own.keys()
        return same and all(is_alike(found[key], own[key]) for key in own)
    if isinstance(own, (list, tuple)):
        if not isinstance(found, (list, tuple)):
            return False
        return len(found) == len(own) and all(map(is_alike, found, own))
    if isinstance(own, Tensor):
        return isinstance(found, Tensor) and (found.dtype, found.shape) == (own.dtype, own.shape)
    if isinstance(own, str):
        return found in ("early", "late")  # of phases alone
    if isinstance(own, float):
        return is_finite(found)
    if isinstance(own, int):
        return type(found) is type(own) and is_finite(int(found))
    return found is None and own is None


def is_finite(value: Any) -> bool:
    """Whether a value is a plain number, and not absurdly large."""
    return type(value) in (int, float) and abs(value) < MAX_STEP**2 and math.isfinite(value)
