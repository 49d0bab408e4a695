"""Seconds of several things, taken in turns, so that a machine whose speed drifts is fair to all of them."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

from edge_se_sampler.engine.progress import Progress


def time_interleaved(
    cases: Mapping[str, Callable[[int], Any]],
    rounds: int,
    warmup: int = 1,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, list[float]]:
    """Seconds of every case (name -> function of the round's number) in every round after those of warmup."""
    seconds: dict[str, list[float]] = {name: [] for name in cases}
    progress = Progress(warmup + rounds, "timing")
    for number in range(warmup + rounds):
        for name, case in cases.items():
            start = clock()
            case(number)
            seconds[name].append(clock() - start)
        progress.update(number + 1)
    progress.close()
    return {name: values[warmup:] for name, values in seconds.items()}


def median_milliseconds(cases: Mapping[str, Callable[[int], Any]], rounds: int) -> dict[str, float]:
    """The median of every case over the rounds of `time_interleaved`."""
    return {name: 1e3 * statistics.median(seconds) for name, seconds in time_interleaved(cases, rounds).items()}
