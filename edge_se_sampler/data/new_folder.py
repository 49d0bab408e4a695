"""New folders that appear whole or not at all, and never overwrite anything."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from edge_se_sampler.errors import InputError


@contextmanager
def staged_folders(out: Path, targets: Sequence[Path]) -> Iterator[Path]:
    """A temporary folder inside `out` in which to write workspace/<name> of every target; at the end they are moved.
    On any exception nothing is left behind. InputError if a target is there and not empty, or no longer empty at the
    end, or `out` cannot be written, be it that the disk is full or a name too long."""
    _check_not_taken(out, targets)
    missing, moved = [folder for folder in (out, *out.parents) if not folder.exists()], []
    try:
        try:
            out.mkdir(parents=True, exist_ok=True)
            workspace = tempfile.TemporaryDirectory(prefix=".partial-", dir=out)
        except OSError as error:
            raise InputError(f"out is {out}, which cannot be written ({error.strerror}): give another") from error
        with workspace:
            yield Path(workspace.name)
            for target in targets:
                if target.exists():
                    target.rmdir()  # empty, or this raises
                (Path(workspace.name) / target.name).rename(target)
                moved.append(target)
    except BaseException as error:
        for folder in moved:
            shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError):  # other programs' files have come in between: they stay
            for folder in missing:
                folder.rmdir()
        if isinstance(error, OSError) and not isinstance(error, BrokenPipeError):
            is_full = error.errno in (errno.ENOSPC, errno.EDQUOT)
            problem = "whose disk is full" if is_full else f"which cannot be written ({error})"
            remedy = "shorten that name, or give another" if error.errno == errno.ENAMETOOLONG else "give another"
            raise InputError(f"out is {out}, {problem}: nothing was left there; {remedy}") from error
        raise


@contextmanager
def unless_made_meanwhile(folder: Path) -> Iterator[None]:
    """What makes a folder may fail where another process has made it."""
    try:
        yield
    except InputError:
        if not folder.exists():
            raise


def _check_not_taken(out: Path, targets: Sequence[Path]) -> None:
    try:
        existing = next(folder for folder in (out, *out.absolute().parents) if os.path.lexists(folder))
        if not existing.is_dir():
            raise InputError(f"out is {out}, but {existing} is not a folder: give a folder, or a path that is free")
        if not os.access(existing, os.W_OK | os.X_OK):
            raise InputError(f"out is {out}, but {existing} is not writable: give a folder that is")
        for target in targets:
            empty_folder = target.is_dir() and not target.is_symlink() and not any(target.iterdir())
            if os.path.lexists(target) and not empty_folder:
                raise InputError(
                    f"{target} is there already and is never overwritten: remove it, or write to another folder"
                )
    except OSError as error:
        raise InputError(f"out is {out}, which cannot be read ({error.strerror}): give another folder") from error
