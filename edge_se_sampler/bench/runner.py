"""Many trainings in parallel processes, kept in one result.json: every finished one stays, a later call goes on.

trial   what identifies a training: a frozen dataclass of plain values
run     a trial's fields and what was measured
"""

from __future__ import annotations

import json
import multiprocessing
import os
import re
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.results import Run, load_or_create, refuse_marks, write_result
from edge_se_sampler.data.scene_file import quote
from edge_se_sampler.engine.files import make_folder
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.errors import InputError, check_value
from edge_se_sampler.interrupts import interrupts_blocked, interrupts_delayed

MAX_BROKEN_POOLS = 3
"""A pool of processes breaks when one of them is killed; so many pools are started before giving up."""

ExecutorFactory = Callable[[], Executor]


@dataclass(frozen=True)
class Experiment:
    """What is trained, and how large."""

    name: str
    """As in `edge-se bench NAME`; the report is chosen by it."""
    settings: Any
    """A dataclass of plain values; a result.json of other settings is refused."""
    trials: Callable[[list[Run]], Sequence[Any]]
    """Runs so far -> the trials to train. Called again until none is pending, so that later trials may depend on
    earlier results."""
    train: Callable[..., Run]
    """(trial, *arguments(trial)) -> its run; called in another process, so a function of a module."""
    arguments: Callable[[Any], tuple[Any, ...]]
    """Trial -> further arguments of `train`, for instance the scene's folder; called in this process."""


@dataclass(frozen=True)
class Shard:
    """A share of an experiment's trials: every count-th from the number-th (1 .. count) on. Its result is a file in
    OUTPUT_DIR/shards; every call of the command takes over what is there."""

    number: int = 1
    count: int = 1

    @classmethod
    def parse(cls, text: str | None) -> Shard:
        """From "2/8"; None: all trials. InputError if it is neither."""
        match = re.fullmatch(r"(\d+)/(\d+)", text or "1/1")
        shard = cls(*map(int, match.groups())) if match else cls(0)
        check_value(
            "shard", text, 1 <= shard.number <= shard.count, "NUMBER/COUNT, as 2/8, with NUMBER from 1 to COUNT"
        )
        return shard

    def of(self, trials: Sequence[Any]) -> Sequence[Any]:
        return trials[self.number - 1 :: self.count]

    def path(self, output_dir: Path) -> Path:
        """Of its result."""
        shards = output_dir / "shards"
        return output_dir / "result.json" if self.count == 1 else shards / f"{self.number}-of-{self.count}.json"


ALL = Shard()


def list_trials(experiment: Experiment, output_dir: Path, shard: Shard = ALL) -> None:
    """Print the trials of a shard that are known yet, and how many of them are pending."""
    result, _ = _load_with_shards(experiment, output_dir)
    trials = shard.of(_find_trials(experiment, result["runs"]))
    for trial in trials:
        print(*asdict(trial).values(), sep=" | ")
    result["errors"] = []  # which are trained again
    print(f"{len(trials)} trainings, {len(pending(trials, result))} of them pending")


def run_experiment(
    experiment: Experiment, output_dir: Path, new_executor: ExecutorFactory, shard: Shard = ALL
) -> dict[str, Any]:
    """Train every pending trial of a shard; its result is written after each. InputError if there is no trial, or the
    folder cannot be written, or holds a result of other settings."""
    path = shard.path(output_dir)
    result, is_new = _load_with_shards(experiment, output_dir)
    trials = shard.of(_find_trials(experiment, result["runs"]))
    make_folder(path.parent, "--output-dir")
    result["errors"] = []
    if is_new:
        write_result(path, result)
    while pending(trials, result):
        _run_trials(experiment, trials, result, path, new_executor)
        trials = shard.of(_find_trials(experiment, result["runs"]))
    for error in result["errors"]:
        print(*error.values(), sep=", ")
    return result


def _find_trials(experiment: Experiment, runs: list[Run]) -> list[Any]:
    """All trials that are known after some runs, each once; InputError if there are none, or a page could not show
    their names."""
    trials = list(dict.fromkeys(experiment.trials(runs)))
    if not trials:
        raise InputError(f"bench {experiment.name}: there is no training of what the flags choose; choose more")
    refuse_marks(experiment.name, json.loads(json.dumps([asdict(trial) for trial in trials])))
    return trials


def _load_with_shards(experiment: Experiment, output_dir: Path) -> tuple[dict[str, Any], bool]:
    """An experiment's result with the runs that only shards have, and whether there are any; measured where the first
    of them was, unless there was a result. InputError as `load_or_create`, and where there is no trial."""
    names = [field.name for field in fields(_find_trials(experiment, [])[0])]
    path = output_dir / "result.json"
    result = load_or_create(path, experiment.name, experiment.settings)
    _check_runs(experiment, result, path)
    before, is_first = len(result["runs"]), not path.exists()
    for path in sorted((output_dir / "shards").glob("*.json")):
        shard = load_or_create(path, experiment.name, experiment.settings)
        _check_runs(experiment, shard, path)
        if is_first:
            result["machine"], is_first = shard["machine"], False
        runs = {tuple(run[name] for name in names): run for run in [*shard["runs"], *result["runs"]]}
        result["runs"] = [runs[key] for key in sorted(runs)]
        result["command"] = "\n".join(dict.fromkeys([*shard["command"].splitlines(), *result["command"].splitlines()]))
    return result, len(result["runs"]) > before


def _check_runs(experiment: Experiment, result: dict[str, Any], path: Path) -> None:
    """InputError if a result has runs of no trial that the experiment could have, or errors that are none."""
    try:
        trials = [asdict(trial) for trial in experiment.trials(result["runs"])]
        names = list(trials[0])
        sorted({tuple(run[name] for name in names) for run in [*trials, *result["runs"], *result["errors"]]})
    except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError) as problem:
        raise InputError(f"{path}: its runs are none of bench {experiment.name} ({quote(problem)})") from problem


def pending(trials: Sequence[Any], result: dict[str, Any]) -> list[Any]:
    """The trials that have neither a run nor an error in the result."""
    keys = list(asdict(trials[0])) if trials else []
    finished = {tuple(run.get(key) for key in keys) for run in [*result["runs"], *result["errors"]]}
    return [trial for trial in trials if tuple(asdict(trial).values()) not in finished]


def _run_trials(
    experiment: Experiment, trials: Sequence[Any], result: dict[str, Any], path: Path, new_executor: ExecutorFactory
) -> None:
    """Train the pending ones of some trials. One that fails goes to `errors`, is tried again by the next call of the
    command, and stops no other."""
    with Progress(len(trials), experiment.name, start=len(trials) - len(pending(trials, result))) as progress:
        for _ in range(MAX_BROKEN_POOLS):
            # scenes are rendered and copied here, which takes time: before anything is trained that could be lost
            jobs = [(trial, experiment.arguments(trial)) for trial in pending(trials, result)]
            with new_executor() as executor:
                trial_of: dict[Future[Run], Any] = {}
                try:
                    with interrupts_delayed(), interrupts_blocked():
                        for trial, arguments in jobs:
                            trial_of[executor.submit(experiment.train, trial, *arguments)] = trial
                    for future in as_completed(trial_of):
                        _store(result, trial_of.pop(future), future)
                        write_result(path, result)
                        progress.update(len(trials) - len(pending(trials, result)))
                    break
                except BaseException as problem:
                    for future, trial in trial_of.items():
                        if not future.cancel() and future.done() and future.exception() is None:
                            _store(result, trial, future)  # it had ended at the same time
                    if not isinstance(problem, BrokenExecutor):
                        for child in multiprocessing.active_children():  # their unfinished trials are lost in any case
                            child.terminate()
                        with suppress(InputError):  # the disk may be what is the matter
                            write_result(path, result)
                        raise
    for trial in pending(trials, result):
        result["errors"].append({**asdict(trial), "error": "its process, or one beside it, was killed repeatedly"})
    write_result(path, result)


def _store(result: dict[str, Any], trial: Any, future: Future[Run]) -> None:
    """Add a finished trial to the runs, or to the errors."""
    try:
        run = {**asdict(trial), **future.result()}
        json.dumps(run, allow_nan=False)  # a ValueError where a number is not finite
    except BaseException as problem:  # another process's SystemExit, too
        if isinstance(problem, (BrokenExecutor, KeyboardInterrupt)):
            raise
        result["errors"].append({**asdict(trial), "error": f"{type(problem).__name__}: {problem}"})
    else:
        result["runs"].append(run)
        result["runs"].sort(key=lambda run: [run[key] for key in asdict(trial)])


def executor_factory(workers: int, scheduler: str | None) -> ExecutorFactory:
    """What makes the executor: processes of this machine, or those of a dask cluster by its scheduler's address.
    InputError if the [cluster] extra is missing, or nobody answers at the address."""
    if scheduler is None:
        spawn = multiprocessing.get_context("spawn")  # a forked torch may hang
        return lambda: ProcessPoolExecutor(workers, spawn, initialize_worker)
    try:
        from distributed import Client  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("--scheduler needs the [cluster] extra: pip install 'edge-se-sampler[cluster]'") from None
    try:
        client = Client(scheduler, timeout="10s")
    except (OSError, ValueError) as problem:
        raise InputError(f"--scheduler {scheduler}: no dask scheduler answers there ({problem})") from problem
    return client.get_executor


def run_in_subprocess(function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function returns in a fresh process, whose memory and global state are its own; RuntimeError if that was
    killed."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _exit_with_parent) as executor:
        try:
            return executor.submit(function, *arguments).result()
        except BrokenExecutor:
            raise RuntimeError("its process was killed; is there too little memory?") from None


def initialize_worker() -> None:
    """Ctrl-C reaches every process of a terminal: only the one that hands out the trials answers it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _exit_with_parent()


def _exit_with_parent() -> None:
    """If the process that hands out the trials is killed, its workers end too instead of waiting for ever."""
    if parent := multiprocessing.parent_process():
        threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()
