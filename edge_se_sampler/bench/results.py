"""The json files that experiments and benchmarks write: read only as they were written, and with texts that a page can
show.

run     what identifies a training (a trial's fields), and what was measured of it

Free of torch until a result is created.
"""

from __future__ import annotations

import json
import re
import shlex
import sys
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.machine import machine
from edge_se_sampler.data.scene_file import quote, read_json
from edge_se_sampler.engine.files import checksum, write_atomically
from edge_se_sampler.errors import InputError

VERSION = 3
"""Of results. Version 2, which is read as well, has no checksum."""
PLAIN = re.compile(r"[\w .,:;=+/()%'\"~@-]*")
"""Texts without marks of Markdown and HTML."""

Run = dict[str, Any]


def load_or_create(path: Path, experiment: str, settings: Any) -> dict[str, Any]:
    """The result of an earlier call with the same settings (a dataclass), or an empty one; InputError if the file is no
    result, or one of another version, experiment or settings, or a page could not show these."""
    defaults = {setting.name: setting.default for setting in fields(settings) if isinstance(setting.default, str)}
    settings = json.loads(json.dumps(asdict(settings)))
    refuse_marks(experiment, settings)
    if not path.exists():
        return new_result(experiment, settings) | {"errors": [], "runs": []}
    result = read_result(path)
    result["settings"] = {**defaults, **result["settings"]}  # earlier versions lack settings that came later
    if (result["experiment"], result["settings"]) != (experiment, settings):
        raise InputError(f"{path}: of another experiment or other settings; name another --output-dir, or move it away")
    result["command"] = "\n".join(dict.fromkeys([*result["command"].splitlines(), _command()]))
    return result


def new_result(experiment: str, settings: dict[str, Any]) -> dict[str, Any]:
    """What every json of results begins with; command: those that have trained it, one a line."""
    head = {"version": VERSION, "experiment": experiment, "command": _command()}
    return {**head, "settings": settings, "machine": machine()}


def _command() -> str:
    """The command line; InputError if a page could not show it."""
    command = shlex.join(["edge-se", *sys.argv[1:]])
    try:
        _check_command(command)
    except ValueError as problem:
        raise InputError(f"{problem}, which a page could not show; rename it") from problem
    return command


def refuse_marks(experiment: str, value: Any) -> None:
    """InputError if a page could not show a text in an experiment's settings or trials."""
    try:
        check_plain(value)
    except ValueError as problem:
        raise InputError(f"bench {experiment}: {problem}, which a page could not show; rename it") from problem


def read_result(path: Path) -> dict[str, Any]:
    """A result.json; InputError as `read_measured`, or if it has no runs and errors."""
    result = read_measured(path)
    entries = (result.get("runs"), result.get("errors"))
    if not all(isinstance(e, list) and all(isinstance(entry, dict) for entry in e) for e in entries):
        raise InputError(f"{path}: not a result of edge-se bench (runs and errors are lists of objects)")
    return result


def read_measured(path: Path) -> dict[str, Any]:
    """A json of results, of trainings or others; InputError if it cannot be read, is none of this version or the one
    before, or is not as it was written."""
    result = read_json(path).object()
    claimed = result.pop("checksum", None)
    try:
        if result["version"] not in (2, VERSION):
            raise ValueError(f"version {result['version']}, not {VERSION}")
        if claimed != (None if result["version"] == 2 else checksum(result)):
            raise ValueError("changed since it was written (checksum)")
        if not {"experiment", "command", "settings", "machine"} <= result.keys():
            raise KeyError("experiment, command, settings or machine")
        check_texts(result)
    except (ValueError, KeyError, TypeError, RecursionError) as problem:
        raise InputError(f"{path}: not a result of edge-se bench ({quote(problem)})") from problem
    return result


def check_texts(result: dict[str, Any]) -> None:
    """ValueError or TypeError if a result's texts could be more than that in a page, see `check_plain`."""
    check_plain({key: value for key, value in result.items() if key not in ("errors", "command")})
    _check_command(str(result["command"]).replace("\n", ""))


def _check_command(command: str) -> None:
    """ValueError if a command line could be more than that between a page's backticks."""
    if "`" in command or not command.isprintable():
        raise ValueError(f"a command with a backtick, or no text: {quote(command)}")


def check_plain(value: Any) -> None:
    """ValueError if a text in a json value could be more than text in a page or the name of a file: HTML, a link, a
    path that leads out."""
    if isinstance(value, dict):
        check_plain([*value, *value.values()])
    elif isinstance(value, list):
        for item in value:
            check_plain(item)
    elif isinstance(value, str) and (".." in value or not PLAIN.fullmatch(value)):
        raise ValueError(f"a text with marks: {quote(value)}")


def write_result(path: Path, result: dict[str, Any]) -> None:
    """result.json, every run on a line of its own; InputError if it cannot be written."""
    result = {**result, "version": VERSION}
    head = {key: value for key, value in result.items() if key != "runs"} | {"checksum": checksum(result)}
    head = json.dumps(head, indent=1, allow_nan=False)
    runs = ",\n".join(json.dumps(run, allow_nan=False) for run in result["runs"])
    write_atomically(path, f'{head[:-2]},\n "runs": [\n{runs}\n ]\n}}\n'.encode())
