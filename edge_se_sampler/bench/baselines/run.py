"""Other programs, run unchanged on the chart's scenes by the chart's clock; `external` has the format of the result.

A program is imported from a checkout of its own, or from this environment. Its training loop calls something after
every step (its evaluation, told to come each time, or a callback): there the clock stands still, the test views are
looked at when a look is due, and the program is ended when its time is up. The clock starts when it begins to read
the data, as ours does.
"""
# pyright: reportMissingImports=false
# the programs are in no environment that is linted

from __future__ import annotations

import contextlib
import importlib
import os
import random
import shlex
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edge_se_sampler.bench.baselines.results import ProgramName, read_external
from edge_se_sampler.bench.chart.train import LOOKS, Scale
from edge_se_sampler.bench.experiment import alone
from edge_se_sampler.bench.machine import machine
from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.engine.evaluation import pictures_of
from edge_se_sampler.engine.files import write_json
from edge_se_sampler.engine.metrics import compute_metrics
from edge_se_sampler.errors import InputError

NEVER = str(10**9)
FEWER_LOOKS = LOOKS[1::3]
"""Of ours: the test views may take some of them minutes."""


class TimeIsUp(BaseException):
    """Leaves a program's training loop; not an Exception, so that no program catches it."""


class Clock:
    """Training seconds of a program, and its PSNR at looks."""

    def __init__(self, scale: Scale) -> None:
        self.scale, self.looks = scale, [look for look in FEWER_LOOKS if look < scale.seconds]
        self.curve: list[list[float]] = []
        self.steps, self._stood, self._began = 0, 0.0, 0.0

    def begin(self) -> None:
        """The data are about to be read."""
        self._began = self.scale.clock()

    def step_over(self, psnr: Callable[[], float]) -> None:
        """After a step: look, if it is time to.

        Raises:
            TimeIsUp: after the last look.
        """
        now = self.scale.clock()
        spent = now - self._began - self._stood
        self.steps += 1
        over = spent >= self.scale.seconds
        if over or (self.looks and spent >= self.looks[0]):
            self.looks = [look for look in self.looks if look > spent]
            with torch.no_grad():
                self.curve.append([round(spent, 3), round(psnr(), 3)])
        self._stood += self.scale.clock() - now
        if over:
            raise TimeIsUp


@dataclass(frozen=True)
class Task:
    """A training of another program's."""

    program: ProgramName
    checkout: Path | None
    """None where this environment has it."""
    flags: str
    """Of its own, besides those that name the data."""
    data: Path
    seed: int
    scale: Scale


def run_beside(
    program: ProgramName, checkout: Path | None, label: str, flags: str, scenes: dict[str, Path],
    seeds: Sequence[int], scale: Scale, path: Path,
) -> dict[str, Any]:  # fmt: skip
    """Train another program on scenes (name -> folder) with seeds, and keep its curves in a json of results.

    Args:
        label: added to its name in the chart.
        path: of the json; runs that it already has are kept.

    Raises:
        InputError: the program is not there, refuses its flags or ends too soon, or the json is of another one.
    """
    name = f"{program}, {label}" if label else program
    told = {"name": name, "version": version_of(checkout), "command": f"{program} {flags}".strip(), **asdict(scale)}
    result: dict[str, Any] = {**told, "machine": machine(), "runs": []}
    if path.exists():
        result = read_external(path, "--output-path", scale)
        if any(result.get(key) != value for key, value in told.items()):
            raise InputError(f"{path}: holds runs of something else, or under other flags; name another --output-path")
    done = {(run["scene"], run["seed"]) for run in result["runs"]}
    for seed, scene in product(seeds, scenes):
        if (scene, seed) not in done:
            task = Task(program, checkout, flags, scenes[scene].resolve(), seed, scale)
            try:
                measured = alone(train, task)
            except RuntimeError as problem:
                raise InputError(f"{program} on {scene}, seed {seed}: {problem}") from None
            result["runs"].append({"scene": scene, "seed": seed} | measured)
            write_json(path, result)
    return result


def train(task: Task) -> dict[str, Any]:
    """Steps and curve of a training; in a process of its own, for programs do as they like with what is global."""
    torch.set_num_threads(task.scale.threads)
    clock = Clock(task.scale)
    if task.checkout is not None:
        sys.path.insert(0, str(task.checkout.resolve()))
    with (
        tempfile.TemporaryDirectory() as folder,
        open(os.devnull, "w") as nowhere,
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        try:
            PROGRAMS[task.program](task, Path(folder), clock)
        except TimeIsUp:
            pass
        except (Exception, SystemExit) as problem:  # whatever another program raises
            told = f"{type(problem).__name__}: {problem}"
            raise InputError(f"{task.program} with --checkout {task.checkout}, flags {task.flags!r}: {told}") from None
        else:
            raise InputError(
                f"{task.program} ended by itself after {clock.steps} steps, before {task.scale.seconds:g} s were over: "
                f"ask it for more steps in --flags, now {task.flags!r}"
            )
    return {"steps": clock.steps, "curve": clock.curve}


def _nerf_pytorch(task: Task, folder: Path, clock: Clock) -> None:
    """github.com/yenchenlin/nerf-pytorch with its flags for Blender scenes: the renderings of the test set that it
    is asked for after every step are looked at instead of written."""
    program: Any = importlib.import_module("run_nerf")
    render_path = program.render_path

    def look(*given: Any, **named: Any) -> None:
        clock.step_over(lambda: mean_psnr(render_path(*given, **(named | {"savedir": None}))[0], task.data))

    program.render_path = look
    sys.argv = [
        "run_nerf.py", "--expname", "run", "--basedir", str(folder), "--datadir", str(task.data),
        "--dataset_type", "blender", "--testskip", "1", "--precrop_iters", "500", "--no_batching", "--use_viewdirs",
        "--white_bkgd", "--lrate_decay", "500", "--N_samples", "64", "--N_importance", "128", "--N_rand", "1024",
        "--i_testset", "1", "--i_weights", NEVER, "--i_video", NEVER, *shlex.split(task.flags),
    ]  # fmt: skip
    _seed(task.seed)
    clock.begin()
    program.train()


def _tensorf(task: Task, folder: Path, clock: Clock) -> None:
    """github.com/apchenstu/TensoRF with its configs/lego.txt. Its evaluation asks for a GPU: its renderer is called."""
    program: Any = importlib.import_module("train")

    def look(views: Any, model: Any, _: Any, renderer: Any, *__: Any, N_samples: int, **___: Any) -> list[float]:
        width, height = views.img_wh

        def psnr() -> float:
            rows = [renderer(rays.reshape(-1, 6), model, N_samples=N_samples, device="cpu") for rays in views.all_rays]
            return mean_psnr([row[0].reshape(height, width, 3).numpy() for row in rows], task.data)

        clock.step_over(psnr)
        return [0.0]

    program.evaluation = look
    smaller = 800 / pictures_of(read_blender(task.data, "test"))[0].image.shape[1]
    sys.argv = [
        "train.py", "--config", str(Path(str(program.__file__)).parent / "configs" / "lego.txt"),
        "--datadir", str(task.data), "--basedir", str(folder), "--downsample_train", str(smaller),
        "--vis_every", "1", *shlex.split(task.flags),
    ]  # fmt: skip
    _seed(task.seed)
    arguments = program.config_parser()
    clock.begin()
    program.reconstruction(arguments)


def _nerfstudio(task: Task, folder: Path, clock: Clock) -> None:
    """A method of nerfstudio's as ns-train has it."""
    from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

    from edge_se_sampler.bench.nerfstudio import host_config, host_trainer, rendered_views

    method, flags = task.program.removeprefix("nerfstudio-"), shlex.split(task.flags)
    config = host_config(method, task.seed, task.data, folder, flags)
    clock.begin()
    trainer = host_trainer(config, "test")

    def look(step: int) -> None:
        del step
        clock.step_over(lambda: mean_psnr(rendered_views(trainer), task.data))

    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], look))
    trainer.train()


PROGRAMS: dict[ProgramName, Callable[[Task, Path, Clock], None]] = {
    "nerf-pytorch": _nerf_pytorch,
    "tensorf": _tensorf,
    "nerfstudio-vanilla-nerf": _nerfstudio,
    "nerfstudio-nerfacto": _nerfstudio,
}


def mean_psnr(rendered: Sequence[np.ndarray], data: Path) -> float:
    """Of the test views (H, W, 3) in front of white, the mean over views."""
    pictures = pictures_of(read_blender(data, "test"))
    rows = [
        compute_metrics(np.clip(shown, 0, 1), picture.image, 1.0)
        for shown, picture in zip(rendered, pictures, strict=True)
    ]
    return statistics.mean(row["psnr"] or 0.0 for row in rows)


def _seed(seed: int) -> None:
    """The programs draw from global generators."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)


def version_of(checkout: Path | None) -> str:
    """Of nerfstudio; or the commit of a checkout."""
    try:
        if checkout is None:
            return version("nerfstudio")
        git = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
        return subprocess.run(git, check=True, capture_output=True, text=True).stdout.strip()
    except (ImportError, OSError, subprocess.CalledProcessError) as problem:
        raise InputError(f"no version is to be found: --checkout is {checkout}; give a git checkout") from problem
