"""Where in a scene folder something is wrong, and how that is told in one line."""

from __future__ import annotations

import os
import reprlib
import stat
from dataclasses import dataclass
from pathlib import Path

from edge_se_sampler.errors import InputError

_MAX_PATH = 300  # characters of a path worth printing; its end says more than its start

_short = reprlib.Repr()
_short.maxstring = _short.maxother = _short.maxlong = 80
_short.maxlist = _short.maxdict = 4
_short.maxlevel = 3


def shown(value: object) -> str:
    """`value` as it may be echoed in a message: escaped by repr, shortened, on one line."""
    return _short.repr(value)


def shown_path(path: Path | str) -> str:
    """A path as it may be echoed: bare if printable, else escaped; an overlong one keeps its end."""
    text = str(path)
    text = text if text.isprintable() else repr(text)[1:-1]
    return text if len(text) <= _MAX_PATH else "..." + text[-_MAX_PATH:]


@dataclass(frozen=True)
class Where:
    """A place: a file, and a field inside it such as `frames[3].transform_matrix` ("" is the whole file)."""

    file: Path
    field: str = ""

    def key(self, name: str) -> Where:
        """The member `name` of the object that is here."""
        if not name.isidentifier() or len(name) > 80:
            return Where(self.file, f"{self.field}[{shown(name)}]")
        return Where(self.file, f"{self.field}.{name}" if self.field else name)

    def item(self, index: int) -> Where:
        """Element `index` of the list that is here."""
        return Where(self.file, f"{self.field}[{index}]")

    def error(self, problem: str, hint: str) -> InputError:
        """The error to raise; `problem` goes on after the place ("is missing"), `hint` says what to do."""
        place = ": ".join(filter(None, (shown_path(self.file), self.field)))
        return InputError(f"{place}: {problem}; {hint}")


def read_bytes(path: Path, where: Where, name: str = "") -> bytes:
    """All bytes of a file.

    `where` is the place that names the file, and `name` what that place calls it ("" if it is the file).
    Raises InputError for a file that is missing, empty, unreadable, or no regular file (a pipe would block).
    """
    who = f"{shown(name)} " if name else ""
    try:
        mode = os.stat(path).st_mode
        if stat.S_ISDIR(mode):
            raise where.error(f"{who}is a directory", "a file is expected there")
        if not stat.S_ISREG(mode):
            raise where.error(f"{who}is not a regular file", "a plain file is expected there")
        data = path.read_bytes()
    except FileNotFoundError:
        raise where.error(f"{who}does not exist", "put the file there or correct the path") from None
    except OSError as error:
        reason = (error.strerror or type(error).__name__).lower()
        raise where.error(f"{who}cannot be read ({reason})", "check the file and its permissions") from None
    if not data:
        raise where.error(f"{who}is empty (0 bytes)", "copy or download it again")
    return data
