"""Results of other programs, to be charted beside ours.

A json file: {"name", "version", "command", "machine", "runs": [{"scene", "seed", "curve": [[seconds, PSNR], ...]}]}.
Seconds are of training, from reading the data on; PSNR is the mean over the same test views. "threads", where it is
told, says whose seconds: the CPU's of one thread, or those on the wall of several.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Literal

from edge_se_sampler.errors import InputError

ProgramName = Literal["nerf-pytorch", "tensorf", "nerfstudio-vanilla-nerf", "nerfstudio-nerfacto"]
"""Those that `bench beside` runs."""


def read_external(path: Path, flag: str, threads: int) -> dict[str, Any]:
    """A file of that format, named by a flag.

    Raises:
        InputError: it cannot be read, lacks something, or was timed with another number of threads.
    """
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        for key in ("name", "version", "command", "machine"):
            told[key]
        for run in told["runs"]:
            times = [float(seconds) for seconds, _ in run["curve"]]
            good = [isinstance(run["scene"], str), bool(times), times == sorted(times), min(times) > 0]
            if not (all(good) and all(math.isfinite(float(psnr)) for _, psnr in run["curve"])):
                raise ValueError(f"the curve of {run['scene']}, seed {run['seed']}, is not ascending seconds and PSNR")
    except (OSError, ValueError, KeyError, TypeError) as problem:
        raise InputError(f"{flag} {path}: not a result as bench chart's --external has it ({problem!r})") from problem
    if (theirs := told.get("threads", threads)) != threads:
        raise InputError(f"{flag} {path}: timed with {theirs} threads, not {threads}: its seconds are other seconds")
    return told
