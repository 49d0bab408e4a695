"""Checkpoints that are written completely or not at all.

A file is one line of text, "edge-se-checkpoint 2 <sha256 of the rest>", followed by torch.save's bytes. It is
written to a temporary file, flushed to the disk and renamed: a process killed at any moment leaves the old file or the
new one. It is loaded with weights_only=True: a pickle in it is refused, never run.
"""

from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import Any, BinaryIO

import torch

from edge_se_sampler.data.scene_file import SourceFile, SourceLocation
from edge_se_sampler.engine.files import write_atomically
from edge_se_sampler.engine.saved_state import check_archive, check_tensors
from edge_se_sampler.errors import InputError

MAGIC = b"edge-se-checkpoint 2 "
NAMES = f"step-{9 * '[0-9]'}*.ckpt"


def save_checkpoint(folder: Path, step: int, state: dict[str, Any]) -> Path:
    """Write the checkpoint after a step (0, 1, ...), then delete the older ones; InputError if it cannot be written."""
    path = folder / f"step-{step:09d}.ckpt"
    write_atomically(path, lambda file: _write(state, file))
    for other in folder.glob(NAMES):
        if _step_of(other) < step:
            other.unlink(missing_ok=True)
    return path


class _HashingWriter(io.RawIOBase):
    """Passes on what is written, and hashes it."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.digest = hashlib.sha256()
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
    latest = max(folder.glob(NAMES), key=_step_of, default=None)
    if latest is None:
        raise InputError(f"{folder}: no checkpoint (step-*.ckpt); the run ended before its first was saved")
    return latest


def load_checkpoint(path: Path, config_digest: str) -> dict[str, Any]:
    """Read a checkpoint; InputError if it is unreadable, damaged, none, or saved under another configuration."""
    content = SourceFile(path, SourceLocation(path)).read_bytes()
    header, _, payload = content.partition(b"\n")
    if not header.startswith(MAGIC):
        raise InputError(f"{path}: not a checkpoint of this version of edge-se; use a run folder that it wrote")
    if header[len(MAGIC) :] != hashlib.sha256(payload).hexdigest().encode():
        raise InputError(f"{path}: truncated or changed since it was saved (checksum); restore it or train again")
    try:
        check_archive(payload)
        state = torch.load(io.BytesIO(payload), map_location="cpu", weights_only=True)
    except MemoryError:
        raise
    except Exception as problem:  # whatever a pickle that was made for it brings torch to raise
        raise InputError(f"{path}: holds more than tensors and numbers (a pickle), which is never loaded") from problem
    if not isinstance(state, dict) or state.get("config_digest") != config_digest:
        raise InputError(f"{path}: saved under another configuration than the run's config.json; do not mix runs")
    try:
        check_tensors(state)
    except ValueError as problem:
        raise InputError(f"{path}: was not saved by a training ({problem}); do not use it") from problem
    return state


def _step_of(checkpoint: Path) -> int:
    return int(checkpoint.stem.removeprefix("step-"))
