"""The exception for bad input."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


class InputError(ValueError):
    """A flag, file or argument cannot be used.

    The message is one line: what is wrong, where (file and field), and what to do. The command line prints it on
    stderr and exits with code 2.
    """


def check_known(flag: str, names: Sequence[object], known: Iterable[object]) -> None:
    """Check that the names given to a flag are known ones.

    Raises:
        InputError: one is not.
    """
    known = tuple(known)
    for name in names:
        if name not in known:
            raise InputError(f"--{flag}: {name!r} is none of {', '.join(map(str, known))}")


def check_value(flag: str, value: object, valid: bool, rule: str) -> None:
    """Refuse a flag's value.

    Args:
        rule: what it must be, for the message.

    Raises:
        InputError: it is not valid.
    """
    if not valid:
        raise InputError(f"--{flag} is {value}: must be {rule}")
