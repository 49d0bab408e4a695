"""The one exception that speaks to a person."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


class InputError(ValueError):
    """Something a person gave cannot be used.

    The message is one line: what is wrong, where (file and field), what to do. The command line prints it on
    stderr and leaves with exit code 2; a library caller catches it as a ValueError.
    """


def check_known(flag: str, chosen: Sequence[object], known: Iterable[object]) -> None:
    """Refuse names that are not known.

    Raises:
        InputError: one is none of them.
    """
    known = tuple(known)
    for name in chosen:
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
