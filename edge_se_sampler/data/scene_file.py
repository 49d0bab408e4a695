"""Files of a scene folder, the values of its json, and one-line errors that name file, field, problem and remedy."""

from __future__ import annotations

import json
import math
import os
import reprlib
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from edge_se_sampler.errors import InputError

_short = reprlib.Repr()
_short.maxstring = _short.maxother = _short.maxlong = 80
_short.maxlist = _short.maxdict = 4
_short.maxlevel = 3


def quote(value: object) -> str:
    """`value` for an error message: escaped by repr, shortened, on one line."""
    return _short.repr(value)


@dataclass(frozen=True)
class SourceLocation:
    """A file, and a field inside it such as `frames[3].transform_matrix` ("" is the whole file)."""

    file: Path
    field: str = ""

    def member(self, key: str) -> SourceLocation:
        if not key.isidentifier() or len(key) > 80:
            return SourceLocation(self.file, f"{self.field}[{quote(key)}]")
        return SourceLocation(self.file, f"{self.field}.{key}" if self.field else key)

    def item(self, index: int) -> SourceLocation:
        return SourceLocation(self.file, f"{self.field}[{index}]")

    def error(self, problem: str, hint: str) -> InputError:
        """The error "<file>: <field>: <problem>; <hint>", in one line; `hint` says what to do."""
        file = str(self.file)
        file = file if file.isprintable() else repr(file)[1:-1]
        file = file if len(file) <= 300 else "..." + file[-300:]  # the end of a path says more than its start
        return InputError(f"{': '.join(filter(None, (file, self.field)))}: {problem}; {hint}")


@dataclass(frozen=True)
class SourceFile:
    path: Path  # with links resolved
    location: SourceLocation  # the field that names the file; the file itself if none does
    name: str = ""  # how the field names it; "" if none does

    def error(self, problem: str, hint: str) -> InputError:
        return self.location.error(f"{quote(self.name)} {problem}" if self.name else problem, hint)

    def is_there(self) -> bool:
        """Whether it exists; InputError if that cannot be seen, as in a folder that may not be read."""
        try:
            os.stat(self.path)
        except PermissionError:
            raise self.error("cannot be read (permission denied)", "check the permissions") from None
        except (OSError, ValueError):  # a name that is too long, for one
            return False
        return True

    def check_regular(self) -> None:
        """InputError for a directory or a pipe, which reading would wait for."""
        if self.path.is_dir():
            raise self.error("is a directory", "a file is expected there")
        if self.path.exists() and not self.path.is_file():
            raise self.error("is not a regular file", "a plain file is expected there")

    def read_bytes(self) -> bytes:
        """All of its bytes; InputError for a file that is missing, empty, unreadable, or not regular."""
        try:
            self.check_regular()
            data = self.path.read_bytes()
        except FileNotFoundError:
            raise self.error("does not exist", "put the file there or correct the path") from None
        except OSError as error:
            reason = (error.strerror or type(error).__name__).lower()
            raise self.error(f"cannot be read ({reason})", "check the file and its permissions") from None
        if not data:
            raise self.error("is empty (0 bytes)", "copy or download it again")
        return data


def check_folder(folder: Path) -> None:
    """InputError if that is no folder that may be read."""
    location, hint = SourceLocation(folder), "give the folder of a scene"
    if not os.path.lexists(folder):
        raise location.error("no such folder", hint)
    if not os.path.isdir(folder):
        raise location.error("is not a folder", hint)
    if not os.access(folder, os.R_OK | os.X_OK):
        raise location.error("may not be read (permission denied)", "change the folder's permissions")


def locate_file(folder: Path, listed: str, location: SourceLocation) -> SourceFile:
    """The file that is listed, relative to `folder`; InputError if that lies outside it, be it through a link, or if no
    file can have that name."""
    if "\0" in listed:
        raise location.error(f"has characters that no file name can have: {quote(listed)}", "name an image's file")
    if os.path.isabs(listed):
        raise location.error(f"{quote(listed)} is an absolute path", "write it relative to the folder")
    file = SourceFile(Path(os.path.realpath(folder / listed)), location, listed)
    if not file.path.is_relative_to(os.path.realpath(folder)):
        raise file.error("leads out of the folder", "put the file into the folder")
    return file


def check_listed_once(files: Iterable[SourceFile]) -> None:
    """InputError if two of the files are the same one, be it through a link."""
    first: dict[Path, SourceFile] = {}
    for file in files:
        if (other := first.setdefault(file.path, file)) is not file:
            raise file.error(f"is already the image of {other.location.field}", "list every image once")


MAX_JSON = 2**27
"""Bytes of a file: 100,000 cameras."""


@dataclass(frozen=True)
class JsonValue:
    """A json value and its location. All methods raise InputError, which names the location, for other values."""

    value: Any
    location: SourceLocation

    def object(self) -> dict[str, Any]:
        if not isinstance(self.value, dict):
            raise self._expected("a json object", "write {...} with its named fields")
        return self.value

    def list(self) -> list[JsonValue]:
        if not isinstance(self.value, list):
            raise self._expected("a list", "write [...]")
        return [JsonValue(item, self.location.item(i)) for i, item in enumerate(self.value)]

    def optional(self, key: str) -> JsonValue | None:
        """The member `key` of an object, None if it has no such member."""
        return JsonValue(self.value[key], self.location.member(key)) if key in self.object() else None

    def required(self, key: str, hint: str) -> JsonValue:
        """The member `key` of an object; `hint` says what to add if it is missing."""
        member = self.optional(key)
        if member is None:
            raise self.location.member(key).error("is missing", hint)
        return member

    def number(self) -> float:
        """A finite number; true and false are none."""
        if isinstance(self.value, bool) or not isinstance(self.value, (int, float)):
            raise self._expected("a number", "write a plain number without quotes")
        try:
            return float(self.value)
        except OverflowError:
            raise self._expected("a finite number", "write a number that fits a double") from None

    def unquoted(self) -> JsonValue:
        """The finite number that a text is; what is none stays as it is."""
        with suppress(ValueError):
            if isinstance(self.value, str) and math.isfinite(number := float(self.value)):
                return replace(self, value=number)
        return self

    def positive_number(self) -> float:
        if (number := self.number()) <= 0:
            raise self._expected("positive", "write a number above 0")
        return number

    def count(self) -> int:
        """A whole number from 1; 800.0 is one, as instant-ngp's tools write it."""
        if not (number := self.positive_number()).is_integer():
            raise self._expected("a whole number", "write an integer of at least 1")
        return int(number)

    def file_path(self) -> str:
        """Text that can name a file: not empty, no NUL, no lone surrogate."""
        hint = "write the path of a file, relative to the folder"
        if not isinstance(self.value, str) or not self.value.strip():
            raise self._expected("non-empty text", hint)
        if "\0" in self.value or any("\ud800" <= char <= "\udfff" for char in self.value):
            raise self.location.error(f"has characters that no file name can have: {quote(self.value)}", hint)
        return self.value

    def _expected(self, kind: str, hint: str) -> InputError:
        return self.location.error(f"must be {kind}, not {quote(self.value)}", hint)


def read_json(path: Path) -> JsonValue:
    """The json object that a file holds; InputError if the file cannot be read or holds anything else."""
    location = SourceLocation(path)
    if path.is_file() and path.stat().st_size > MAX_JSON:
        raise location.error(f"has more than {MAX_JSON >> 20} MiB", "a json of cameras or settings is expected")
    data = SourceFile(path, location).read_bytes()
    try:
        value = json.loads(data.decode("utf-8-sig"))  # a byte order mark, which Windows editors add, does no harm
    except UnicodeDecodeError as error:
        raise location.error(f"is not UTF-8 text (byte {error.start})", "save the file as UTF-8") from None
    except json.JSONDecodeError as error:
        position = f"line {error.lineno} column {error.colno}"
        raise location.error(f"is not valid json: {error.msg} at {position}", "correct the file there") from None
    except RecursionError:
        raise location.error("is nested too deeply", "a list of frames is expected, each an object") from None
    except ValueError:  # Python's limit on the digits of an integer
        raise location.error("has an integer of thousands of digits", "write numbers that fit a double") from None
    top = JsonValue(value, location)
    _check_finite(top)
    top.object()
    return top


def _check_finite(top: JsonValue) -> None:
    """Raise InputError for NaN, Infinity and 1e400, which Python's json lets through."""
    pending = [top]  # not recursive: the nesting may be deeper than Python's stack
    while pending:
        entry = pending.pop()
        if _is_infinite(entry.value):
            problem = "is NaN, Infinity or too large a number"
            raise entry.location.error(problem, "every number in the file must be finite")
        # other values have no location made for them: of millions, these would take memory
        if isinstance(entry.value, dict):
            items = entry.value.items()
            pending += [JsonValue(item, entry.location.member(key)) for key, item in items if _is_looked_into(item)]
        elif isinstance(entry.value, list):
            items = enumerate(entry.value)
            pending += [JsonValue(item, entry.location.item(i)) for i, item in items if _is_looked_into(item)]


def _is_looked_into(value: Any) -> bool:
    return isinstance(value, (dict, list)) or _is_infinite(value)


def _is_infinite(value: Any) -> bool:
    return isinstance(value, float) and not math.isfinite(value)
