"""Where in a scene folder something is wrong, and the one-line error that says so."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass
from pathlib import Path

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
        """The location of the member `key` of the object at this location."""
        if not key.isidentifier() or len(key) > 80:
            return SourceLocation(self.file, f"{self.field}[{quote(key)}]")
        return SourceLocation(self.file, f"{self.field}.{key}" if self.field else key)

    def item(self, index: int) -> SourceLocation:
        """The location of element `index` of the list at this location."""
        return SourceLocation(self.file, f"{self.field}[{index}]")

    def error(self, problem: str, hint: str) -> InputError:
        """The error "<file>: <field>: <problem>; <hint>", in one line; `hint` says what to do."""
        file = str(self.file)
        file = file if file.isprintable() else repr(file)[1:-1]
        file = file if len(file) <= 300 else "..." + file[-300:]  # the end of a path says more than its start
        return InputError(f"{': '.join(filter(None, (file, self.field)))}: {problem}; {hint}")


@dataclass(frozen=True)
class SourceFile:
    """A file to read, and where it is named."""

    path: Path
    """With links resolved."""
    location: SourceLocation
    """The field that names the file; the file itself if none does."""
    name: str = ""
    """How the field names it; "" if none does."""

    def error(self, problem: str, hint: str) -> InputError:
        """The error at the location about this file."""
        return self.location.error(f"{quote(self.name)} {problem}" if self.name else problem, hint)

    def read_bytes(self) -> bytes:
        """All of its bytes; InputError for a file that is missing, empty, unreadable, or not regular."""
        try:
            if self.path.is_dir():
                raise self.error("is a directory", "a file is expected there")
            if self.path.exists() and not self.path.is_file():  # reading a pipe would block
                raise self.error("is not a regular file", "a plain file is expected there")
            data = self.path.read_bytes()
        except FileNotFoundError:
            raise self.error("does not exist", "put the file there or correct the path") from None
        except OSError as error:
            reason = (error.strerror or type(error).__name__).lower()
            raise self.error(f"cannot be read ({reason})", "check the file and its permissions") from None
        if not data:
            raise self.error("is empty (0 bytes)", "copy or download it again")
        return data
