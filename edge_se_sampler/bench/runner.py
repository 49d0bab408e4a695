"""Many trainings in parallel processes, kept in one result.json: every finished one stays, a later call goes on.

trial   what identifies a training: a frozen dataclass of plain values
run     a trial's fields and what was measured

Free of torch until a result is created.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import re
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.machine import machine
from edge_se_sampler.data.scene_file import quote, read_json
from edge_se_sampler.engine.files import checksum, make_folder, write_atomically
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.errors import InputError, check_value
from edge_se_sampler.interrupts import interrupts_blocked, interrupts_delayed

VERSION = 3
"""Of results. Version 2, which is read as well, has no checksum."""
PLAIN = re.compile(r"[\w .,:;=+/()%'\"~@-]*")
"""Texts without marks of Markdown and HTML."""
MAX_BROKEN_POOLS = 3
"""A pool of processes breaks when one of them is killed; so many pools are started before giving up."""

Run = dict[str, Any]
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
    _refuse_marks(experiment.name, json.loads(json.dumps([asdict(trial) for trial in trials])))
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


def load_or_create(path: Path, experiment: str, settings: Any) -> dict[str, Any]:
    """The result of an earlier call with the same settings (a dataclass), or an empty one; InputError if the file is no
    result, or one of another version, experiment or settings, or a page could not show these."""
    defaults = {setting.name: setting.default for setting in fields(settings) if setting.default is not MISSING}
    settings = json.loads(json.dumps(asdict(settings)))
    _refuse_marks(experiment, settings)
    if not path.exists():
        return new_result(experiment, settings) | {"errors": [], "runs": []}
    result = read_result(path)
    # what earlier versions had no setting for was as it is by default
    result["settings"] = {**{k: v for k, v in defaults.items() if isinstance(v, str)}, **result["settings"]}
    if (result["experiment"], result["settings"]) != (experiment, settings):
        raise InputError(f"{path}: of another experiment or other settings; name another --output-dir, or move it away")
    result["command"] = "\n".join(dict.fromkeys([*result["command"].splitlines(), _command()]))
    return result


def new_result(experiment: str, settings: dict[str, Any]) -> dict[str, Any]:
    """What every json of results begins with; command: those that have trained it, one a line."""
    head = {"version": VERSION, "experiment": experiment, "command": _command()}
    return {**head, "settings": settings, "machine": machine()}


def _refuse_marks(experiment: str, value: Any) -> None:
    """InputError if a page could not show a text in an experiment's settings or trials."""
    try:
        check_plain(value)
    except ValueError as problem:
        raise InputError(f"bench {experiment}: {problem}, which a page could not show; rename it") from problem


def _command() -> str:
    """The command line; InputError if a page could not show it."""
    command = shlex.join(["edge-se", *sys.argv[1:]])
    try:
        _check_command(command)
    except ValueError as problem:
        raise InputError(f"{problem}, which a page could not show; rename it") from problem
    return command


def read_result(path: Path) -> dict[str, Any]:
    """A result.json; InputError as `read_measured`, or if it has no runs and errors."""
    result = read_measured(path)
    entries = (result.get("runs"), result.get("errors"))
    if not all(isinstance(e, list) and all(isinstance(entry, dict) for entry in e) for e in entries):
        raise InputError(f"{path}: not a result of edge-se bench (runs and errors are lists of objects)")
    return result


def read_measured(path: Path) -> dict[str, Any]:
    """A json of results, of trainings or others; InputError if it cannot be read, is none of this version or the one
    before, or is not as it was written."""
    result = read_json(path).object()
    claimed = result.pop("checksum", None)
    try:
        if result["version"] not in (2, VERSION):
            raise ValueError(f"version {result['version']}, not {VERSION}")
        if claimed != (None if result["version"] == 2 else checksum(result)):
            raise ValueError("changed since it was written (checksum)")
        if not {"experiment", "command", "settings", "machine"} <= result.keys():
            raise KeyError("experiment, command, settings or machine")
        check_texts(result)
    except (ValueError, KeyError, TypeError, RecursionError) as problem:
        raise InputError(f"{path}: not a result of edge-se bench ({quote(problem)})") from problem
    return result


def check_texts(result: dict[str, Any]) -> None:
    """ValueError or TypeError if a result's texts could be more than that in a page, see `check_plain`."""
    check_plain({key: value for key, value in result.items() if key not in ("errors", "command")})
    _check_command(str(result["command"]).replace("\n", ""))


def _check_command(command: str) -> None:
    """ValueError if a command line could be more than that between a page's backticks."""
    if "`" in command or not command.isprintable():
        raise ValueError(f"a command with a backtick, or no text: {quote(command)}")


def check_plain(value: Any) -> None:
    """ValueError if a text in a json value could be more than text in a page or the name of a file: HTML, a link, a
    path that leads out."""
    if isinstance(value, dict):
        check_plain([*value, *value.values()])
    elif isinstance(value, list):
        for item in value:
            check_plain(item)
    elif isinstance(value, str) and (".." in value or not PLAIN.fullmatch(value)):
        raise ValueError(f"a text with marks: {quote(value)}")


def write_result(path: Path, result: dict[str, Any]) -> None:
    """result.json, every run on a line of its own; InputError if it cannot be written."""
    result = {**result, "version": VERSION}
    head = {key: value for key, value in result.items() if key != "runs"} | {"checksum": checksum(result)}
    head = json.dumps(head, indent=1, allow_nan=False)
    runs = ",\n".join(json.dumps(run, allow_nan=False) for run in result["runs"])
    write_atomically(path, f'{head[:-2]},\n "runs": [\n{runs}\n ]\n}}\n'.encode())


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
            with new_executor() as executor:
                trial_of: dict[Future[Run], Any] = {}
                try:
                    with interrupts_delayed(), interrupts_blocked():
                        for trial in pending(trials, result):
                            trial_of[executor.submit(experiment.train, trial, *experiment.arguments(trial))] = trial
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
