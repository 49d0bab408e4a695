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
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def _processor() -> str:
    try:
        with open("/proc/cpuinfo") as file:
            names = [line.split(":", 1)[1].strip() for line in file if line.startswith("model name")]
        return names[0]
    except (OSError, IndexError):
        return platform.processor()


def resident_memory(what: str = "VmRSS") -> int:
    """Bytes that this process holds resident now ("VmRSS"), or has held at most ("VmHWM").

    From /proc: getrusage's maximum counts the parent's memory before exec. Elsewhere than Linux it has to do.
    """
    with contextlib.suppress(OSError), open("/proc/self/status") as file:
        return next(1024 * int(line.split()[1]) for line in file if line.startswith(what))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if platform.system() == "Darwin" else peak * 1024
