"""Other programs on the chart's scenes: stand-ins that train as they do are timed, evaluated, stopped, and kept."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from edge_se_sampler.bench.baselines.run import BaselineSettings, Clock, TimeIsUp, mean_psnr, read_baselines, train
from edge_se_sampler.bench.chart.trials import ChartSettings
from edge_se_sampler.bench.nerfstudio import host
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.errors import InputError

NERF_PYTORCH = """
import sys, time
import numpy as np
import torch

now = 0.0
time.perf_counter = lambda: now  # the clock of several threads; a busy machine's would tell nothing

def pass_by(seconds):
    global now
    now += seconds

def render_path(poses, savedir=None, gt_imgs=None):
    assert savedir is None  # nothing is written
    pass_by(0.3)
    return np.full((1, 24, 24, 3), shade, dtype=np.float32), None

def train():
    global shade
    assert "--datadir" in sys.argv
    if "--wrong" in sys.argv:
        sys.exit(2)
    if "--short" in sys.argv:
        return
    shade = 1 - float(torch.rand(()))  # depends on the seed
    while True:
        pass_by(0.02)
        with torch.no_grad():
            render_path(None, savedir="x", gt_imgs=None)
"""
TENSORF = """
import sys
import torch

class Views:
    img_wh = (24, 24)
    all_rays = torch.zeros(1, 24 * 24, 6)

def renderer(rays, model, N_samples, device):
    assert (rays.shape, N_samples, device) == ((576, 6), 7, "cpu")
    return torch.ones(576, 3) * model, None

def evaluation(*_, **__):
    raise AssertionError("needs a GPU")

def config_parser():
    assert sys.argv[sys.argv.index("--downsample_train") + 1] == str(800 / 24)
    return sys.argv

def reconstruction(args):
    while True:
        evaluation(Views(), 1.0, args, renderer, "folder", N_vis=5, N_samples=7, white_bg=True)
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scenes(tmp_path_factory.mktemp("baselines"), ["mic"], size=24, num_train=2, num_val=1, num_test=1)[0]


def checkout(folder: Path, name: str, text: str) -> Path:
    """A git checkout of a program of one file."""
    folder.mkdir()
    (folder / name).write_text(text)
    git = ["git", "-C", str(folder), "-c", "user.name=a", "-c", "user.email=a@b"]
    for command in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "a program"]):
        subprocess.run([*git, *command], check=True)
    return folder


def test_the_clock_stands_still_during_an_evaluation_and_while_others_read(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(ChartSettings, "clock", lambda _: now[0])
    clock = Clock(ChartSettings(seconds=10), (7, 2, 20))

    def evaluate() -> float:
        now[0] += 50
        return 20.0

    def take_steps() -> None:
        for _ in range(99):
            now[0] += 1.5
            clock.after_step(evaluate)

    def is_ready() -> bool:
        now[0] += 30
        return now[0] > 300

    clock.start()
    clock.wait(is_ready)
    with pytest.raises(TimeIsUp):
        take_steps()
    assert clock.steps == 7
    assert clock.curve == [[3.0, 20.0], [7.5, 20.0], [10.5, 20.0]]


@pytest.mark.slow
def test_every_seed_is_trained_and_kept(data: Path, tmp_path: Path, edge_se: Any) -> None:
    program = checkout(tmp_path / "program", "run_nerf.py", NERF_PYTORCH)
    options = ["--program", "nerf-pytorch", "--checkout", program, "--output-dir", tmp_path, "--data", data.parent,
               "--scenes", "mic", "--seconds", 1, "--threads", 2, "--label", "4 x 64"]  # fmt: skip
    for seeds in ([0], [0, 1]):
        answer = edge_se("bench", "baselines", *options, "--flags=--netdepth 4", "--seeds", *seeds)
        assert answer.code == 0, answer
    path = tmp_path / "baselines" / "nerf-pytorch-4-x-64.json"
    ((name, result),) = read_baselines(tmp_path, threads=2, image_size=24).items()
    commit = subprocess.run(["git", "-C", program, "rev-parse", "HEAD"], capture_output=True, text=True).stdout
    assert name == f"nerf-pytorch, 4 x 64 ({result['settings']['program_version']})"
    assert result["settings"]["flags"] == "--netdepth 4"
    assert commit.startswith(result["settings"]["program_version"])
    first, second = result["runs"]
    assert (first["scene"], first["seed"], second["seed"]) == ("mic", 0, 1)
    ((seconds, psnr),) = first["curve"]
    assert seconds == pytest.approx(1, abs=0.021)
    assert first["steps"] == round(seconds / 0.02)  # evaluations, of 0.3 s, are neither steps nor training time
    assert psnr != second["curve"][0][1]  # its own random numbers are seeded
    before = path.read_bytes()
    for wrong, message in (
        (["--flags=--netdepth 5"], "other settings"),
        (["--flags=--netdepth 4", "--seconds", 0], "at least 1"),
    ):
        answer = edge_se("bench", "baselines", *options, *wrong)
        assert answer.code == 2, answer
        assert message in answer.err
        assert path.read_bytes() == before


@pytest.mark.slow
def test_a_program_reads_a_smaller_copy(data: Path, tmp_path: Path, edge_se: Any) -> None:
    text = NERF_PYTORCH.replace("(1, 24, 24, 3)", "(1, 12, 12, 3)")
    program = checkout(tmp_path / "program", "run_nerf.py", text)
    options = ["--program", "nerf-pytorch", "--checkout", program, "--output-dir", tmp_path, "--scenes", "mic",
               "--seeds", 0, "--seconds", 1, "--threads", 2, "--workplace", tmp_path, "--downscale", 2]  # fmt: skip
    answer = edge_se("bench", "baselines", *options, "--data", data.parent, "--eval-seconds", 0.4)
    assert answer.code == 0, answer
    ((_, result),) = read_baselines(tmp_path, image_size=12).items()
    assert [seconds for seconds, _ in result["runs"][0]["curve"]] == [pytest.approx(s, abs=0.021) for s in (0.4, 1)]
    answer = edge_se("bench", "baselines", *options)
    assert answer.code == 2
    assert "--downscale is 2: must be 1 without --data" in answer.err


@pytest.mark.slow
def test_a_program_that_refuses_its_flags_or_ends_early_is_named_in_one_line(
    data: Path, tmp_path: Path, edge_se: Any
) -> None:
    program = checkout(tmp_path / "program", "run_nerf.py", NERF_PYTORCH)
    options = ["--program", "nerf-pytorch", "--output-dir", tmp_path, "--data", data.parent, "--scenes", "mic"]
    for more, message in (
        (["--checkout", program, "--flags=--wrong"], "SystemExit: 2"),
        (["--checkout", program, "--flags=--short"], "ended by itself after 0 steps"),
        (["--checkout", tmp_path / "none"], "give a git checkout"),
    ):
        answer = edge_se("bench", "baselines", *options, *more)
        assert answer.code == 2, answer
        assert message in answer.err
        assert len(answer.err.strip().splitlines()) == 1
    assert not list(tmp_path.glob("baselines/*"))


def test_a_program_whose_evaluation_needs_a_gpu_is_evaluated_without(data: Path, tmp_path: Path) -> None:
    settings = BaselineSettings(seconds=0.2, threads=2, program="tensorf", program_version="1", flags="")
    run = train(settings, checkout(tmp_path / "program", "train.py", TENSORF), data, seed=0)
    ((_, psnr),) = run["curve"]
    assert psnr == pytest.approx(mean_psnr([np.ones((24, 24, 3), np.float32)], data), abs=1e-3)


def test_nerfstudio_is_looked_at_between_steps_and_downloads_no_weights(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def download(**_: Any) -> None:
        raise OSError("no network")

    def build_trainer(config: tuple[Any, ...], test_mode: str) -> Any:
        assert config[:2] == ("nerfacto", 7)
        assert config[-1] == ["--rays", "8"]
        assert test_mode == "test"
        metrics.LearnedPerceptualImagePatchSimilarity(normalize=True)
        trainer = SimpleNamespace(pipeline=SimpleNamespace(datamanager=None), callbacks=[], step=0)

        def train_on() -> None:
            for trainer.step in range(10**6):
                trainer.callbacks[0](trainer.step)

        trainer.train = train_on
        return trainer

    callbacks: Any = ModuleType("nerfstudio.engine.callbacks")
    callbacks.TrainingCallback = lambda _, evaluate: evaluate
    callbacks.TrainingCallbackLocation = SimpleNamespace(AFTER_TRAIN_ITERATION=0)
    metrics: Any = ModuleType("torchmetrics.image.lpip")
    metrics.LearnedPerceptualImagePatchSimilarity = download
    for module in (callbacks, metrics):
        parts = module.__name__.split(".")
        for depth in range(1, len(parts)):
            monkeypatch.setitem(sys.modules, ".".join(parts[:depth]), ModuleType(parts[0]))
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(host, "build_config", lambda *options: options)
    monkeypatch.setattr(host, "build_trainer", build_trainer)
    monkeypatch.setattr(host, "render_test_views", lambda trainer: [np.full((24, 24, 3), trainer.step > 0, np.float32)])
    ticks = itertools.count()  # a busy machine's clock would tell nothing
    monkeypatch.setattr(BaselineSettings, "clock", lambda _: 0.01 * next(ticks))
    settings = BaselineSettings(
        seconds=0.2, threads=2, program="nerfstudio-nerfacto", program_version="1", flags="--rays 8"
    )
    run = train(settings, None, data, 7, (0.0, 0.1))
    assert [seconds for seconds, _ in run["curve"][1:]] == [pytest.approx(s, abs=0.011) for s in (0.1, 0.2)]
    assert run["curve"][0][1] < run["curve"][1][1] == run["curve"][2][1]


# -- their files

SETTINGS = {"seconds": 60, "threads": 1, "image_size": 100, "program": "other", "label": "", "program_version": "1",
            "flags": "--fast"}  # fmt: skip
RESULT = {
    "version": 2, "experiment": "baselines", "command": "", "settings": SETTINGS, "machine": {}, "errors": [],
    "runs": [{"scene": "mic", "seed": 0, "curve": [[1, 20.0], [2, 21.0]]}],
}  # fmt: skip


@pytest.mark.parametrize(
    "content",
    [
        "{", "[]", {**RESULT, "runs": 3}, {**RESULT, "version": 1},
        {**RESULT, "settings": {key: value for key, value in SETTINGS.items() if key != "program_version"}},
    ],
)  # fmt: skip
def test_a_file_of_another_format_is_refused(content: Any, tmp_path: Path) -> None:
    write_baseline(tmp_path, content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(
        InputError, match=r"other.json: (not a result of edge-se bench|is not valid json|must be a json object)"
    ):
        read_baselines(tmp_path)


@pytest.mark.parametrize(("field", "value"), [("threads", 2), ("image_size", 400)])
def test_times_of_other_threads_or_image_sizes_are_refused(field: str, value: int, tmp_path: Path) -> None:
    write_baseline(tmp_path, json.dumps({**RESULT, "settings": {**SETTINGS, field: value}}))
    assert list(read_baselines(tmp_path, **{field: value})) == ["other (1)"]
    with pytest.raises(InputError, match=rf"other.json: {field} is {value}, that of the result beside it 100"):
        read_baselines(tmp_path, **{field: 100})


def write_baseline(folder: Path, text: str) -> None:
    (folder / "baselines").mkdir()
    (folder / "baselines" / "other.json").write_text(text)
