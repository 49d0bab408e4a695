"""What reports are written with: Markdown tables, numbers, commands and machines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; every row has as many fields as the head."""
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def decimals(value: float | None) -> str:
    """A number with two decimals, or a dash where there is none."""
    return "–" if value is None else f"{value:.2f}"


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
