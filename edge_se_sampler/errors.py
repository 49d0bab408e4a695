"""The one exception that speaks to a person."""

from __future__ import annotations


class InputError(ValueError):
    """Something a person gave cannot be used.

    The message is one line: what is wrong, where (file and field), what to do. The command line prints it on
    stderr and leaves with exit code 2; a library caller catches it as a ValueError.
    """
