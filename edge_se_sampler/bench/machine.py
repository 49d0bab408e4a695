"""Where a number was measured."""

from __future__ import annotations

import contextlib
import os
import platform
import resource
from typing import Any

import numpy
import torch

from edge_se_sampler import __version__


def machine() -> dict[str, Any]:
    """Versions and hardware, for the json of every result."""
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

    From /proc: getrusage's maximum counts the parent's memory before exec. Elsewhere than Linux it has to do.
    """
    if kilobytes := _read_proc("self/status", what):
        return 1024 * int(kilobytes.split()[0])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if platform.system() == "Darwin" else peak * 1024


def _read_proc(file: str, key: str) -> str | None:
    """The value of the first line `key: value` in a file of /proc; None where there is none."""
    with contextlib.suppress(OSError, StopIteration), open(f"/proc/{file}") as lines:
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith(key))
    return None
