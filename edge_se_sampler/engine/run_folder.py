"""A run's folder: outputs/<experiment>/<method>/<timestamp>/ with config.json, metrics.jsonl, checkpoints, previews,
and TensorBoard's event files."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import os
import shutil
import sys
import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from edge_se_sampler.data.scene_file import SourceFile, SourceLocation, locate_file, quote, read_json
from edge_se_sampler.engine.config import MAX_INTEGER, TrainerConfig
from edge_se_sampler.engine.files import checksum, write_atomically, write_json
from edge_se_sampler.errors import InputError, os_errors_as_input_errors

FORMAT, OLDEST_FORMAT = 3, 2
"""Of runs: the one written, and the oldest that is read. Format 2, without a number, has no checksums but those of
checkpoints."""


@dataclass(frozen=True)
class RunFolder:
    path: Path

    @classmethod
    def create(cls, config: TrainerConfig) -> RunFolder:
        """A new folder for a resolved config; nothing existing is touched. InputError if it cannot be written."""
        parent = config.output_dir / str(config.experiment_name) / config.method_name
        with os_errors_as_input_errors(f"--output-dir {config.output_dir}: cannot be written"):
            parent.mkdir(parents=True, exist_ok=True)
            run = cls(_new_folder(parent, time.strftime("%Y-%m-%d_%H%M%S")))
            try:
                (run.path / "checkpoints").mkdir()
                (run.path / "previews").mkdir()
                run.write_config(config)
            except BaseException:
                shutil.rmtree(run.path, ignore_errors=True)
                raise
        return run

    def write_config(self, config: TrainerConfig) -> None:
        """Write config.json; InputError if that fails."""
        values = {"format": FORMAT, **config_to_json(config)}
        write_json(self.path / "config.json", {**values, "checksum": checksum(values)})

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoints"

    def config(self, method_configs: Mapping[str, TrainerConfig]) -> TrainerConfig:
        """The run's settings, typed as its method's defaults; InputError if there are none of this version, or they are
        not as they were written. Who changes them by hand removes the checksum."""
        path = self.path / "config.json"
        if not self.path.is_dir():
            raise InputError(f"{self.path}: no such run folder; edge-se train prints where a run lands")
        if not path.exists():
            raise InputError(f"{self.path}: not a run folder (no config.json); edge-se train prints it")
        for name in ("config.json", "metrics.jsonl", "checkpoints", "previews"):
            locate_file(self.path, name, SourceLocation(self.path))
        written = read_json(path).object()
        claimed = written.pop("checksum", None)
        number = written.get("format", OLDEST_FORMAT)
        if number not in range(OLDEST_FORMAT, FORMAT + 1):
            problem = f"its format is {quote(number)}, this version reads {OLDEST_FORMAT} to {FORMAT}"
            raise InputError(f"{path}: {problem}")
        values = {key: value for key, value in written.items() if key != "format"}
        name = values.get("method_name")
        default = method_configs.get(str(name))
        if default is None:
            problem = f"method_name is {quote(name)}, which is not registered here"
            raise InputError(f"{path}: {problem}; see edge-se methods")
        config = config_from_json(default, values, f"{path}")
        if claimed not in (None, checksum(written)):
            remedy = 'restore it, or, if you did, remove its "checksum"'
            raise InputError(f"{path}: changed since it was written (checksum); {remedy}")
        if config.pipeline.model.size == "auto":
            raise InputError(f"{path}: the model's size is auto, and a run's is decided; restore it")
        try:
            config.check()
        except InputError as problem:
            raise InputError(f"{path}: {problem}") from problem
        return config

    def log(self, line: dict[str, Any]) -> None:
        """Append a line to metrics.jsonl; InputError if it cannot be written."""
        path = self.path / "metrics.jsonl"
        with os_errors_as_input_errors(f"{path}: cannot be written"), open(path, "a", encoding="utf-8") as file:
            file.write(_checked_line(line))

    def metrics(self) -> list[dict[str, Any]]:
        """The lines of metrics.jsonl; a last line cut short by a kill is left out, and that is said. InputError if one
        is not as it was written."""
        path = self.path / "metrics.jsonl"
        if not path.exists():
            return []
        SourceFile(path, SourceLocation(path)).check_regular()
        try:
            has_checksums = read_json(self.path / "config.json").object().get("format", 2) > 2
            *complete, rest = path.read_text(encoding="utf-8").split("\n")
            lines = [json.loads(line) for line in complete]
            for line in lines:
                claimed = line.pop("crc32", None)
                is_checked = claimed == _crc32(line) or (claimed is None and not has_checksums)
                if not isinstance(line["step"], int) or not is_checked:
                    raise ValueError(f"the line of step {line['step']} is not as it was written")
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as problem:
            raise InputError(f"{path}: damaged ({quote(str(problem))}); mend or remove it") from problem
        if rest:
            print(f"edge-se: {path}: its last line was cut short and is left out", file=sys.stderr)
        return lines

    def drop_metrics_after(self, step: int) -> None:
        """Drop the metrics of later steps, which a resumed run writes again."""
        kept = [_checked_line(line) for line in self.metrics() if line["step"] <= step]
        write_atomically(self.path / "metrics.jsonl", "".join(kept).encode())


class EventWriter:
    """Writes the numbers of metrics.jsonl's lines as TensorBoard's scalars; nothing without the extra, nor in a folder
    whose name is no text. What was written of first_step and later ones is no longer shown."""

    def __init__(self, folder: Path, first_step: int | None = None) -> None:
        self._folder, self._first_step, self._writer = folder, first_step, None
        is_text = os.fsencode(folder).decode(errors="replace") == str(folder)  # others TensorBoard cannot name
        self._can_write = is_text and find_spec("tensorboard") is not None

    def write(self, line: dict[str, Any]) -> None:
        if not self._can_write:
            return
        with os_errors_as_input_errors(f"{self._folder}: TensorBoard's events cannot be written"):
            if self._writer is None:
                try:
                    from torch.utils.tensorboard import SummaryWriter
                except Exception as problem:  # whatever another version of what it needs does
                    reason = " ".join(str(problem).split())
                    print(f"edge-se: tensorboard cannot be used ({reason}): no events are written", file=sys.stderr)
                    self._can_write = False
                    return
                self._writer: Any = SummaryWriter(str(self._folder), purge_step=self._first_step)
                with contextlib.suppress(AttributeError):  # its thread's failure is raised here: printed once is enough
                    self._writer.file_writer.event_writer._async_writer._worker._invoke_excepthook = lambda _: None
            for key, value in line.items():
                if key != "step" and isinstance(value, int | float):
                    self._writer.add_scalar(key, value, line["step"])

    def close(self) -> None:
        if self._writer is not None:
            with os_errors_as_input_errors(f"{self._folder}: TensorBoard's events cannot be written"):
                self._writer.close()


def _new_folder(parent: Path, name: str) -> Path:
    """Create parent/name, or the first of name-1, name-2, ... that does not exist."""
    paths = (parent / (f"{name}-{attempt}" if attempt else name) for attempt in itertools.count())
    while True:
        with contextlib.suppress(FileExistsError):
            path = next(paths)
            path.mkdir()
            return path


def _crc32(line: dict[str, Any]) -> str:
    return f"{zlib.crc32(json.dumps(line, allow_nan=False).encode()):08x}"


def _checked_line(line: dict[str, Any]) -> str:
    """A line of metrics.jsonl, with a checksum of the rest as its last entry."""
    return json.dumps({**line, "crc32": _crc32(line)}) + "\n"


def config_to_json(config: TrainerConfig) -> dict[str, Any]:
    """Its settings; not fields with an underscore, such as the `_target` of a pixel sampler of nerfstudio's."""
    settings = dataclasses.asdict(config, dict_factory=lambda items: {k: v for k, v in items if k[0] != "_"})
    return json.loads(json.dumps(settings, default=os.fspath))


def config_digest(config: TrainerConfig) -> str:
    """A hash of every setting that a resumed run must share: not of paths, when to stop, checkpoints and the device."""
    values = config_to_json(config)
    _drop_added_defaults(config, values)
    for name in ("output_dir", "data", "max_seconds", "steps_per_save", "new_num_iterations", "patience", "min_gain"):
        values.pop(name, None)
    if config.time_budget is not None:
        del values["segments"]  # known at the end only
    del values["machine"]["device_type"]
    return checksum(values)


def _drop_added_defaults(config: Any, values: dict[str, Any]) -> None:
    """Drop the defaults of fields that were added later: earlier versions wrote digests without them."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            _drop_added_defaults(value, values[field.name])
        elif field.metadata.get("added_later") and value == field.default:
            del values[field.name]


def config_from_json(default: Any, values: Any, where: str) -> Any:
    """The config that `config_to_json` turned into values; InputError if fields are missing, unknown or mistyped.
    Fields that were added later may be missing: they have their defaults."""
    types = get_type_hints(type(default))
    fields = [field for field in dataclasses.fields(default) if field.name[0] != "_"]
    hints = {field.name: types[field.name] for field in fields}
    if isinstance(values, dict):
        values = {f.name: f.default for f in fields if f.metadata.get("added_later")} | values
    if not isinstance(values, dict) or set(values) != set(hints):
        differing = quote(sorted(set(values) ^ set(hints)) if isinstance(values, dict) else "not an object")
        raise InputError(f"{where}: written by another version of edge-se or edited by hand (fields: {differing})")
    chosen = {}
    for name, hint in hints.items():
        old, new = getattr(default, name), values[name]
        if dataclasses.is_dataclass(old):
            chosen[name] = config_from_json(old, new, f"{where}: {name}")
            continue
        try:
            chosen[name] = _typed(new, hint)
        except ValueError:
            problem = f"{name} is {quote(new)}, where {quote(old)} would be of its type"
            raise InputError(f"{where}: {problem}; was it edited by hand?") from None
    return dataclasses.replace(default, **chosen)


def _typed(value: Any, hint: Any) -> Any:
    """A json value as the type that a field is annotated with; ValueError if it cannot be one."""
    options = get_args(hint)
    if get_origin(hint) is Literal:
        if isinstance(value, str) and value in options:
            return value
    elif get_origin(hint) is tuple and isinstance(value, list):
        kinds = options[:1] * len(value) if options[-1] is Ellipsis else options
        return tuple(_typed(item, kind) for item, kind in zip(value, kinds, strict=True))
    elif get_origin(hint) in (Union, UnionType):
        for option in options:
            with contextlib.suppress(ValueError):
                return _typed(value, option)
    elif hint is Path and isinstance(value, str) and "\0" not in value:
        return Path(value)
    elif (type(value) is hint or (type(value), hint) == (int, float)) and not (
        isinstance(value, int) and abs(value) >= MAX_INTEGER
    ):
        return value
    raise ValueError
