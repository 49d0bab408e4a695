"""`edge-se bench report DIR`: an experiment's README.md and pictures from its result, nothing trained."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from edge_se_sampler.bench.tables import fill_markers
from edge_se_sampler.engine.files import write_atomically
from edge_se_sampler.errors import InputError

REPORTS = {
    "chart": "chart.report",
    "paper": "paper.report",
    "stability": "stability.report",
    "schedule": "schedule.report",
    "nerfstudio": "nerfstudio.report",
    "micro": "micro.report",
    "demo": "demo",
}
"""Experiment -> the module of `edge_se_sampler.bench` that reports it."""


class Report(Protocol):
    """What such a module has."""

    def describe(self, folder: Path) -> str:
        """The README.md of a folder of results; a function of the json files and of which pictures there are."""
        ...

    def draw(self, folder: Path, workplace: Path | None) -> None:
        """Draw the folder's pictures; those that need renderings only where the workplace has them."""
        ...

    def tables(self, folder: Path) -> dict[str, str]:
        """Tables by name that other texts show between markers."""
        ...


def report_of(folder: Path) -> Report:
    """The module that reports a folder.

    Raises:
        InputError: no result lies there.
    """
    for path in sorted(folder.glob("**/*.json")):
        name = _experiment_of(path)
        if name in REPORTS:
            module: Any = import_module(f"edge_se_sampler.bench.{REPORTS[name]}")
            return module
    raise InputError(f"{folder}: no result of edge-se bench lies there")


def write_report(folder: Path, readme: Path | None = None, workplace: Path | None = None) -> None:
    """Write a folder's pictures and README.md, and fill its tables into another text.

    Args:
        readme: a text with `<!-- table: NAME -->` ... `<!-- end -->` markers for this experiment's tables.
        workplace: where the experiment has left renderings that pictures show.

    Raises:
        InputError: no result lies there, matplotlib is missing, or a file cannot be written.
    """
    report = report_of(folder)
    report.draw(folder, workplace)
    write_atomically(folder / "README.md", report.describe(folder).encode())
    if readme is not None:
        fill_markers(readme, report.tables(folder))


def _experiment_of(path: Path) -> str | None:
    """The experiment that a json file says it is of."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return content.get("experiment") if isinstance(content, dict) else None
