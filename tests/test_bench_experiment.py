"""What runs an experiment's trainings: processes that are killed, interrupted, or outlived."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from edge_se_sampler.bench import experiment as running
from edge_se_sampler.bench.chart.train import Scale
from edge_se_sampler.bench.chart.variants import Cell, cells


def interrupts_itself() -> int:
    os.kill(os.getpid(), signal.SIGINT)
    return 7


def test_ctrl_c_is_for_the_one_that_gives_out_the_work() -> None:
    """It reaches every process of the terminal; a worker that answered it would print a traceback."""
    with running.executor_of(1, None)() as executor:
        assert executor.submit(interrupts_itself).result() == 7


INTERRUPTED = """
import os, pathlib, signal, sys, time
from edge_se_sampler.bench.chart.train import Scale
from edge_se_sampler.bench.chart.variants import Cell
from edge_se_sampler.bench.experiment import begun, executor_of, run_cells

def interrupts_and_works_on(cell, *_):
    os.kill(os.getppid(), signal.SIGINT)
    time.sleep(60)

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored, where a shell began the tests with &
    path = pathlib.Path("result.json")
    todo = [Cell("lean", "mic", seed) for seed in range(3)]
    run_cells(todo, begun(path, Scale()), path, executor_of(1, None), interrupts_and_works_on, lambda _: ())
"""


def test_ctrl_c_waits_for_no_cell(tmp_path: Path) -> None:
    (tmp_path / "interrupted.py").write_text(INTERRUPTED)
    began = time.monotonic()
    answer = subprocess.run([sys.executable, "interrupted.py"], cwd=tmp_path, capture_output=True, text=True)
    assert "KeyboardInterrupt" in answer.stderr
    assert time.monotonic() - began < 45


class OnlyWaits(ThreadPoolExecutor):
    """As dask's executor: it can cancel futures, not all at once."""

    def shutdown(self, wait: bool = True) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        super().shutdown(wait=wait)


def test_an_executor_that_only_waits_is_left_in_good_order(tmp_path: Path) -> None:
    def interrupted(*_: Any) -> dict[str, Any]:
        raise KeyboardInterrupt

    todo, path = cells(("lean",), ("mic",), (0, 1)), tmp_path / "result.json"
    with pytest.raises(KeyboardInterrupt):
        running.run_cells(todo, running.begun(path, Scale()), path, lambda: OnlyWaits(1), interrupted, lambda _: ())


GIVES_OUT_WORK = """
import os, time
from edge_se_sampler.bench.experiment import executor_of
if __name__ == "__main__":
    executor = executor_of(1, None)()
    print(executor.submit(os.getpid).result(), flush=True)
    time.sleep(60)
"""


def test_workers_do_not_outlive_the_one_that_gave_out_the_work(tmp_path: Path) -> None:
    (tmp_path / "gives_out_work.py").write_text(GIVES_OUT_WORK)
    command = [sys.executable, tmp_path / "gives_out_work.py"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        worker = int(process.stdout.readline())
        os.kill(worker, 0)
        process.kill()
    for _ in range(100):
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            return
        if Path(f"/proc/{worker}/stat").exists() and ") Z " in Path(f"/proc/{worker}/stat").read_text():
            return  # dead, and its new parent has not looked yet
        time.sleep(0.1)
    raise AssertionError(f"worker {worker} is still there")


def test_a_killed_training_is_told_and_costs_no_other(tmp_path: Path) -> None:
    todo = cells(("lean", "edge", "se"), ("mic", "mic"), (0, 0))
    result = running.begun(tmp_path / "result.json", Scale())

    def train(cell: Cell) -> dict[str, Any]:
        if cell.variant == "edge":
            return running.alone(os._exit, 1)
        return {"variant": cell.variant, "scene": cell.scene, "seed": cell.seed}

    running.run_cells(todo, result, tmp_path / "result.json", lambda: ThreadPoolExecutor(2), train, lambda _: ())
    assert [run["variant"] for run in result["runs"]] == ["lean", "se"]  # once each
    ((error),) = result["errors"]
    assert (error["variant"], error["error"]) == (
        "edge", "RuntimeError: its process was killed; is there too little memory?",
    )  # fmt: skip


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="looks for processes in /proc")
def test_a_process_of_its_own_ends_with_the_one_that_asked_for_it() -> None:
    program = "import time; from edge_se_sampler.bench.experiment import alone; alone(time.sleep, 60)"
    with subprocess.Popen([sys.executable, "-c", program]) as parent:
        children: list[Path] = []
        until = time.monotonic() + 60
        while not children and time.monotonic() < until:
            time.sleep(0.2)
            numbers = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
            running = [Path("/proc") / number for number in numbers]
            children = [place for place in running if b"spawn_main" in (place / "cmdline").read_bytes()]
        time.sleep(3)  # it imports, and begins to sleep
        parent.kill()
    assert children
    while children[0].exists() and b"spawn_main" in (children[0] / "cmdline").read_bytes():
        assert time.monotonic() < until + 20, "it goes on"
        time.sleep(0.2)
