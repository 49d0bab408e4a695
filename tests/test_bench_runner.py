"""The runner of experiments: what is kept, what is trained again, and what killed or interrupted processes cost."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from edge_se_sampler.bench import runner
from edge_se_sampler.bench.command import ExperimentCommand
from edge_se_sampler.bench.results import VERSION, Run, read_result, write_result
from edge_se_sampler.bench.runner import (
    Experiment,
    Shard,
    executor_factory,
    list_trials,
    run_experiment,
    run_in_subprocess,
)
from edge_se_sampler.errors import InputError


@dataclass(frozen=True)
class ToySettings:
    steps: int = 3


@dataclass(frozen=True)
class ToyTrial:
    scene: str
    seed: int


TRIALS = [ToyTrial("mic", seed) for seed in range(3)]


def train(trial: ToyTrial, *_: Any) -> Run:
    return {"psnr": 20.0 + trial.seed}


def toy_experiment(
    train: Callable[..., Run] = train,
    trials: Callable[[list[Run]], list[ToyTrial]] = lambda _: TRIALS,
    steps: int = 3,
    arguments: tuple[Any, ...] = (),
) -> Experiment:
    return Experiment("toy", ToySettings(steps), trials, train, lambda _: arguments)


def one_thread() -> Executor:
    return ThreadPoolExecutor(1)


def read(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "result.json").read_text())


# -- what is kept


def test_result_json_holds_the_head_and_every_run_sorted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["edge-se", "bench", "toy"])
    result = run_experiment(toy_experiment(trials=lambda _: TRIALS[::-1]), tmp_path / "new", one_thread)
    assert read_result(tmp_path / "new" / "result.json") == json.loads(json.dumps(result))
    assert result["runs"] == [{"scene": "mic", "seed": seed, "psnr": 20.0 + seed} for seed in range(3)]
    assert (result["version"], result["experiment"], result["settings"]) == (VERSION, "toy", {"steps": 3})
    assert result["command"] == "edge-se bench toy"
    assert result["errors"] == []


def test_a_later_call_trains_only_what_is_pending(tmp_path: Path) -> None:
    trained = []

    def count(trial: ToyTrial) -> Run:
        trained.append(trial)
        return train(trial)

    run_experiment(toy_experiment(count, lambda _: TRIALS[:1]), tmp_path, one_thread)
    run_experiment(toy_experiment(count, lambda _: [*TRIALS, *TRIALS]), tmp_path, one_thread)
    assert trained == TRIALS


def test_every_command_that_trained_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for count in (1, 1, 2):
        monkeypatch.setattr(sys, "argv", ["edge-se", "bench", "toy", str(count)])
        run_experiment(toy_experiment(trials=lambda _, count=count: TRIALS[:count]), tmp_path, one_thread)
    assert read(tmp_path)["command"] == "edge-se bench toy 1\nedge-se bench toy 2"


def test_later_trials_may_depend_on_earlier_runs(tmp_path: Path) -> None:
    def trials(runs: list[Run]) -> list[ToyTrial]:
        best = max((run["seed"] for run in runs if run["scene"] == "mic"), default=None)
        return TRIALS if best is None else [*TRIALS, ToyTrial("chair", best)]

    result = run_experiment(toy_experiment(trials=trials), tmp_path, one_thread)
    assert [(run["scene"], run["seed"]) for run in result["runs"]] == [("chair", 2), ("mic", 0), ("mic", 1), ("mic", 2)]


def test_a_failing_trial_is_reported_stops_no_other_and_is_tried_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail_once(trial: ToyTrial) -> Run:
        if trial.seed == 1 and not (tmp_path / "failed").exists():
            (tmp_path / "failed").touch()
            raise FloatingPointError("the loss is not finite at step 3")
        return train(trial)

    result = run_experiment(toy_experiment(fail_once), tmp_path, one_thread)
    assert [run["seed"] for run in result["runs"]] == [0, 2]
    assert result["errors"] == [
        {"scene": "mic", "seed": 1, "error": "FloatingPointError: the loss is not finite at step 3"}
    ]
    assert "mic, 1, FloatingPointError: the loss is not finite at step 3" in capsys.readouterr().out
    list_trials(toy_experiment(), tmp_path)
    assert "3 trainings, 1 of them pending" in capsys.readouterr().out
    again = run_experiment(toy_experiment(fail_once), tmp_path, one_thread)
    assert [run["seed"] for run in again["runs"]] == [0, 1, 2]
    assert again["errors"] == []


def test_a_number_that_is_not_finite_is_an_error_of_its_trial(tmp_path: Path) -> None:
    experiment = toy_experiment(lambda trial: {"psnr": 20.0 if trial.seed else float("nan")})
    result = run_experiment(experiment, tmp_path, one_thread)
    assert [run["seed"] for run in result["runs"]] == [1, 2]
    assert [error["seed"] for error in result["errors"]] == [0]
    assert read_result(tmp_path / "result.json")["runs"] == result["runs"]


@pytest.mark.parametrize("folder", ["R&D", "a[1]", "x#1", "../up", "<b>"])
def test_any_path_that_is_text_may_be_in_the_command(
    folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["edge-se", "bench", "toy", "--output-dir", folder])
    trained = []
    for _ in range(2):  # as it is, and read again
        run_experiment(toy_experiment(lambda trial: trained.append(1) or train(trial)), tmp_path, one_thread)
        assert len(trained) == 3


@pytest.mark.parametrize(("command", "scene"), [("a`b", "mic"), ("a\nb", "mic"), ("\udcff", "mic"), ("x", "<b>mic")])
def test_what_a_page_cannot_show_is_refused_before_anything_is_trained(
    command: str, scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["edge-se", "bench", "toy", "--output-dir", command])
    experiment = toy_experiment(lambda _: pytest.fail("trained"), lambda _: [ToyTrial(scene, 0)])
    with pytest.raises(InputError, match="which a page could not show"):
        run_experiment(experiment, tmp_path / "new", one_thread)
    assert not (tmp_path / "new").exists()


@dataclass(frozen=True, kw_only=True)
class ToyCommand(ExperimentCommand):
    failing: int | None

    def experiment(self) -> Experiment:
        def fail(trial: ToyTrial) -> Run:
            if trial.seed == self.failing:
                raise FloatingPointError("the loss is not finite")
            return train(trial)

        return toy_experiment(fail)


@pytest.mark.parametrize("failing", [None, 0])
def test_an_experiment_of_which_a_training_failed_ends_with_exit_code_1(
    failing: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("edge_se_sampler.bench.command.executor_factory", lambda *_: one_thread)
    command = ToyCommand(output_dir=tmp_path, shard="1/2", failing=failing)
    with nullcontext() if failing is None else pytest.raises(SystemExit) as ended:
        command.run()
    assert ended is None or ended.value.code == 1
    assert ("1 failed" in capsys.readouterr().err) == (failing is not None)


EMPTY = {
    "version": 2, "experiment": "toy", "command": "", "settings": {"steps": 3}, "machine": {}, "runs": [], "errors": [],
}  # fmt: skip


@pytest.mark.parametrize(
    "change",
    [
        {"version": 1},
        {"runs": 3},
        {"runs": [7]},
        {"machine": None},
        {"experiment": "other"},
        {"settings": {"steps": 4}},
    ],
    ids=str,
)
def test_a_file_that_is_no_result_of_the_experiment_is_refused_and_kept(change: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    content = {key: value for key, value in {**EMPTY, **change}.items() if value is not None}
    for text in (json.dumps(content), json.dumps(content)[:-1], "[]"):
        path.write_text(text)
        with pytest.raises(InputError, match=r"result\.json"):
            run_experiment(toy_experiment(), tmp_path, one_thread)
        assert path.read_text() == text


@pytest.mark.parametrize("name", ["result.json", "shards/1-of-2.json"])
@pytest.mark.parametrize("run", [{}, {"scene": "mic"}, {"scene": "mic", "seed": [1]}, {"scene": "mic", "seed": "x"}])
def test_runs_that_are_of_no_trial_are_refused(run: dict[str, Any], name: str, tmp_path: Path) -> None:
    (tmp_path / "shards").mkdir()
    write_result(tmp_path / name, {**EMPTY, "runs": [{"scene": "mic", "seed": 0}, run]})
    with pytest.raises(InputError, match=rf"{name}.*none of bench toy"):
        list_trials(toy_experiment(), tmp_path)


def test_listing_trials_trains_and_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_experiment(toy_experiment(trials=lambda _: TRIALS[:1]), tmp_path, one_thread)
    before = (tmp_path / "result.json").read_bytes()
    list_trials(toy_experiment(lambda _: pytest.fail("trained")), tmp_path)
    assert capsys.readouterr().out.endswith("mic | 0\nmic | 1\nmic | 2\n3 trainings, 2 of them pending\n")
    assert (tmp_path / "result.json").read_bytes() == before
    list_trials(toy_experiment(), tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_flags_that_choose_nothing_are_refused(tmp_path: Path) -> None:
    run_experiment(toy_experiment(), tmp_path / "old", one_thread, Shard(1, 2))
    for folder in (tmp_path / "old", tmp_path / "new"):
        for call in (list_trials, lambda experiment, folder: run_experiment(experiment, folder, one_thread)):
            with pytest.raises(InputError, match="bench toy: there is no training"):
                call(toy_experiment(trials=lambda _: []), folder)
    assert not (tmp_path / "new").exists()
    assert not (tmp_path / "old" / "result.json").exists()


def test_what_is_chosen_twice_is_one_training(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    experiment = toy_experiment(trials=lambda _: [*TRIALS, *TRIALS])
    list_trials(experiment, tmp_path)
    assert capsys.readouterr().out.endswith("mic | 2\n3 trainings, 3 of them pending\n")
    shards = [run_experiment(experiment, tmp_path, one_thread, Shard(number, 2))["runs"] for number in (1, 2)]
    assert [[run["seed"] for run in runs] for runs in shards] == [[0, 2], [0, 1, 2]]


# -- shards


def test_shards_train_each_trial_once_and_are_put_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained = []

    def count(trial: ToyTrial) -> Run:
        trained.append(trial)
        return train(trial)

    for name, expected in (("1/2", [0, 2]), ("2/2", [1]), ("1/2", [])):
        trained.clear()
        monkeypatch.setattr(sys, "argv", ["edge-se", "bench", "toy", "--shard", name])
        run_experiment(toy_experiment(count), tmp_path, one_thread, Shard.parse(name))
        assert [trial.seed for trial in trained] == expected
    assert not (tmp_path / "result.json").exists()
    (tmp_path / "shards" / "1-of-2.json").rename(tmp_path / "shards" / "of_another_machine.json")
    for path in (tmp_path / "shards").iterdir():
        shard = read_result(path)
        write_result(path, shard | {"machine": shard["machine"] | {"processor": "another"}})
    monkeypatch.setattr(sys, "argv", ["edge-se", "bench", "toy"])
    result = run_experiment(toy_experiment(lambda _: pytest.fail("trained")), tmp_path, one_thread)
    assert read_result(tmp_path / "result.json") == json.loads(json.dumps(result))
    assert [run["psnr"] for run in result["runs"]] == [20.0, 21.0, 22.0]
    assert result["machine"]["processor"] == "another"
    commands = ["edge-se bench toy --shard 1/2", "edge-se bench toy --shard 2/2", "edge-se bench toy"]
    assert sorted(result["command"].splitlines()) == sorted(commands)


def test_what_a_killed_shard_lacks_is_trained_by_the_call_that_puts_together(tmp_path: Path) -> None:
    run_experiment(toy_experiment(), tmp_path, one_thread, Shard(2, 3))
    trained = []
    run_experiment(toy_experiment(lambda trial: trained.append(trial.seed) or train(trial)), tmp_path, one_thread)
    assert trained == [0, 2]


@pytest.mark.parametrize("text", ["0/2", "3/2", "1/0", "2", "a/b", "-1/2"])
def test_a_shard_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="--shard"):
        Shard.parse(text)


def test_a_shard_of_other_settings_is_refused(tmp_path: Path) -> None:
    run_experiment(toy_experiment(steps=4), tmp_path, one_thread, Shard(1, 2))
    with pytest.raises(InputError, match="of another experiment or other settings"):
        run_experiment(toy_experiment(), tmp_path, one_thread)


# -- processes


def die_once(trial: ToyTrial, folder: Path) -> Run:
    """Kills its process the first time."""
    mark = folder / "died"
    if trial.seed == 1 and not mark.exists():
        mark.touch()
        os._exit(9)
    return train(trial)


def test_a_killed_worker_costs_no_trial(tmp_path: Path) -> None:
    result = run_experiment(
        toy_experiment(die_once, arguments=(tmp_path,)), tmp_path, executor_factory(workers=1, scheduler=None)
    )
    assert (tmp_path / "died").exists()
    assert [run["seed"] for run in result["runs"]] == [0, 1, 2]
    assert result["errors"] == []


def test_a_training_killed_in_a_process_of_its_own_is_an_error_of_that_trial_alone(tmp_path: Path) -> None:
    def kill_one(trial: ToyTrial) -> Run:
        return run_in_subprocess(os._exit, 1) if trial.seed == 1 else train(trial)

    result = run_experiment(toy_experiment(kill_one), tmp_path, one_thread)
    assert [run["seed"] for run in result["runs"]] == [0, 2]
    (error,) = result["errors"]
    assert error["error"] == "RuntimeError: its process was killed; is there too little memory?"


def interrupt_this_process() -> int:
    os.kill(os.getpid(), signal.SIGINT)
    return 7


def test_workers_ignore_ctrl_c() -> None:
    """Every process of a terminal gets the signal: a worker that answered it would print a traceback."""
    with executor_factory(1, None)() as executor:
        assert executor.submit(interrupt_this_process).result() == 7


class ExecutorWithoutCancel(ThreadPoolExecutor):
    """As dask's executor: `shutdown` takes no cancel_futures."""

    def shutdown(self, wait: bool = True) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        super().shutdown(wait=wait)


def test_an_interruption_keeps_what_is_finished_whatever_the_executor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt_second(trial: ToyTrial) -> Run:
        if trial.seed == 1:
            raise KeyboardInterrupt
        return train(trial)

    def ended_together(futures: Iterable[Future[Run]]) -> list[Future[Run]]:
        return sorted(wait(futures).done, key=lambda future: future.exception() is None)

    monkeypatch.setattr(runner, "as_completed", ended_together)
    with pytest.raises(KeyboardInterrupt):
        run_experiment(toy_experiment(interrupt_second), tmp_path, partial(ExecutorWithoutCancel, 1))
    assert [run["seed"] for run in read(tmp_path)["runs"]] == [0, 2]


INTERRUPTED = """
import os, pathlib, signal, time
from test_bench_runner import executor_factory, run_experiment, toy_experiment

def interrupt_parent_and_sleep(trial):
    os.kill(os.getppid(), signal.SIGINT)
    time.sleep(600)

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored, where a shell started the tests with &
    run_experiment(toy_experiment(interrupt_parent_and_sleep), pathlib.Path("."), executor_factory(1, None))
"""


def run_script(code: str, folder: Path) -> subprocess.Popen[str]:
    """A script in a process of its own, which can import this module."""
    (folder / "script.py").write_text(code)
    paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    return subprocess.Popen(
        [sys.executable, "script.py"],
        cwd=folder,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
    )


def test_ctrl_c_waits_for_no_trial(tmp_path: Path) -> None:
    with run_script(INTERRUPTED, tmp_path) as process:
        _, errors = process.communicate(timeout=120)  # a trial sleeps for longer
    assert "KeyboardInterrupt" in errors


STARTING = """
import os, pathlib, time
from test_bench_runner import executor_factory, run_experiment, toy_experiment, train

if __name__ == "__mp_main__":  # a worker, which does not ignore Ctrl-C yet
    print(os.getpid(), flush=True)
    time.sleep(1)
if __name__ == "__main__":
    run_experiment(toy_experiment(train), pathlib.Path("."), executor_factory(1, None))
"""


def test_a_worker_that_starts_leaves_ctrl_c_to_its_parent(tmp_path: Path) -> None:
    with run_script(STARTING, tmp_path) as process:
        assert process.stdout is not None
        os.kill(int(process.stdout.readline()), signal.SIGINT)
        out, errors = process.communicate(timeout=120)
    assert out == ""  # it is the only one
    assert "Traceback" not in errors


STARTS_A_WORKER = """
import os, time
from edge_se_sampler.bench.runner import executor_factory
if __name__ == "__main__":
    executor = executor_factory(1, None)()
    print(executor.submit(os.getpid).result(), flush=True)
    time.sleep(600)
"""
STARTS_A_SUBPROCESS = """
import os, pathlib, time
from edge_se_sampler.bench.runner import run_in_subprocess
def tell_and_sleep():
    print(os.getpid(), flush=True)
    time.sleep(600)
if __name__ == "__main__":
    run_in_subprocess(tell_and_sleep)
"""


@pytest.mark.parametrize("code", [STARTS_A_WORKER, STARTS_A_SUBPROCESS])
def test_workers_do_not_outlive_a_killed_parent(code: str, tmp_path: Path) -> None:
    with run_script(code, tmp_path) as process:
        assert process.stdout is not None
        worker = int(process.stdout.readline())
        os.kill(worker, 0)
        process.kill()
    for _ in range(100):
        if not is_running(worker):
            return
        time.sleep(0.1)
    raise AssertionError(f"worker {worker} is still there")


def is_running(process: int) -> bool:
    """A zombie, which its new parent has not looked at yet, is not."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{process}/stat")
    return not (status.exists() and ") Z " in status.read_text())


# -- a dask cluster


@pytest.mark.slow
def test_an_address_where_no_scheduler_answers_is_refused() -> None:
    pytest.importorskip("distributed", reason="needs the [cluster] extra")
    with pytest.raises(InputError, match=r"--scheduler tcp://127\.0\.0\.1:9: no dask scheduler answers"):
        executor_factory(1, "tcp://127.0.0.1:9")


@pytest.mark.slow
def test_a_killed_worker_of_a_cluster_costs_no_trial(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="needs the [cluster] extra")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        factory = executor_factory(1, cluster.scheduler_address)
        result = run_experiment(toy_experiment(die_once, arguments=(tmp_path,)), tmp_path, factory)
    assert (tmp_path / "died").exists()
    assert [run["seed"] for run in result["runs"]] == [0, 1, 2]
    assert result["errors"] == []
