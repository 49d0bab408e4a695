"""Commands of edge-se in a process that is killed (SIGKILL) after a while; what they import is loaded once."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stderr, suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.runner import Experiment, run_experiment

PRELOADED = (
    "edge_se_sampler.engine.evaluation",
    "edge_se_sampler.engine.session",
    "edge_se_sampler.engine.video",
    "edge_se_sampler.export.cameras",
    "torch.utils.tensorboard",
)


class KillableCommands:
    """Runs commands, one after the other, in forks of one process that trains nothing itself."""

    def __init__(self, log: Path) -> None:
        """`log` gets a line for every checkpoint and result.json that has been written completely."""
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
        self.log = log
        command = [sys.executable, __file__, str(log)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )

    def __enter__(self) -> KillableCommands:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def last_saved(self) -> int:
        """The last step, or number of trials, whose saving had ended since the log was removed; -1: none."""
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        return int(lines[-1]) if lines else -1

    def run(self, arguments: Sequence[object], seconds: float | None = None) -> int | None:
        """A command's exit code; None: it was killed after so many seconds."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([[str(argument) for argument in arguments], seconds]) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


@dataclass(frozen=True)
class ToySettings:
    size: int = 1000


@dataclass(frozen=True)
class ToyTrial:
    seed: int


def toy_experiment() -> Experiment:
    """An experiment of 12 trials with large runs, which take no time."""

    def train(trial: ToyTrial) -> dict[str, Any]:
        return {"values": [trial.seed + i / 7 for i in range(ToySettings().size)]}

    trials = [ToyTrial(seed) for seed in range(12)]
    return Experiment("toy", ToySettings(), lambda _: trials, train, lambda _: ())


def _serve(log: Path) -> None:
    import torch

    import edge_se_sampler.engine.trainer as trainer
    from edge_se_sampler.bench import runner
    from edge_se_sampler.cli import main

    for name in PRELOADED:
        with suppress(ImportError):
            import_module(name)
    torch.set_num_threads(1)
    weight = torch.ones(1)
    weight.grad = torch.ones(1)
    torch.optim.Adam([weight]).step()  # imports as well
    torch.save({"w": weight}, buffer := io.BytesIO())
    torch.load(io.BytesIO(buffer.getvalue()), weights_only=True)
    for words in (
        ["train", "edge-se-nerf"],
        ["resume", "."],
        ["eval", "."],
        ["render", "."],
        ["export", ".", "cameras"],
    ):
        with suppress(SystemExit), redirect_stderr(io.StringIO()):
            main(words)  # refused, but what parsing them takes is done once

    def logged(function: Any, describe: Any) -> Any:
        def call(*arguments: Any) -> Any:
            result = function(*arguments)
            with open(log, "a") as file:
                file.write(describe(*arguments) + "\n")
            return result

        return call

    trainer.save_checkpoint = logged(trainer.save_checkpoint, lambda folder, step, state: str(step))
    runner.write_result = logged(runner.write_result, lambda path, result: str(len(result["runs"])))
    for line in sys.stdin:
        arguments, seconds = json.loads(line)
        child = os.fork()
        if not child:
            _run(arguments)
        end = time.monotonic() + (600 if seconds is None else seconds)
        ended, status = os.waitpid(child, os.WNOHANG)
        while not ended and time.monotonic() < end:
            time.sleep(0.001)
            ended, status = os.waitpid(child, os.WNOHANG)
        if not ended:
            os.kill(child, signal.SIGKILL)
            _, status = os.waitpid(child, 0)
        print(json.dumps(None if os.WIFSIGNALED(status) else os.WEXITSTATUS(status)), flush=True)


def _run(arguments: list[str]) -> None:
    """Run a command in this process, and end it."""
    from edge_se_sampler.cli import main

    code = 1
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)  # standard output is for the answers
    try:
        if arguments[0] == "toy-bench":
            run_experiment(toy_experiment(), Path(arguments[1]), lambda: ThreadPoolExecutor(1))
        else:
            main(arguments)
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    finally:
        os._exit(code)


if __name__ == "__main__":
    _serve(Path(sys.argv[1]))
