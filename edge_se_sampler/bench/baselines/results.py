"""Results of other programs, to be charted beside ours.

A json file: {"name", "version", "command", "machine", "runs": [{"scene", "seed", "curve": [[seconds, PSNR], ...]}]}.
Seconds are of training, from reading the data on; PSNR is the mean over the same test views. "threads", where it is
told, says whose seconds: the CPU's of one thread, or those on the wall of several; "pixels" the images' longer side.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from edge_se_sampler.errors import InputError

if TYPE_CHECKING:
    from edge_se_sampler.bench.chart.train import Scale

ProgramName = Literal["nerf-pytorch", "tensorf", "nerfstudio-vanilla-nerf", "nerfstudio-nerfacto"]
"""Those that `bench beside` runs."""


def read_external(path: Path, flag: str, scale: Scale) -> dict[str, Any]:
    """A file of that format, named by a flag.

    Raises:
        InputError: it cannot be read, lacks something, or is of another number of threads or size of images.
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
    for key, ours in (("threads", scale.threads), ("pixels", scale.pixels)):
        if (theirs := told.get(key, ours)) != ours:
            raise InputError(f"{flag} {path}: made with {theirs} {key}, not {ours}: its seconds are other seconds")
    return told
