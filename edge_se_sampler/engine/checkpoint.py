"""Checkpoints that are written completely or not at all, the newest and the one before.

A file is one line of text, "edge-se-checkpoint 3 <sha256 of the line so far and of the rest>", followed by torch.save's
bytes. It is written to a temporary file, flushed to the disk and renamed: a process killed at any moment leaves the old
file or the new one. It is loaded with weights_only=True: a pickle in it is refused, never run.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
import sys
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import torch

from edge_se_sampler.data.scene_file import SourceFile, SourceLocation, locate_file
from edge_se_sampler.engine.files import write_atomically
from edge_se_sampler.engine.saved_state import check_archive, check_tensors
from edge_se_sampler.errors import InputError, os_errors_as_input_errors

MAGIC = b"edge-se-checkpoint 3 "
MAGIC_2 = b"edge-se-checkpoint 2 "
"""Of format 2, whose checksum leaves out the line itself."""
NAME = re.compile(r"step-(\d{9,})\.ckpt")


def save_checkpoint(folder: Path, step: int, state: dict[str, Any]) -> Path:
    """Write the checkpoint after a step (0, 1, ...), and keep the one before beside it; InputError if that fails. Those
    of later steps are deleted as well: they were damaged, or the steps would not have been trained again."""
    path = folder / f"step-{step:09d}.ckpt"
    write_atomically(path, lambda file: _write(state, file))
    others = [other for other in _checkpoints(folder) if other != path]
    before = max((other for other in others if _step_of(other) < step), key=_step_of, default=None)
    with os_errors_as_input_errors(f"{folder}: older checkpoints cannot be deleted"):
        for other in (*others, *folder.glob(".step-*.tmp")):
            if other != before:
                other.unlink(missing_ok=True)
    return path


class _HashingWriter(io.RawIOBase):
    """Passes on what is written, and hashes it."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.digest = hashlib.sha256(MAGIC)
        self.problem: OSError | None = None

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self.digest.update(data)
        try:
            return self._file.write(data)
        except OSError as problem:
            self.problem = problem
            raise


def _write(state: dict[str, Any], file: BinaryIO) -> None:
    """The checkpoint's line and bytes, without a copy of these in memory: the line is written last."""
    file.write(MAGIC + b"0" * 64 + b"\n")
    writer = _HashingWriter(file)
    try:
        torch.save(state, writer)  # pyright: ignore[reportArgumentType]
    except RuntimeError as problem:  # torch's name for a write that failed
        raise writer.problem or problem from None
    file.seek(len(MAGIC))
    file.write(writer.digest.hexdigest().encode())


def latest_checkpoint(folder: Path) -> Path:
    """The checkpoint with the highest step; InputError if there is none."""
    latest = max(_checkpoints(folder), key=_step_of, default=None)
    if latest is None:
        raise InputError(f"{folder}: no checkpoint (step-*.ckpt); the run ended before its first was saved")
    return latest


class DamagedCheckpoint(InputError):
    """A checkpoint cannot be read, or is not as it was saved."""


def load_latest(folder: Path, config_digest: str) -> tuple[Path, dict[str, Any]]:
    """The newest checkpoint and its state; if it is damaged, those of the one before, with a line that says so.
    InputError if all are damaged, or as `load_checkpoint`."""
    latest_checkpoint(folder)
    damaged: list[DamagedCheckpoint] = []
    for path in sorted(_checkpoints(folder), key=_step_of, reverse=True):
        try:
            state = load_checkpoint(path, config_digest)
        except DamagedCheckpoint as problem:
            damaged.append(problem)
            continue
        if damaged:
            print(f"edge-se: {damaged[0]}; {path.name}, the one before, takes its place", file=sys.stderr)
        return path, state
    raise InputError(f"{damaged[0]}, and no other is whole; restore it or train again")


def load_checkpoint(path: Path, config_digest: str) -> dict[str, Any]:
    """Read a checkpoint; DamagedCheckpoint if it is unreadable or damaged, InputError if it holds a pickle, is none, or
    was saved under another configuration. It is read twice at once, for its checksum and for its tensors, so that
    memory holds these alone."""
    with ThreadPoolExecutor(1) as pool:
        checking = pool.submit(_check_sum, path)
        try:
            state = _load_archive(path)
        except Exception:
            checking.result()  # if it raises, too, that is the reason
            raise
        checking.result()
    if not isinstance(state, dict) or state.get("config_digest") != config_digest:
        raise InputError(f"{path}: saved under another configuration than the run's config.json; do not mix runs")
    try:
        check_tensors(state)
    except ValueError as problem:
        raise InputError(f"{path}: was not saved by a training ({problem}); do not use it") from problem
    return state


def _check_sum(path: Path) -> None:
    """DamagedCheckpoint if a checkpoint is none, or not as it was saved."""
    with _opened(path) as file:
        header = file.read(len(MAGIC) + 65)
        magic = header[: len(MAGIC)]
        if magic not in (MAGIC, MAGIC_2):
            raise DamagedCheckpoint(f"{path}: not a checkpoint of this version of edge-se")
        digest, block = hashlib.sha256(b"" if magic == MAGIC_2 else magic), memoryview(bytearray(2**20))
        while size := file.readinto(block):
            digest.update(block[:size])
    if header[len(MAGIC) :] != digest.hexdigest().encode() + b"\n":
        raise DamagedCheckpoint(f"{path}: truncated or changed since it was saved (checksum)")


def _load_archive(path: Path) -> Any:
    """What a checkpoint holds; InputError if that is more than tensors and numbers."""
    with _opened(path) as file:
        file.seek(len(MAGIC) + 65)
        archive: Any = _Archive(file)
        try:
            check_archive(archive)
            archive.seek(0)
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "TypedStorage")  # torch 2.1's own use of it
                return torch.load(archive, map_location="cpu", weights_only=True)
        except (MemoryError, OSError):
            raise
        except Exception as problem:  # whatever a pickle that was made for it brings torch to raise
            found = "holds more than tensors and numbers (a pickle), which is never loaded"
            raise InputError(f"{path}: {found}") from problem


@contextmanager
def _opened(path: Path) -> Iterator[io.FileIO]:
    """A checkpoint's file; DamagedCheckpoint if it cannot be read, is no plain file, or is a link out of its folder."""
    try:
        SourceFile(path, SourceLocation(path)).check_regular()
        locate_file(path.parent, path.name, SourceLocation(path.parent))
    except InputError as problem:
        raise DamagedCheckpoint(str(problem)) from problem
    try:
        with io.FileIO(path) as file:
            yield file
    except OSError as problem:
        reason = problem.strerror or type(problem).__name__
        raise DamagedCheckpoint(f"{path}: cannot be read ({reason}); check the file and its permissions") from problem


class _Archive(io.RawIOBase):
    """The rest of a file that was read up to here, as a file of its own: torch and zipfile seek in it."""

    def __init__(self, file: io.FileIO) -> None:
        self._file = file
        self._start = file.tell()

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._file.tell() - self._start

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(offset + self._start * (whence == os.SEEK_SET), whence) - self._start

    def readinto(self, buffer: Any) -> int | None:
        return self._file.readinto(buffer)


def _checkpoints(folder: Path) -> list[Path]:
    """Those of a training; not what else lies there, as a copy of one."""
    return [path for path in folder.glob("step-*.ckpt") if NAME.fullmatch(path.name)]


def _step_of(checkpoint: Path) -> int:
    return int(checkpoint.stem.removeprefix("step-"))
