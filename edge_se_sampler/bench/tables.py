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
    return f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} threads; {versions}"


def describe_command(result: Mapping[str, Any]) -> str:
    """How to reproduce a result, what that takes, and where it was measured."""
    hours = sum(run["cpu_seconds"] for run in result["runs"]) / 3600
    return (
        f"`{result['command']}` ({hours:.1f} CPU hours, shared by as many processes as there are cores); it resumes "
        "where it was stopped. `edge-se bench report` with this folder writes the page and its pictures from "
        f"result.json.\n\nMeasured on: {describe_machine(result['machine'])}."
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
