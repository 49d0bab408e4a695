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
from edge_se_sampler.bench.runner import Run, read_result
from edge_se_sampler.errors import InputError


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


def path_of(settings: BaselineSettings, folder: Path) -> Path:
    """Where a baseline's result lies in a chart's folder."""
    return folder / "baselines" / f"{'-'.join(re.findall(r'[A-Za-z0-9.]+', settings.name))}.json"


def read_baselines(folder: Path, settings: ChartSettings) -> dict[str, dict[str, Any]]:
    """Name and version -> result of the baselines in a chart's folder, in the order of their file names.

    Raises:
        InputError: a file cannot be read, lacks something, or is of another number of threads or size of images.
    """
    baselines = {}
    for path in sorted((folder / "baselines").glob("*.json")):
        result = read_result(path)
        try:
            found = BaselineSettings(**result["settings"])
            for run in result["runs"]:
                _check_curve(run)
        except (ValueError, KeyError, TypeError) as problem:
            raise InputError(f"{path}: not a result of edge-se bench baselines ({problem!r})") from problem
        for key in ("threads", "image_size"):
            value, expected = getattr(found, key), getattr(settings, key)
            if value != expected:
                raise InputError(f"{path}: {key} is {value}, the chart's is {expected}: seconds cannot be compared")
        baselines[f"{found.name} ({found.program_version})"] = result
    return baselines


def _check_curve(run: Run) -> None:
    scene, seed, curve = run["scene"], run["seed"], run["curve"]
    times = [seconds for seconds, _ in curve]
    finite = all(math.isfinite(psnr) for _, psnr in curve)
    if not (isinstance(scene, str) and curve and finite and times == sorted(times) and times[0] > 0):
        raise ValueError(f"the curve of {scene}, seed {seed}, is not ascending seconds and PSNR")
