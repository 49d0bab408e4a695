"""Markdown tables of reports, and the texts between markers that reports fill in."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from edge_se_sampler.engine.files import write_atomically
from edge_se_sampler.errors import InputError


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; every row has as many fields as the head."""
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def decimals(value: float | None, digits: int = 2) -> str:
    """A number, or a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}f}"


def describe_machine(machine: Mapping[str, Any]) -> str:
    """Hardware and versions in a line."""
    versions = ", ".join(f"{name} {machine[name]}" for name in ("python", "torch", "numpy"))
    counts = (f"{machine[key]} {key.removesuffix('s') if machine[key] == 1 else key}" for key in ("cores", "threads"))
    return f"{machine['processor']}, {', '.join(counts)}; {versions}"


def describe_command(*results: Mapping[str, Any]) -> str:
    """How to reproduce results, what that takes where it is known, and where the last of them was measured."""
    hours = sum(run.get("cpu_seconds", 0) for result in results for run in result.get("runs", ())) / 3600
    cost = f"That takes {hours:.1f} CPU hours. " if hours else ""
    commands = "\n".join(result["command"] for result in results)
    return (
        f"```bash\n{commands}\n```\n\n{cost}A command that was stopped goes on where it was. `edge-se bench report` "
        f"with this folder writes this page again.\n\nMeasured on: {describe_machine(results[-1]['machine'])}."
    )


def fill_markers(path: Path, tables: Mapping[str, str]) -> None:
    """Replace what a text has between `<!-- table: NAME -->` and `<!-- end -->` by the tables of those names.

    Raises:
        InputError: the file cannot be read or written, or lacks a marker.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as problem:
        raise InputError(f"{path}: cannot be read ({problem.strerror})") from problem
    for name, table in tables.items():
        pattern = re.compile(rf"(<!-- table: {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
        if not pattern.search(text):
            raise InputError(f"{path}: has no marker <!-- table: {name} --> ... <!-- end -->")
        text = pattern.sub(lambda found, new=table: f"{found[1]}{new}\n{found[2]}", text)
    write_atomically(path, text.encode())
