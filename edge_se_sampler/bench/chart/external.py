"""Results of other programs, to be charted beside ours.

A json file: {"name", "version", "command", "machine", "runs": [{"scene", "seed", "curve": [[seconds, PSNR], ...]}]}.
Seconds are of training, from reading the data on; PSNR is the mean over the same test views.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Literal

from edge_se_sampler.errors import InputError

ProgramName = Literal["nerf-pytorch", "tensorf", "nerfstudio-vanilla-nerf", "nerfstudio-nerfacto"]
"""Those that `bench beside` runs."""


def read_external(path: Path) -> dict[str, Any]:
    """A file of that format.

    Raises:
        InputError: it cannot be read, or lacks something.
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
        raise InputError(f"--external {path}: not a result as the help of --external has it ({problem!r})") from problem
    return told
