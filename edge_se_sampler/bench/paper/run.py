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

from edge_se_sampler.bench.machine import machine
from edge_se_sampler.bench.paper.cell import TABLES, Cell, Placement, Preset, run_cell
from edge_se_sampler.data.made.folder import make_scenes
from edge_se_sampler.engine.files import make_folder, write_atomically, write_json
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


def make_data(preset: Preset, cells: list[Cell], workplace: Path) -> Callable[[Cell], Path]:
    """The made scenes that the cells need, off-centre ones the centred pictures pasted elsewhere; where each lies."""
    placements: list[Placement] = sorted({TABLES[cell.table].placement for cell in cells})
    for placement in placements:
        folder = workplace / "scenes" / placement
        wanted = {cell.scene for cell in cells if TABLES[cell.table].placement == placement}
        missing = sorted(name for name in wanted if not (folder / name).exists())
        if missing:
            progress = Progress(len(missing) * (preset.num_train + 1 + preset.num_test), f"making {placement} scenes")
            make_scenes(
                folder, missing, size=preset.image_size or 800, num_train=preset.num_train, num_val=1,
                num_test=preset.num_test, placement=placement, progress=lambda done, _, bar=progress: bar.update(done),
            )  # fmt: skip
            progress.close()
    return lambda cell: workplace / "scenes" / TABLES[cell.table].placement / cell.scene


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
    progress = Progress(len(cells), "bench paper", start=len(cells) - len(_missing(cells, result)))
    for _ in range(BROKEN_POOLS):
        missing = _missing(cells, result)
        if not missing:
            break
        with new_executor() as executor:
            place = {
                executor.submit(run_cell, cell, preset, data_of(cell), workplace / "runs", threads): cell
                for cell in missing
            }
            try:
                for future in as_completed(place):
                    _take(result, place[future], future.exception(), future, output_dir / "views")
                    write_json(path, result)
                    progress.update(len(cells) - len(_missing(cells, result)))
            except BrokenExecutor:
                continue
            except BaseException:
                executor.shutdown(wait=False, cancel_futures=True)
                raise
        break
    progress.close()
    write_json(path, result)
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


def _missing(cells: list[Cell], result: dict[str, Any]) -> list[Cell]:
    place = ("table", "scene", "strategy", "seed")
    done = {tuple(run[key] for key in place) for run in (*result["runs"], *result["errors"])}
    return [cell for cell in cells if (cell.table, cell.scene, cell.strategy, cell.seed) not in done]


def cores() -> int:
    """CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
