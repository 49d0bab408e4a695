"""The time of several things, taken in turns, so that a machine whose speed drifts is fair to all of them."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

from edge_se_sampler.engine.progress import Progress


def median_milliseconds(cases: Mapping[str, Callable[[int], Any]], rounds: int, warmup: int = 1) -> dict[str, float]:
    """Of every case (name -> function of the round's number), over the rounds after those of warmup."""
    seconds: dict[str, list[float]] = {name: [] for name in cases}
    with Progress(warmup + rounds, "timing") as progress:
        for number in range(warmup + rounds):
            for name, case in cases.items():
                start = time.perf_counter()
                case(number)
                seconds[name].append(time.perf_counter() - start)
            progress.update(number + 1)
    return {name: 1e3 * statistics.median(values[warmup:]) for name, values in seconds.items()}
