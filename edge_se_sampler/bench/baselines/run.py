"""Other programs, run unchanged on the scenes of the chart or of bench real, by the same clock.

A program is imported from a checkout of its own, or from this environment. Its training loop calls the clock after
every step (in the place of its evaluation, which it then calls each time, or as a callback). The clock starts when
the program begins to read the data, as it does for our trainings; what another process of it imports and reads is left
out. Results are shown beside ours: DIR/baselines/*.json of their folder DIR; a run has scene, seed and curve, rows of
training seconds and mean PSNR of the test views.
"""
# pyright: reportMissingImports=false
# no environment that is linted has the programs

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
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edge_se_sampler.bench.chart.trials import ChartSettings
from edge_se_sampler.bench.results import Run, read_result
from edge_se_sampler.data.dataset import read_split
from edge_se_sampler.engine.metrics import compute_metrics
from edge_se_sampler.engine.rendering import Picture, to_pictures
from edge_se_sampler.errors import InputError


@dataclass(frozen=True, kw_only=True)
class BaselineSettings(ChartSettings):
    """What was run, and how: the flags of `edge-se bench baselines`."""

    program: str
    label: str = ""
    program_version: str
    flags: str

    @property
    def name(self) -> str:
        return f"{self.program}, {self.label}" if self.label else self.program


def read_baselines(folder: Path, **expected: int | str) -> dict[str, dict[str, Any]]:
    """Name and version -> result of the baselines beside a result, in the order of their file names. InputError: a file
    cannot be read, or has other settings than are expected, such as threads or image_size."""
    baselines = {}
    for path in sorted((folder / "baselines").glob("*.json")):
        result = read_result(path)
        try:
            found = BaselineSettings(**result["settings"])
        except TypeError as problem:
            raise InputError(f"{path}: not a result of edge-se bench baselines ({problem!r})") from problem
        for key, value in expected.items():
            if getattr(found, key) != value:
                raise InputError(
                    f"{path}: {key} is {getattr(found, key)!r}, that of the result beside it {value!r}: "
                    "they cannot be compared"
                )
        baselines[f"{found.name} ({found.program_version})"] = result
    return baselines


class TimeIsUp(BaseException):
    """Leaves a program's training loop; not an Exception, so that no program catches it."""


class Clock:
    """A program's training seconds, and its PSNR at evaluations."""

    def __init__(self, settings: ChartSettings, eval_seconds: Iterable[float]) -> None:
        self.settings = settings
        self.due = sorted(seconds for seconds in eval_seconds if seconds < settings.seconds)
        self.curve: list[list[float]] = []
        self.steps, self._start = 0, 0.0

    def start(self) -> None:
        self._start = self.settings.clock()

    def wait(self, is_ready: Callable[[], bool]) -> None:
        """Until another process of the program has imported and read what it needs; that takes no training time."""
        now = self.settings.clock()
        while not is_ready():
            time.sleep(0.01)
        self._start += self.settings.clock() - now

    def after_step(self, psnr: Callable[[], float]) -> None:
        """Evaluate if it is time to; that takes no training time. TimeIsUp after the last evaluation."""
        now = self.settings.clock()
        spent = now - self._start
        self.steps += 1
        is_last = spent >= self.settings.seconds
        if is_last or (self.due and spent >= self.due[0]):
            self.due = [seconds for seconds in self.due if seconds > spent]
            with torch.no_grad():
                self.curve.append([round(spent, 3), round(psnr(), 3)])
        if is_last:
            raise TimeIsUp
        self._start += self.settings.clock() - now


def train(
    settings: BaselineSettings, checkout: Path | None, data: Path, seed: int, eval_seconds: Iterable[float] = ()
) -> Run:
    """Steps and curve of a training, evaluated after some seconds and at the end; to be called in a fresh process,
    because programs change what is global. InputError: the program is not there, refuses its flags or ends too soon."""
    torch.set_num_threads(settings.threads)
    clock = Clock(settings, eval_seconds)
    if checkout is not None:
        sys.path.insert(0, str(checkout.resolve()))
    try:
        with (
            tempfile.TemporaryDirectory() as folder,
            open(os.devnull, "w") as null,
            contextlib.redirect_stdout(null),
            contextlib.redirect_stderr(null),
        ):
            PROGRAMS[settings.program](clock, data, Path(folder), seed, shlex.split(settings.flags))
    except TimeIsUp:
        return {"steps": clock.steps, "curve": clock.curve}
    except (Exception, SystemExit) as problem:  # whatever another program raises
        raise InputError(
            f"{settings.program} with --checkout {checkout}, flags {settings.flags!r}: "
            f"{type(problem).__name__}: {problem}"
        ) from None
    raise InputError(
        f"{settings.program} ended by itself after {clock.steps} steps, before {settings.seconds:g} s were over: "
        f"give it more steps in --flags, now {settings.flags!r}"
    )


def _nerf_pytorch(clock: Clock, data: Path, folder: Path, seed: int, flags: list[str]) -> None:
    """github.com/yenchenlin/nerf-pytorch with its flags for Blender scenes: the renderings of the test set that its
    flags order after every step are evaluated instead of written."""
    program: Any = importlib.import_module("run_nerf")
    render_path = program.render_path

    def evaluate(*args: Any, **kwargs: Any) -> None:
        clock.after_step(lambda: mean_psnr(render_path(*args, **(kwargs | {"savedir": None}))[0], data))

    program.render_path = evaluate
    sys.argv = [
        "run_nerf.py", "--expname", "run", "--basedir", str(folder), "--datadir", str(data),
        "--dataset_type", "blender", "--testskip", "1", "--precrop_iters", "500", "--no_batching", "--use_viewdirs",
        "--white_bkgd", "--lrate_decay", "500", "--N_samples", "64", "--N_importance", "128", "--N_rand", "1024",
        "--i_testset", "1", "--i_weights", "1000000000", "--i_video", "1000000000", *flags,
    ]  # fmt: skip
    _seed(seed)
    clock.start()
    program.train()


def _tensorf(clock: Clock, data: Path, folder: Path, seed: int, flags: list[str]) -> None:
    """github.com/apchenstu/TensoRF with its configs/lego.txt. Its evaluation needs a GPU: its renderer is called."""
    program: Any = importlib.import_module("train")

    def evaluate(views: Any, model: Any, _: Any, renderer: Any, *__: Any, N_samples: int, **___: Any) -> list[float]:
        width, height = views.img_wh

        def psnr() -> float:
            rows = [renderer(rays.reshape(-1, 6), model, N_samples=N_samples, device="cpu") for rays in views.all_rays]
            return mean_psnr([row[0].reshape(height, width, 3).numpy() for row in rows], data)

        clock.after_step(psnr)
        return [0.0]

    program.evaluation = evaluate
    downsampling = 800 / read_test_pictures(data)[0].image.shape[1]
    sys.argv = [
        "train.py", "--config", str(Path(str(program.__file__)).parent / "configs" / "lego.txt"),
        "--datadir", str(data), "--basedir", str(folder), "--downsample_train", str(downsampling),
        "--vis_every", "1", *flags,
    ]  # fmt: skip
    _seed(seed)
    arguments = program.config_parser()
    clock.start()
    program.reconstruction(arguments)


def _nerfstudio(method: str, clock: Clock, data: Path, folder: Path, seed: int, flags: list[str]) -> None:
    """A method of nerfstudio's as ns-train has it."""
    from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

    from edge_se_sampler.bench.nerfstudio.host import (
        build_config,
        build_trainer,
        render_test_views,
        skip_lpips_weights,
    )

    skip_lpips_weights()
    config = build_config(method, seed, data, folder, flags)
    clock.start()
    trainer = build_trainer(config, "test")
    if queue := getattr(trainer.pipeline.datamanager, "data_queue", None):
        clock.wait(lambda: not queue.empty())

    def evaluate(step: int) -> None:
        clock.after_step(lambda: mean_psnr(render_test_views(trainer), data))

    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], evaluate))
    trainer.train()


PROGRAMS: dict[str, Callable[[Clock, Path, Path, int, list[str]], None]] = {
    "nerf-pytorch": _nerf_pytorch,
    "tensorf": _tensorf,
    "nerfstudio-vanilla-nerf": partial(_nerfstudio, "vanilla-nerf"),
    "nerfstudio-nerfacto": partial(_nerfstudio, "nerfacto"),
}


def read_test_pictures(data: Path) -> list[Picture]:
    views = read_split(data, "test")
    if views is None:
        raise InputError(f"{data}: no test views to evaluate on; add transforms_test.json or a list test_filenames")
    return to_pictures(views)


def mean_psnr(rendered: Sequence[np.ndarray], data: Path) -> float:
    """Of the test views (H, W, 3) in front of white, where their pixels are known: the mean over views."""
    pairs = [(np.clip(image, 0, 1), p) for image, p in zip(rendered, read_test_pictures(data), strict=True)]
    return statistics.mean(compute_metrics(image, p.image, 1.0, p.mask)["psnr"] or 0.0 for image, p in pairs)


def _seed(seed: int) -> None:
    """The programs draw from global generators."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)


def version_of(checkout: Path | None) -> str:
    """The version of nerfstudio, or the commit of a checkout; InputError if there is none."""
    try:
        if checkout is None:
            return version("nerfstudio")
        git = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
        return subprocess.run(git, check=True, capture_output=True, text=True).stdout.strip()
    except (ImportError, OSError, subprocess.CalledProcessError) as problem:
        raise InputError(f"no version is to be found: --checkout is {checkout}; give a git checkout") from problem
