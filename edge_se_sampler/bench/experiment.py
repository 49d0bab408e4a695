"""Many trainings in parallel processes: every finished one is kept, and a later call goes on where one was ended.

cell   where a training stands, a frozen dataclass with a name; its fields, and what was measured, make a run
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from edge_se_sampler.bench.machine import machine
from edge_se_sampler.engine.files import write_atomically
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.errors import InputError

VERSION = 1
BROKEN_POOLS = 3
"""A pool of processes breaks when one is killed; so many new ones are started before giving up."""

Train = Callable[..., dict[str, Any]]
"""Cell, further arguments -> its run; called in another process."""


def executor_of(workers: int, scheduler: str | None) -> Callable[[], Executor]:
    """What makes the executor: processes of this machine, or those behind a dask scheduler.

    Raises:
        InputError: the [cluster] extra is missing, or nobody answers at the scheduler's address.
    """
    if scheduler is None:
        spawn = multiprocessing.get_context("spawn")  # a forked torch may hang
        return lambda: ProcessPoolExecutor(workers, spawn, _begin_worker)
    try:
        from distributed import Client  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("--scheduler needs the [cluster] extra: pip install 'edge-se-sampler[cluster]'") from None
    try:
        client = Client(scheduler, timeout="10s")
    except (OSError, ValueError) as problem:
        raise InputError(f"--scheduler {scheduler}: no dask scheduler answers there ({problem})") from problem
    return client.get_executor


def alone(train: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
    """What a function returns in a process of its own, which nothing else has grown.

    Raises:
        RuntimeError: that process was killed.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _end_with_parent) as executor:
        try:
            return executor.submit(train, *arguments).result()
        except BrokenExecutor:
            raise RuntimeError("its process was killed; is there too little memory?") from None


def _begin_worker() -> None:
    """Ctrl-C reaches every process of a terminal: the one that gives out the work answers it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with_parent()


def _end_with_parent() -> None:
    """Should the process that gives out the work be killed, its workers end too instead of waiting for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


def default_workers() -> int:
    """As many as CPUs that this process may use; a GPU is one worker's."""
    if torch.cuda.is_available():
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def begun(path: Path, settings: Any) -> dict[str, Any]:
    """What an earlier call has left in a result.json, if it had the same settings (a dataclass) and version.

    Raises:
        InputError: it had not, or is no result.
    """
    told = json.loads(json.dumps(asdict(settings)))
    if not path.exists():
        return {"version": VERSION, "settings": told, "machine": machine(), "runs": [], "errors": []}
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
        version, found = result["version"], result["settings"]
        if not all(isinstance(entry, dict) for entry in [*result["runs"], *result["errors"]]):
            raise TypeError("runs and errors are lists of objects")
    except (OSError, ValueError, KeyError, TypeError) as problem:
        raise InputError(f"{path}: not a result of this command ({problem!r})") from problem
    if version != VERSION or found != told:
        raise InputError(f"{path}: is of another version or size; name another --output-dir, or move it away")
    return result


def missing(cells: Sequence[Any], result: dict[str, Any]) -> list[Any]:
    """The cells that a result has neither trained nor told the failure of."""
    runs = [*result["runs"], *result["errors"]]
    keys = list(asdict(cells[0])) if cells else []
    done = {tuple(run.get(key) for key in keys) for run in runs}
    return [cell for cell in dict.fromkeys(cells) if tuple(asdict(cell).values()) not in done]


def run_cells(
    cells: Sequence[Any],
    result: dict[str, Any],
    path: Path,
    new_executor: Callable[[], Executor],
    train: Train,
    arguments: Callable[[Any], tuple[Any, ...]],
    keep: Callable[[Any, dict[str, Any]], dict[str, Any]] = lambda _, run: run,
) -> None:
    """Train every cell that the result lacks, and write it after each.

    A cell that fails is told in `errors`, tried again by the next call, and stops no other.

    Args:
        result: of `begun`; changed.
        path: its result.json.
        arguments: cell -> what `train` gets besides it.
        keep: cell, run -> what the result keeps of it.
    """
    result["errors"] = []
    progress = Progress(len(cells), "training", start=len(cells) - len(missing(cells, result)))
    for _ in range(BROKEN_POOLS):
        todo = missing(cells, result)
        if not todo:
            break
        with new_executor() as executor:
            place = {executor.submit(train, cell, *arguments(cell)): cell for cell in todo}
            try:
                for future in as_completed(place):
                    _take(result, place[future], future, keep)
                    write_result(path, result)
                    progress.update(len(cells) - len(missing(cells, result)))
            except BaseException as problem:
                for future in place:
                    future.cancel()
                if isinstance(problem, BrokenExecutor):
                    continue
                for child in multiprocessing.active_children():  # what they do is lost in any case
                    child.terminate()
                raise
        break
    for cell in missing(cells, result):
        result["errors"].append({**asdict(cell), "error": "its process, or one beside it, was killed again and again"})
    progress.close()
    write_result(path, result)


def _take(result: dict[str, Any], cell: Any, future: Any, keep: Callable[..., dict[str, Any]]) -> None:
    """A finished cell into the result."""
    problem = future.exception()
    if isinstance(problem, (BrokenExecutor, KeyboardInterrupt)):
        raise problem
    if problem is not None:
        result["errors"].append({**asdict(cell), "error": f"{type(problem).__name__}: {problem}"})
        return
    result["runs"].append(keep(cell, future.result()))
    result["runs"].sort(key=lambda run: [run[key] for key in asdict(cell)])


def write_result(path: Path, result: dict[str, Any]) -> None:
    """result.json, every run on a line of its own.

    Raises:
        InputError: it cannot be written.
    """
    head = json.dumps({key: value for key, value in result.items() if key != "runs"}, indent=1, allow_nan=False)
    runs = ",\n".join(json.dumps(run, allow_nan=False) for run in result["runs"])
    write_atomically(path, f'{head[:-2]},\n "runs": [\n{runs}\n ]\n}}\n'.encode())
