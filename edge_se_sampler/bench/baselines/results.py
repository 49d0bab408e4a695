"""Results of other programs (baselines), shown beside ours: DIR/baselines/*.json of a chart's folder DIR.

`edge-se bench baselines` writes them in the format of every result (see `bench.runner`). Their settings are
`BaselineSettings`; a run has scene, seed and curve: rows of training seconds, from reading the data on, and PSNR, the
mean over the same test views.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.chart.trials import ChartSettings
from edge_se_sampler.bench.runner import read_result
from edge_se_sampler.errors import InputError

FOLDER = "baselines"


@dataclass(frozen=True, kw_only=True)
class BaselineSettings(ChartSettings):
    """What was run, and how."""

    program: str
    label: str = ""
    """What distinguishes these flags from others, in pictures and tables."""
    program_version: str
    flags: str
    """The program's own, besides those that name the data."""

    @property
    def name(self) -> str:
        """Program and label."""
        return f"{self.program}, {self.label}" if self.label else self.program


def name_of(baseline: dict[str, Any]) -> str:
    """Program and label of a result."""
    return BaselineSettings(**baseline["settings"]).name


def path_of(settings: BaselineSettings, folder: Path) -> Path:
    """Where a baseline's result lies in a chart's folder."""
    return folder / FOLDER / f"{'-'.join(re.findall(r'[A-Za-z0-9.]+', settings.name))}.json"


def read_baselines(folder: Path, settings: ChartSettings) -> list[dict[str, Any]]:
    """The baselines in a chart's folder, in the order of their file names.

    Raises:
        InputError: a file cannot be read, lacks something, or was timed otherwise than the chart.
    """
    return [read_baseline(path, settings) for path in sorted((folder / FOLDER).glob("*.json"))]


def read_baseline(path: Path, settings: ChartSettings) -> dict[str, Any]:
    """A baseline's result.

    Raises:
        InputError: it cannot be read, lacks something, or is of another number of threads or size of images.
    """
    result = read_result(path)
    try:
        timed = BaselineSettings(**result["settings"])
        for run in result["runs"]:
            times = [float(seconds) for seconds, _ in run["curve"]]
            valid = [isinstance(run["scene"], str), bool(times), times == sorted(times), min(times) > 0]
            if not (all(valid) and all(math.isfinite(float(psnr)) for _, psnr in run["curve"])):
                raise ValueError(f"the curve of {run['scene']}, seed {run['seed']}, is not ascending seconds and PSNR")
    except (ValueError, KeyError, TypeError) as problem:
        raise InputError(f"{path}: not a result of edge-se bench baselines ({problem!r})") from problem
    for key in ("threads", "image_size"):
        value, expected = getattr(timed, key), getattr(settings, key)
        if value != expected:
            raise InputError(f"{path}: {key} is {value}, the chart's is {expected}: their seconds cannot be compared")
    return result
