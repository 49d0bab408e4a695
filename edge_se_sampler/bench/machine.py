"""The machine that numbers are measured on; memory and time."""

from __future__ import annotations

import contextlib
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy

from edge_se_sampler import __version__
from edge_se_sampler.engine.progress import Progress


def machine() -> dict[str, Any]:
    """Versions and hardware, for the json of every result."""
    import torch

    return {
        "edge_se_sampler": __version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": numpy.__version__,
        "platform": platform.platform(),
        "processor": _read_proc("cpuinfo", "model name") or platform.processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def resident_memory(what: str = "VmRSS") -> int:
    """Bytes that this process holds resident now ("VmRSS"), or has held at most ("VmHWM").

    From /proc: getrusage's maximum counts the parent's memory before exec. Elsewhere than Linux it has to do, and on
    Windows, which has neither, it is 0.
    """
    if kilobytes := _read_proc("self/status", what):
        return 1024 * int(kilobytes.split()[0])
    try:
        import resource
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if platform.system() == "Darwin" else peak * 1024


def median_milliseconds(cases: Mapping[str, Callable[[int], Any]], rounds: int) -> dict[str, float]:
    """Of every case (name -> function of the round's number), over the rounds after a first one. Cases take turns,
    so that a machine whose speed drifts is fair to all of them."""
    seconds: dict[str, list[float]] = {name: [] for name in cases}
    with Progress(1 + rounds, "timing") as progress:
        for number in range(1 + rounds):
            for name, case in cases.items():
                start = time.perf_counter()
                case(number)
                seconds[name].append(time.perf_counter() - start)
            progress.update(number + 1)
    return {name: 1e3 * statistics.median(values[1:]) for name, values in seconds.items()}


def _read_proc(file: str, key: str) -> str | None:
    """The value of the first line `key: value` in a file of /proc; None where there is none."""
    with contextlib.suppress(OSError, StopIteration), open(f"/proc/{file}") as lines:
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith(key))
    return None
