"""The exception for bad input."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager


class InputError(ValueError):
    """A flag, file or argument cannot be used: one line that says what is wrong, where, and what to do. Exit code 2."""


def check_known(flag: str, names: Sequence[object], known: Iterable[object]) -> None:
    """InputError if one of the names given to a flag is not a known one."""
    known = tuple(known)
    for name in names:
        if name not in known:
            raise InputError(f"--{flag}: {name!r} is none of {', '.join(map(str, known))}")


def check_value(flag: str, value: object, valid: bool, rule: str) -> None:
    """InputError if a flag's value is not valid; the rule says what it must be."""
    if not valid:
        raise InputError(f"--{flag} is {value}: must be {rule}")


@contextmanager
def os_errors_as_input_errors(failure: str) -> Iterator[None]:
    """Turn an OSError into an InputError: what failed, as "FILE: cannot be written", and the system's reason."""
    try:
        yield
    except OSError as problem:
        raise InputError(f"{failure} ({problem.strerror or problem})") from problem
