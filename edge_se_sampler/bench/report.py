"""`edge-se bench report DIR`: an experiment's README.md and pictures from its result, nothing trained; and what reports
are written with: templates, Markdown tables, numbers, commands and machines."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from string import Formatter
from typing import Any

from edge_se_sampler.data.scene_file import quote, read_json
from edge_se_sampler.engine.files import write_atomically
from edge_se_sampler.errors import InputError, os_errors_as_input_errors

REPORTS = ("chart", "paper", "stability", "schedule", "nerfstudio", "micro", "real", "strategies", "processes")
"""Experiments, each a package with a module `report`."""


def report_of(folder: Path) -> Any:
    """The module that reports a folder: `describe(folder)` is its README.md, a function of the json files and of which
    pictures there are. Optional: `draw(folder, workplace)` draws the pictures, those that need renderings only where
    the workplace has them; `tables(folder)` are tables by name that other texts show. All raise InputError if the
    result cannot be read or a picture cannot be written, and so does this if no result lies there."""
    for path in sorted(folder.glob("**/*.json"), key=lambda path: (len(path.parts), path)):  # its own before others'
        with suppress(InputError):
            name = read_json(path).object().get("experiment")
            if name in REPORTS:
                break
    else:
        raise InputError(f"{folder}: no result of edge-se bench lies there")
    return import_module(f"edge_se_sampler.bench.{name}.report")


def write_report(folder: Path, readme: Path | None = None, workplace: Path | None = None) -> None:
    """Write a folder's pictures (of renderings in the workplace) and README.md, and fill its tables into another text.
    InputError: no result lies there, matplotlib is missing, or a file cannot be written."""
    report = report_of(folder)
    try:
        if hasattr(report, "draw"):
            report.describe(folder)  # what cannot be described is not drawn either
            report.draw(folder, workplace)
        text = report.describe(folder)
        page = text.encode()
        tables = report.tables(folder) if readme is not None and hasattr(report, "tables") else {}
    except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError) as problem:
        if isinstance(problem, InputError):
            raise
        raise InputError(f"{folder}: its result is none of edge-se bench ({quote(problem)})") from problem
    write_atomically(folder / "README.md", page)
    if readme is not None:
        _fill_markers(readme, tables)


def _fill_markers(path: Path, tables: Mapping[str, str]) -> None:
    """Replace what a text has between `<!-- table: NAME -->` and `<!-- end -->` by the tables of those names.
    InputError if it cannot be read or written, or lacks a marker."""
    with os_errors_as_input_errors(f"{path}: cannot be read"):
        content = path.read_bytes()
    try:
        text = content.decode()
    except UnicodeDecodeError as problem:
        raise InputError(f"{path}: is not UTF-8 text (byte {problem.start}); save it as that") from problem
    for name, table in tables.items():
        pattern = re.compile(rf"(<!-- table: {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
        if not pattern.search(text):
            raise InputError(f"{path}: has no marker <!-- table: {name} --> ... <!-- end -->")
        text = pattern.sub(lambda found, new=table: f"{found[1]}{new}\n{found[2]}", text)
    write_atomically(path, text.encode())


def fill_template(module_file: str, folder: Path, template: str = "report.md", /, **parts: object) -> str:
    """A template beside a module, its {placeholders} filled in by `str.format`.

    Left out are sections, from a `##` heading to the next, that have placeholders of which none has a value, and
    paragraphs that begin with a picture, `![...](NAME.png)`, which does not lie in the folder.
    """
    text = ""
    for section in re.split(r"(?m)^(?=##+ )", Path(module_file).with_name(template).read_text(encoding="utf-8")):
        names = [re.split(r"[.[]", name)[0] for _, name, _, _ in Formatter().parse(section) if name]
        if not (text and names) or any(parts.get(name, "") != "" for name in names):
            text += section.format(**parts)
    paragraphs = [
        paragraph
        for paragraph in re.split(r"\n{2,}", text.strip())
        if all((folder / picture).exists() for picture in re.findall(r"\A!\[.*?\]\((.*?)\)", paragraph))
    ]
    return "\n\n".join(paragraphs) + "\n"


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; every row has as many fields as the head."""
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def decimals(value: float | None) -> str:
    """A number with two decimals, or a dash where there is none."""
    return "–" if value is None else f"{value:.2f}"


def read_notes(folder: Path) -> str:
    """An experiment's notes.md: remarks by hand, which no number shows. A heading on top is no remark."""
    return _split_notes(folder)[1]


def read_title(folder: Path, default: str) -> str:
    """The heading on top of an experiment's notes.md, or the default where there is none."""
    return _split_notes(folder)[0] or default


def _split_notes(folder: Path) -> tuple[str, str]:
    notes = folder / "notes.md"
    text = notes.read_text(encoding="utf-8") if notes.exists() else ""
    first, _, rest = text.partition("\n")
    return (first[2:].strip(), rest.strip()) if first.startswith("# ") else ("", text.strip())


def describe_errors(result: Mapping[str, Any]) -> str:
    """Trials that failed, and why, a line each; whatever their errors say is shown as it is."""
    lines = (", ".join(map(str, error.values())) for error in result["errors"])
    return "\n".join(f"- `{''.join(c if c.isprintable() and c != '`' else ' ' for c in line)}`" for line in lines)


def describe_machine(machine: Mapping[str, Any]) -> str:
    """Hardware and versions in a line."""
    versions = ", ".join(f"{name} {machine[name]}" for name in ("python", "torch", "numpy"))
    counts = (f"{machine[key]} {key.removesuffix('s') if machine[key] == 1 else key}" for key in ("cores", "threads"))
    gpu = f", {machine['gpu']}" if machine.get("gpu") else ""
    return f"{machine['processor']}, {', '.join(counts)}{gpu}; {versions}"


def describe_command(*results: Mapping[str, Any]) -> str:
    """How to reproduce results, what that takes where it is known, and where the last of them was measured."""
    hours = sum(run.get("cpu_seconds", 0) for result in results for run in result.get("runs", ())) / 3600
    cost = f"That takes {hours:.1f} CPU hours. " if hours else ""
    commands = "\n".join(result["command"] for result in results)
    return (
        f"```bash\n{commands}\n```\n\n{cost}A command that was stopped goes on where it was. `edge-se bench report` "
        f"with this folder writes this page again.\n\nMeasured on: {describe_machine(results[-1]['machine'])}."
    )
