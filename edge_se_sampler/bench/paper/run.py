"""Runs the cells in parallel processes, keeps every finished one, and goes on where an earlier call ended."""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from edge_se_sampler.bench.machine import machine
from edge_se_sampler.bench.paper.cell import Cell, Preset, run_cell
from edge_se_sampler.engine.files import make_folder, write_atomically
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.errors import InputError

VERSION = 1
BROKEN_POOLS = 3
"""A pool of processes breaks when one is killed; so many new ones are started before giving up."""


def executor_of(workers: int, scheduler: str | None) -> Callable[[], Executor]:
    """What makes the executor: processes of this machine, or those behind a dask scheduler.

    Raises:
        InputError: the [cluster] extra is missing, or nobody answers at the scheduler's address.
    """
    if scheduler is None:
        spawn = multiprocessing.get_context("spawn")  # a forked torch may hang
        return lambda: ProcessPoolExecutor(workers, mp_context=spawn)
    try:
        from distributed import Client  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("--scheduler needs the [cluster] extra: pip install 'edge-se-sampler[cluster]'") from None
    try:
        client = Client(scheduler, timeout="10s")
    except (OSError, ValueError) as problem:
        raise InputError(f"--scheduler {scheduler}: no dask scheduler answers there ({problem})") from problem
    return client.get_executor


def begun(path: Path, preset: Preset) -> dict[str, Any]:
    """What an earlier call has left, if it was of this preset and version.

    Raises:
        InputError: it was not, or is no result.
    """
    settings = json.loads(json.dumps(asdict(preset)))
    if not path.exists():
        return {"version": VERSION, "preset": settings, "machine": machine(), "runs": [], "errors": []}
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
        version, found = result["version"], result["preset"]
    except (OSError, ValueError, KeyError, TypeError) as problem:
        raise InputError(f"{path}: not a result of edge-se bench paper ({problem!r})") from problem
    if version != VERSION or found != settings:
        raise InputError(f"{path}: is of another version or preset; name another --output-dir, or move it away")
    return result


def write_result(path: Path, result: dict[str, Any]) -> None:
    """result.json, every run on a line of its own.

    Raises:
        InputError: it cannot be written.
    """
    head = json.dumps({key: value for key, value in result.items() if key != "runs"}, indent=1, allow_nan=False)
    runs = ",\n".join(json.dumps(run, allow_nan=False) for run in result["runs"])
    write_atomically(path, f'{head[:-2]},\n "runs": [\n{runs}\n ]\n}}\n'.encode())


def run_cells(
    cells: list[Cell],
    preset: Preset,
    data_of: Callable[[Cell], Path],
    output_dir: Path,
    workplace: Path,
    new_executor: Callable[[], Executor],
    threads: int,
) -> dict[str, Any]:
    """Train and measure every cell that result.json does not have yet.

    A cell that fails is told in `errors`, tried again by the next call, and stops no other.

    Returns:
        the result, as it lies in output_dir/result.json.
    """
    path = output_dir / "result.json"
    result = begun(path, preset)
    make_folder(output_dir / "views", "--output-dir, folder")
    result["errors"] = []
    progress = Progress(len(cells), "bench paper", start=len(cells) - len(missing(cells, result)))
    for _ in range(BROKEN_POOLS):
        todo = missing(cells, result)
        if not todo:
            break
        with new_executor() as executor:
            place = {
                executor.submit(run_cell, cell, preset, data_of(cell), workplace / "runs", threads): cell
                for cell in todo
            }
            try:
                for future in as_completed(place):
                    _take(result, place[future], future.exception(), future, output_dir / "views")
                    write_result(path, result)
                    progress.update(len(cells) - len(missing(cells, result)))
            except BrokenExecutor:
                continue
            except BaseException:
                executor.shutdown(wait=False, cancel_futures=True)
                raise
        break
    progress.close()
    write_result(path, result)
    return result


def _take(result: dict[str, Any], cell: Cell, problem: BaseException | None, future: Any, views: Path) -> None:
    """A finished cell into the result, its view beside it."""
    if isinstance(problem, (BrokenExecutor, KeyboardInterrupt)):
        raise problem
    if problem is None:
        run = future.result()
        write_atomically(views / f"{cell.name}.png", run.pop("view"))
        result["runs"].append(run)
        result["runs"].sort(key=lambda run: (run["table"], run["scene"], run["strategy"], run["seed"]))
    else:
        result["errors"].append({**asdict(cell), "error": f"{type(problem).__name__}: {problem}"})


def missing(cells: list[Cell], result: dict[str, Any]) -> list[Cell]:
    """The cells that a result has neither trained nor told the failure of."""
    place = ("table", "scene", "strategy", "seed")
    done = {tuple(run[key] for key in place) for run in (*result["runs"], *result["errors"])}
    return [cell for cell in cells if (cell.table, cell.scene, cell.strategy, cell.seed) not in done]


def default_workers() -> int:
    """As many as CPUs that this process may use; a GPU is one worker's."""
    if torch.cuda.is_available():
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
