"""SIGKILL at random moments: no run is lost, and none of its steps beyond the last save."""

from __future__ import annotations

import json
import random
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import pytest
import torch
from killable import KillableCommands
from tiny import SMALL

from edge_se_sampler.bench.results import read_result
from edge_se_sampler.engine.checkpoint import load_latest
from edge_se_sampler.engine.run_folder import RunFolder, config_digest
from edge_se_sampler.methods import method_configs

STEPS = 12
FEW, MANY = 2, pytest.param(100, marks=pytest.mark.slow)


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory) -> Iterator[KillableCommands]:
    with KillableCommands(tmp_path_factory.mktemp("killable") / "saved") as commands:
        assert commands.run(["methods"]) == 0  # it has started
        yield commands


def state_of(run: Path) -> dict[str, Any]:
    folder = RunFolder(run)
    _, state = load_latest(folder.checkpoints, config_digest(folder.config(method_configs())))
    return state


def flat(value: Any) -> Any:
    """Nested values with tensors as bytes, so that == compares them."""
    if isinstance(value, dict):
        return {key: flat(item) for key, item in value.items() if key not in ("elapsed", "setup_seconds")}
    if isinstance(value, list | tuple):
        return [flat(item) for item in value]
    return value.numpy().tobytes() if isinstance(value, torch.Tensor) else value


def metrics_of(run: Path) -> list[dict[str, Any]]:
    return [{key: value for key, value in line.items() if key != "seconds"} for line in RunFolder(run).metrics()]


def train_flags(scene: Path, output_dir: Path) -> list[object]:
    """Of a training that saves after every second step."""
    rest = (
        "--max-num-iterations",
        STEPS,
        "--steps-per-save",
        2,
        "--output-dir",
        output_dir,
        "--steps-per-eval-image",
        4,
    )
    return ["train", "edge-se-nerf", "--data", scene, *SMALL, *rest, "--pipeline.model.width", 8]


@pytest.mark.slow
@pytest.mark.parametrize("kills", [4, MANY])
def test_trainings_survive(
    kills: int, scene: Path, tmp_path: Path, commands: KillableCommands, capfd: pytest.CaptureFixture[str]
) -> None:
    """Trainings are killed in all that they do, resumed, and killed again, until they have ended as they do when left
    alone, bit for bit. Evaluations between them are killed as well."""
    moments = random.Random(0)
    began = time.monotonic()
    assert commands.run(train_flags(scene, tmp_path / "whole")) == 0
    seconds = time.monotonic() - began
    whole = next(tmp_path.glob("whole/*/*/*"))
    assert commands.run(["eval", whole, "--output-path", tmp_path / "eval.json"]) == 0
    evaluated = json.loads((tmp_path / "eval.json").read_text())["results"]
    killed = resumed = evaluations = trainings = 0
    while killed < kills:
        parts = tmp_path / f"parts-{trainings}"
        commands.log.unlink(missing_ok=True)
        code = commands.run(train_flags(scene, parts), moments.uniform(0.05, seconds))
        while code is None:
            killed += 1
            seconds *= 1.01  # the machine may have more to do than at first
            started = [path.parents[1] for path in parts.glob("*/*/*/checkpoints/*.ckpt")]
            if not started:  # nothing was saved yet
                assert commands.last_saved() < 0
                code = commands.run(train_flags(scene, parts), moments.uniform(0.05, seconds))
                continue
            run = started[0]
            assert state_of(run)["step"] >= commands.last_saved()
            if moments.random() < 0.3:
                evaluations += 1
                before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
                flags = ["--output-path", tmp_path / "eval.json"]
                killed += commands.run(["eval", run, *flags], moments.uniform(0, 0.3)) is None
                assert before == {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
                assert json.loads((tmp_path / "eval.json").read_text())["results"].keys() == evaluated.keys()
            resumed += 1
            code = commands.run(["resume", run], moments.uniform(0.05, seconds))
        assert code == 0
        (run,) = (path.parents[1] for path in parts.glob(f"*/*/*/checkpoints/step-{STEPS - 1:09d}.ckpt"))
        assert flat(state_of(run)) == flat(state_of(whole))
        assert metrics_of(run) == metrics_of(whole)
        trainings += 1
        shutil.rmtree(parts)
    assert "takes its place" not in capfd.readouterr().err  # the newest was never damaged
    print(f"{killed} kills, {resumed} resumed, {evaluations} evaluations, {trainings} trainings that ended")


@pytest.mark.parametrize("kills", [FEW, MANY])
@pytest.mark.parametrize("what", ["render", "export"])
def test_files_of_a_run_are_whole_or_not_there(
    what: str, kills: int, run: Path, tmp_path: Path, commands: KillableCommands
) -> None:
    path = tmp_path / {"render": "turn.gif", "export": "cameras.json"}[what]
    flags = {"render": ["--num-frames", 4], "export": ["cameras"]}[what]
    before = {file: file.read_bytes() for file in run.rglob("*") if file.is_file()}
    began = time.monotonic()
    assert commands.run([what, run, *flags, "--output-path", path]) == 0
    seconds, content = time.monotonic() - began, path.read_bytes()
    moments, killed = random.Random(1), 0
    while killed < kills:
        if moments.random() < 0.5:
            path.unlink(missing_ok=True)
        was_there = path.exists()
        killed += commands.run([what, run, *flags, "--output-path", path], moments.uniform(0, seconds)) is None
        assert path.read_bytes() == content if was_there or path.exists() else True
    assert before == {file: file.read_bytes() for file in run.rglob("*") if file.is_file()}


@pytest.mark.parametrize("kills", [1, MANY])
def test_frames_go_on(kills: int, run: Path, tmp_path: Path, commands: KillableCommands) -> None:
    command = ["render", run, "--num-frames", 8, "--outputs", "rgb", "accumulation", "--output-path"]
    began = time.monotonic()
    assert commands.run([*command, tmp_path / "whole"]) == 0
    seconds, moments, killed = time.monotonic() - began, random.Random(2), 0
    whole = [iio.imread(path) for path in sorted((tmp_path / "whole").rglob("*.png"))]
    while killed < kills:
        killed += commands.run([*command, tmp_path / "parts"], moments.uniform(0, seconds)) is None
        assert commands.run([*command, tmp_path / "parts"]) == 0
        found = [iio.imread(path) for path in sorted((tmp_path / "parts").rglob("*.png"))]
        assert all((a == b).all() for a, b in zip(whole, found, strict=True))
        shutil.rmtree(tmp_path / "parts")


@pytest.mark.parametrize("kills", [FEW, MANY])
def test_finished_trials_stay(kills: int, tmp_path: Path, commands: KillableCommands) -> None:
    moments, killed = random.Random(3), 0
    began = time.monotonic()
    assert commands.run(["toy-bench", tmp_path / "whole"]) == 0
    seconds = time.monotonic() - began
    runs = read_result(tmp_path / "whole" / "result.json")["runs"]
    while killed < kills:
        folder = tmp_path / f"parts-{killed}"
        commands.log.unlink(missing_ok=True)
        while commands.run(["toy-bench", folder], moments.uniform(0, seconds / 2)) is None:
            killed += 1
            if commands.last_saved() >= 0:
                found = read_result(folder / "result.json")["runs"]
                assert len(found) >= commands.last_saved()
                assert found == [run for run in runs if run in found]  # trials that end together come in any order
        assert read_result(folder / "result.json")["runs"] == runs
