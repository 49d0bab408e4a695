"""Reading a json file, and the small checks that its fields must pass.

Every check has the form check(value, where) -> value and raises InputError naming `where`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from edge_se_sampler.data.source_location import Where, read_bytes, shown
from edge_se_sampler.errors import InputError

T = TypeVar("T")
Object = dict[str, Any]
Check = Callable[[Any, Where], T]


def load_object(where: Where) -> Object:
    """The json object that the file `where.file` holds; InputError if it holds anything else."""
    data = read_bytes(where.file, where)
    try:
        top = json.loads(data.decode("utf-8-sig"))  # a byte order mark, which Windows editors add, does no harm
    except UnicodeDecodeError as error:
        raise where.error(f"is not UTF-8 text (byte {error.start})", "save the file as UTF-8") from None
    except json.JSONDecodeError as error:
        place = f"line {error.lineno} column {error.colno}"
        raise where.error(f"is not valid json: {error.msg} at {place}", "correct the file there") from None
    except RecursionError:
        raise where.error("is nested too deeply", "a list of frames is expected, each an object") from None
    except ValueError:  # Python's limit on the digits of an integer
        raise where.error("has an integer of thousands of digits", "write numbers that fit a double") from None
    for place in _not_finite(top, where):
        raise place.error("is NaN, Infinity or too large a number", "every number in the file must be finite")
    return as_object(top, where)


def _not_finite(top: object, where: Where) -> Iterator[Where]:
    """The places of NaN, Infinity and 1e400, which Python's json lets through."""
    todo = [(top, where)]  # a stack of our own: the nesting may be deeper than Python's
    while todo:
        value, place = todo.pop()
        if isinstance(value, float) and not math.isfinite(value):
            yield place
        elif isinstance(value, dict):
            todo.extend((item, place.key(key)) for key, item in value.items())
        elif isinstance(value, list):
            todo.extend((item, place.item(i)) for i, item in enumerate(value))


def required(parent: Object, key: str, where: Where, check: Check[T], hint: str) -> T:
    """The checked member `key` of `parent`, which lies at `where`; `hint` says what to add if it is missing."""
    if key not in parent:
        raise where.key(key).error("is missing", hint)
    return check(parent[key], where.key(key))


def optional(parent: Object, key: str, where: Where, check: Check[T]) -> T | None:
    """As required(), but None if `parent` has no such member."""
    return check(parent[key], where.key(key)) if key in parent else None


def as_object(value: Any, where: Where) -> Object:
    if not isinstance(value, dict):
        raise _unlike(value, where, "a json object", "write {...} with its named fields")
    return value


def as_list(value: Any, where: Where) -> list[Any]:
    if not isinstance(value, list):
        raise _unlike(value, where, "a list", "write [...]")
    return value


def number(value: Any, where: Where) -> float:
    """A finite number; true and false are none."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _unlike(value, where, "a number", "write a plain number without quotes")
    try:
        return float(value)
    except OverflowError:
        raise _unlike(value, where, "a finite number", "write a number that fits a double") from None


def positive(value: Any, where: Where) -> float:
    result = number(value, where)
    if result <= 0:
        raise _unlike(value, where, "positive", "write a number above 0")
    return result


def count(value: Any, where: Where) -> int:
    """A whole number from 1; 800.0 is one, as instant-ngp's tools write it."""
    result = positive(value, where)
    if not result.is_integer():
        raise _unlike(value, where, "a whole number", "write an integer of at least 1")
    return int(result)


def path_text(value: Any, where: Where) -> str:
    """Text that can name a file: not empty, no NUL, no lone surrogate."""
    hint = "write the path of a file, relative to the folder"
    if not isinstance(value, str) or not value.strip():
        raise _unlike(value, where, "non-empty text", hint)
    if "\0" in value or any("\ud800" <= char <= "\udfff" for char in value):
        raise where.error(f"has characters that no file name can have: {shown(value)}", hint)
    return value


def _unlike(value: object, where: Where, wanted: str, hint: str) -> InputError:
    return where.error(f"must be {wanted}, not {shown(value)}", hint)
