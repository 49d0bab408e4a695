"""Values of a json file that know where they stand, so that every check can name the field that fails it."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edge_se_sampler.data.source_location import SourceFile, SourceLocation, quote
from edge_se_sampler.errors import InputError


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
        if isinstance(entry.value, dict):
            pending += [JsonValue(item, entry.location.member(key)) for key, item in entry.value.items()]
        elif isinstance(entry.value, list):
            pending += entry.list()
        elif isinstance(entry.value, float) and not math.isfinite(entry.value):
            problem = "is NaN, Infinity or too large a number"
            raise entry.location.error(problem, "every number in the file must be finite")
