"""Other programs beside ours: a stand-in that trains as they do is timed, looked at, ended, and kept."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_se_sampler.bench.baselines import run as beside
from edge_se_sampler.bench.baselines.results import read_external
from edge_se_sampler.bench.baselines.run import Clock, Scale, Task, TimeIsUp, mean_psnr, train
from edge_se_sampler.data.synthetic import make_scenes

NERF_PYTORCH = """
import sys, time
import numpy as np
import torch

def render_path(poses, savedir=None, gt_imgs=None):
    assert savedir is None  # nothing is written
    time.sleep(0.3)
    return np.full((1, 24, 24, 3), shade, dtype=np.float32), None

def train():
    global shade
    assert "--datadir" in sys.argv
    if "--wrong" in sys.argv:
        sys.exit(2)
    if "--short" in sys.argv:
        return
    shade = 1 - float(torch.rand(()))  # of its own seed
    while True:
        time.sleep(0.02)
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
    raise AssertionError("asks for a GPU")

def config_parser():
    assert sys.argv[sys.argv.index("--downsample_train") + 1] == str(800 / 24)
    return sys.argv

def reconstruction(args):
    while True:
        evaluation(Views(), 1.0, args, renderer, "folder", N_vis=5, N_samples=7, white_bg=True)
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scenes(tmp_path_factory.mktemp("beside"), ["mic"], size=24, num_train=2, num_val=1, num_test=1)[0]


def checkout(folder: Path, name: str, text: str) -> Path:
    folder.mkdir()
    (folder / name).write_text(text)
    git = ["git", "-C", str(folder), "-c", "user.name=a", "-c", "user.email=a@b"]
    for command in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "theirs"]):
        subprocess.run([*git, *command], check=True)
    return folder


def test_the_clock_stands_still_while_a_program_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(Scale, "clock", lambda _: now[0])
    monkeypatch.setattr(beside, "FEWER_LOOKS", (2, 7, 20))
    clock = Clock(Scale(10))

    def look() -> float:
        now[0] += 50
        return 20.0

    def steps() -> None:
        for _ in range(99):
            now[0] += 1.5
            clock.step_over(look)

    clock.begin()
    with pytest.raises(TimeIsUp):
        steps()
    assert clock.steps == 7
    assert clock.curve == [[3.0, 20.0], [7.5, 20.0], [10.5, 20.0]]


def test_a_program_is_run_with_each_seed_and_its_curves_are_kept(
    made: Path, tmp_path: Path, edge_se: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    theirs, path = checkout(tmp_path / "theirs", "run_nerf.py", NERF_PYTORCH), tmp_path / "r" / "theirs.json"
    flags = ["--program", "nerf-pytorch", "--checkout", theirs, "--output-path", path, "--data", made.parent,
             "--scenes", "mic", "--seconds", 1, "--threads", 2, "--label", "small"]  # fmt: skip
    answer = edge_se("bench", "beside", *flags, "--flags=--netdepth 4", "--seeds", 0)
    assert answer.code == 0, answer
    answer = edge_se("bench", "beside", *flags, "--flags=--netdepth 4", "--seeds", 0, 1)
    assert answer.code == 0, answer
    result = read_external(path, "--output-path", Scale(1, threads=2, pixels=24))
    commit = subprocess.run(["git", "-C", theirs, "rev-parse", "HEAD"], capture_output=True, text=True).stdout
    assert (result["name"], result["command"]) == ("nerf-pytorch, small", "nerf-pytorch --netdepth 4")
    assert commit.startswith(result["version"])
    first, second = result["runs"]
    assert (first["scene"], first["seed"], second["seed"]) == ("mic", 0, 1)
    ((seconds, psnr),) = first["curve"]
    assert 1 <= seconds < 5
    assert seconds / 5 < 0.02 * first["steps"] <= seconds  # no look counts as training, nor as steps
    assert psnr != second["curve"][0][1]  # its own generator was seeded
    before = path.read_bytes()
    for wrong, word in (
        (["--flags=--netdepth 5"], "under other flags"),
        (["--flags=--netdepth 4", "--seconds", 0], "at least 1"),
    ):
        answer = edge_se("bench", "beside", *flags, *wrong)
        assert answer.code == 2, answer
        assert word in answer.err
        assert path.read_bytes() == before


def test_a_program_that_refuses_its_flags_or_ends_too_soon_is_told_in_one_line(
    made: Path, tmp_path: Path, edge_se: Any
) -> None:
    theirs = checkout(tmp_path / "theirs", "run_nerf.py", NERF_PYTORCH)
    flags = [
        "--program",
        "nerf-pytorch",
        "--output-path",
        tmp_path / "t.json",
        "--data",
        made.parent,
        "--scenes",
        "mic",
    ]
    for more, word in (
        (["--checkout", theirs, "--flags=--wrong"], "SystemExit: 2"),
        (["--checkout", theirs, "--flags=--short"], "ended by itself after 0 steps"),
        (["--checkout", tmp_path / "none"], "give a git checkout"),
    ):
        answer = edge_se("bench", "beside", *flags, *more)
        assert answer.code == 2, answer
        assert word in answer.err
        assert len(answer.err.strip().splitlines()) == 1
    assert not (tmp_path / "t.json").exists()


def test_the_program_that_asks_for_a_gpu_is_looked_at_without(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(beside, "FEWER_LOOKS", ())
    told = train(
        Task("tensorf", checkout(tmp_path / "theirs", "train.py", TENSORF), "", made, 0, Scale(0.2, threads=2))
    )
    ((_, psnr),) = told["curve"]
    assert psnr == pytest.approx(mean_psnr([np.ones((24, 24, 3), np.float32)], made), abs=1e-3)
