"""Results of other programs (baselines), shown beside ours: DIR/baselines/*.json of a chart's folder DIR.

A run has scene, seed and curve: rows of training seconds, from reading the data on, and mean PSNR of the test views.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.chart.trials import ChartSettings
from edge_se_sampler.bench.runner import read_result
from edge_se_sampler.errors import InputError


@dataclass(frozen=True, kw_only=True)
class BaselineSettings(ChartSettings):
    """What was run, and how: the flags of `edge-se bench baselines`."""

    program: str
    label: str = ""
    program_version: str
    flags: str

    @property
    def name(self) -> str:
        return f"{self.program}, {self.label}" if self.label else self.program


def read_baselines(folder: Path, settings: ChartSettings) -> dict[str, dict[str, Any]]:
    """Name and version -> result of the baselines in a chart's folder, in the order of their file names. InputError: a
    file cannot be read, or is of another number of threads or size of images."""
    baselines = {}
    for path in sorted((folder / "baselines").glob("*.json")):
        result = read_result(path)
        try:
            found = BaselineSettings(**result["settings"])
        except TypeError as problem:
            raise InputError(f"{path}: not a result of edge-se bench baselines ({problem!r})") from problem
        for key in ("threads", "image_size"):
            value, expected = getattr(found, key), getattr(settings, key)
            if value != expected:
                raise InputError(f"{path}: {key} is {value}, the chart's is {expected}: seconds cannot be compared")
        baselines[f"{found.name} ({found.program_version})"] = result
    return baselines
