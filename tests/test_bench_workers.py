"""The processes that train: what one costs that is killed or interrupted, and what it leaves behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path

import pytest
from toy_experiment import ToyTrial, one_thread, read, toy_experiment, train

from edge_se_sampler.bench import runner
from edge_se_sampler.bench.results import Run
from edge_se_sampler.bench.runner import executor_factory, run_experiment, run_in_subprocess
from edge_se_sampler.errors import InputError


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
from edge_se_sampler.bench.runner import executor_factory, run_experiment
from toy_experiment import toy_experiment

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
from edge_se_sampler.bench.runner import executor_factory, run_experiment
from toy_experiment import toy_experiment, train

if __name__ == "__mp_main__":  # a worker, which does not ignore Ctrl-C yet
    print(os.getpid(), flush=True)
    time.sleep(1)
if __name__ == "__main__":
    run_experiment(toy_experiment(train), pathlib.Path("."), executor_factory(1, None))
"""


@pytest.mark.slow
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
