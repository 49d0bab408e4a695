"""The commands on good input: what they write and print."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import imageio.v3 as iio
import numpy as np
import pytest
from tiny import SMALL

from edge_se_sampler import __main__
from edge_se_sampler.bench.commands import BENCHES
from edge_se_sampler.commands import COMMANDS
from edge_se_sampler.methods import STRATEGIES
from edge_se_sampler.sampling.registry import strategy_names


def test_a_run_folder_has_config_metrics_checkpoint_and_previews(run: Path):
    names = {path.name.split(".tfevents")[0] for path in run.iterdir()}
    events = {"events.out"} if find_spec("tensorboard") else set()
    assert names == {"config.json", "metrics.jsonl", "checkpoints", "previews"} | events
    assert [path.name for path in (run / "checkpoints").iterdir()] == ["step-000000005.ckpt"]
    config = json.loads((run / "config.json").read_text())
    assert config["method_name"] == "edge-se-nerf"
    assert config["pipeline"]["model"]["size"] == "tiny"
    assert None not in config["pipeline"]["model"].values()  # nothing left open: the run says what it is
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if "loss" in line] == [0, 5]
    assert [line["strategy"] for line in lines if "loss" in line] == ["edge", "se"]
    assert len([line for line in lines if "val_psnr" in line]) == 6
    assert iio.imread(run / "previews" / "step-000000005.png").shape == (24, 24, 3)


def test_eval_writes_valid_json_with_nerfstudios_keys(run: Path, tmp_path: Path, edge_se):
    (tmp_path / "eval.json").write_text('{"results": "of an earlier one"}')
    answer = edge_se("eval", run, "--output-path", tmp_path / "eval.json", "--render-output-path", tmp_path / "views")
    assert answer.code == 0
    text = (tmp_path / "eval.json").read_text()
    content = json.loads(text, parse_constant=lambda token: pytest.fail(f"{token} is no json"))
    assert set(content) == {"experiment_name", "method_name", "checkpoint", "results"}
    results = content["results"]
    assert f"PSNR {results['psnr']:.2f} dB over 1 views" in answer.out
    assert results["lpips"] is None
    pair = iio.imread(tmp_path / "views" / "0000.png").astype(float) / 255
    truth, rendered = pair[:, :24], pair[:, 24:]
    assert -10 * np.log10(((truth - rendered) ** 2).mean()) == pytest.approx(results["psnr"], abs=0.1)


@pytest.fixture
def other_run(run: Path, scene: Path, tmp_path: Path, edge_se) -> Path:
    """A run on the same scene, with another seed."""
    flags = ["--data", scene, "--output-dir", tmp_path / "other", "--experiment-name", "scene", "--machine.seed", 1]
    assert edge_se("train", "vanilla-nerf", *flags, *SMALL).code == 0
    return next((tmp_path / "other" / "scene" / "vanilla-nerf").iterdir())


def test_eval_and_render_average_runs(run: Path, other_run: Path, tmp_path: Path, edge_se):
    measured = {}
    for name, runs in {"one": [run], "other": [other_run], "both": [run, "--average-with", other_run]}.items():
        flags = ["--output-path", tmp_path / f"{name}.json", "--render-output-path", tmp_path / name]
        assert edge_se("eval", *runs, *flags).code == 0
        measured[name] = iio.imread(tmp_path / name / "0000.png")[:, 24:].astype(float)
    assert np.abs(measured["one"] - measured["other"]).max() > 10
    np.testing.assert_allclose(measured["both"], (measured["one"] + measured["other"]) / 2, atol=1.01)
    content = json.loads((tmp_path / "both.json").read_text())
    assert [Path(path).parents[1] for path in (content["checkpoint"], *content["averaged_with"])] == [run, other_run]

    folder = tmp_path / "frames"
    flags = ["--output-path", folder, "--kind", "test"]
    assert edge_se("render", run, *flags, "--average-with", other_run).code == 0
    frame = iio.imread(folder / "rgb" / "00000.png").astype(float)
    np.testing.assert_allclose(frame, measured["both"], atol=1.01)
    assert "checkpoint" in edge_se("render", run, *flags).err  # these frames are of both runs


def test_render_gif(run: Path, tmp_path: Path, edge_se):
    path = tmp_path / "turn.gif"
    assert edge_se("render", run, "--output-path", path, "--num-frames", 3, "--outputs", "rgb", "depth").code == 0
    assert iio.imread(path, index=None).shape == (3, 24, 48, 3)


@pytest.mark.parametrize(("kind", "count"), [("interpolate", 4), ("train", 3), ("test", 1)])
def test_render_views_and_between_them(kind: str, count: int, run: Path, tmp_path: Path, edge_se):
    folder = tmp_path / "frames"
    flags = ["--kind", kind, "--outputs", "rgb", "rgba", *(["--num-frames", 4] if kind == "interpolate" else [])]
    assert edge_se("render", run, "--output-path", folder, *flags).code == 0
    assert len(list(folder.glob("rgb/*.png"))) == len(list(folder.glob("rgba/*.png"))) == count
    shown = json.loads((folder / "frames.json").read_text())["frames"]
    split = "test" if kind == "test" else "train"
    poses = json.loads((run.parents[3] / "scene" / f"transforms_{split}.json").read_text())["frames"]
    pairs = [(shown[0], poses[0]), (shown[-1], poses[-1])]
    assert all(np.allclose(a["transform_matrix"], b["transform_matrix"], atol=1e-6) for a, b in pairs)


def test_render_a_camera_path_at_its_rate(run: Path, scene: Path, tmp_path: Path, edge_se):
    poses = [frame["transform_matrix"] for frame in json.loads((scene / "transforms_train.json").read_text())["frames"]]
    cameras = [{"camera_to_world": np.ravel(pose).tolist(), "fov": 39.6} for pose in poses[:2]]
    path = {"camera_path": cameras, "render_height": 12, "render_width": 20, "fps": 10}
    (tmp_path / "path.json").write_text(json.dumps(path))
    flags = ["--camera-path", tmp_path / "path.json"]
    assert edge_se("render", run, "--output-path", tmp_path / "a.gif", *flags).code == 0
    assert iio.imread(tmp_path / "a.gif", index=None).shape == (2, 12, 20, 3)
    assert iio.immeta(tmp_path / "a.gif")["duration"] == 100
    assert edge_se("render", run, "--output-path", tmp_path / "a.gif", *flags, "--frames-per-second", 5).code == 0
    assert iio.immeta(tmp_path / "a.gif")["duration"] == 200
    (tmp_path / "moved.json").write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": 0.5}))
    flags += ["--dataparser-transforms", tmp_path / "moved.json", "--output-path", tmp_path / "frames"]
    assert edge_se("render", run, *flags).code == 0
    shown = json.loads((tmp_path / "frames" / "frames.json").read_text())["frames"]
    found, given = (np.array(pose)[:3, 3] for pose in (shown[1]["transform_matrix"], poses[1]))
    np.testing.assert_allclose(found, 2 * given, rtol=1e-6)


def test_show_and_methods(scene: Path, tmp_path: Path, edge_se):
    pytest.importorskip("matplotlib")
    assert edge_se("show", "--data", scene, "--output-path", tmp_path / "show.png", "--num-views", 10**20).code == 0
    assert iio.imread(tmp_path / "show.png").std() > 10
    listed = edge_se("methods").out
    assert [line.split()[0] for line in listed.splitlines()][: len(STRATEGIES)] == list(STRATEGIES)


def test_a_time_limit_stops_the_run_but_leaves_its_schedule(
    scene: Path, tmp_path: Path, edge_se, monkeypatch: pytest.MonkeyPatch
):
    flags = [*SMALL, "--max-num-iterations", 400, "--max-seconds", 0.3, "--output-dir", tmp_path / "o"]
    with monkeypatch.context() as patch:  # a clock that goes on when it is looked at
        patch.setattr("time.monotonic", itertools.count(0, 0.01).__next__)
        answer = edge_se("train", "edge-nerf", "--data", scene, *flags)
    assert answer.code == 0
    assert "edge-se resume" in answer.out
    lines = (next(tmp_path.glob("o/*/*/*")) / "metrics.jsonl").read_text().splitlines()
    last = [json.loads(line) for line in lines][-1]
    assert last["step"] < 200
    rate = json.loads(lines[0])["learning_rate"]
    step = [json.loads(line) for line in lines if "loss" in line][-1]
    assert step["learning_rate"] == pytest.approx(rate * 0.1 ** (step["step"] / 400))


def test_nothing_existing_is_overwritten(scene: Path, tmp_path: Path, edge_se):
    for _ in range(3):  # within one second
        assert edge_se("train", "edge-nerf", "--data", scene, "--output-dir", tmp_path / "o", *SMALL).code == 0
    assert len(list(tmp_path.glob("o/scene/edge-nerf/*/config.json"))) == 3


def test_training_needs_no_held_out_views(scene: Path, tmp_path: Path, edge_se):
    for split in ("val", "test"):
        (scene / f"transforms_{split}.json").unlink()
    assert edge_se("train", "se-nerf", "--data", scene, "--output-dir", tmp_path / "o", *SMALL).code == 0
    run = next(tmp_path.glob("o/*/*/*"))
    spiral = ("render", run, "--output-path", tmp_path / "spiral.gif", "--num-frames", 2)
    assert edge_se(*spiral).code == 0  # which needs the training cameras only
    answer = edge_se("eval", run, "--output-path", tmp_path / "e.json")
    assert answer.code == 2
    assert "transforms_test.json" in answer.err


def test_help_is_complete_and_loads_no_torch():
    script = (
        "import contextlib, io, json, sys; from edge_se_sampler.cli import main\n"
        "texts = {}\n"
        "for command in sys.argv[1:]:\n"
        "    with contextlib.redirect_stdout(io.StringIO()) as out:\n"
        "        try: main([*command.split(), '--help'])\n"
        "        except SystemExit as end: code = end.code\n"
        "    assert not code and 'torch' not in sys.modules, (command, code, 'torch' in sys.modules)\n"
        "    texts[command] = out.getvalue()\n"
        "print(json.dumps(texts))"
    )
    commands = [*COMMANDS, *(f"bench {name}" for name in BENCHES), "train edge-se-nerf"]
    ended = subprocess.run(
        [sys.executable, "-c", script, *commands], capture_output=True, text=True, env=os.environ | {"COLUMNS": "110"}
    )
    assert ended.returncode == 0, ended.stderr
    texts = json.loads(ended.stdout)
    assert list(texts) == commands
    for command, text in texts.items():
        name = command.split()[-1]  # tyro 1.0 leaves the group out in a process that has parsed before
        assert f"usage: edge-se {command}" in text or f"usage: edge-se {name}" in text
    train = texts["train edge-se-nerf"]
    choices = "".join(train.replace("│", "").split())  # however they are wrapped
    early, late = strategy_names("early"), strategy_names("late")
    for phase, names in (("early", ",".join((*early, "auto"))), ("late", ",".join(late))):
        assert f"--pipeline.datamanager.pixel-sampler.{phase}{{{names}}}" in choices
    assert train.count("--") > 35


@pytest.mark.parametrize("arguments", ["methods", "--help", "train lean-nerf --help"])
def test_a_reader_that_closes_the_pipe_ends_the_command_quietly(arguments: str):
    """As `edge-se methods | head -1`, but the pipe is closed before anything can be written to it."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "edge_se_sampler", *arguments.split()]
    process = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert process.returncode == 141
    assert process.stderr == ""


def test_head_of_a_long_help_is_quiet():
    pipeline = f"{sys.executable} -m edge_se_sampler train lean-nerf --help | head -1"
    shown = subprocess.run(pipeline, shell=True, capture_output=True, text=True, check=True)
    assert shown.stdout.startswith("usage: ")
    assert shown.stderr == ""


@pytest.mark.parametrize("arguments", ["methods", "--help"])
def test_an_output_of_few_characters_is_no_error(arguments: str):
    """As a file on Windows is, or a path that is no UTF-8."""
    command = [sys.executable, "-m", "edge_se_sampler", *arguments.split()]
    environment = {**os.environ, "PYTHONIOENCODING": "ascii:strict"}
    process = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (process.returncode, process.stderr) == (0, "")


@pytest.mark.parametrize(("split", "opaque"), [("train", "training"), ("val", "held-out")])
def test_alpha_that_only_some_views_have_is_said(split: str, opaque: str, scene: Path, tmp_path: Path, edge_se):
    flags = ["--data", scene, "--output-dir", tmp_path / "o", *SMALL]
    assert "alpha" not in edge_se("train", "vanilla-nerf", *flags).err
    for path in (scene / split).iterdir():
        iio.imwrite(path, iio.imread(path)[..., :3])
    assert f"the {opaque} ones have none" in edge_se("train", "vanilla-nerf", *flags).err


def test_ctrl_c_before_the_command_is_imported_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys):
    def interrupt(name: str):
        raise KeyboardInterrupt

    module = ModuleType("edge_se_sampler.cli")
    module.__getattr__ = interrupt  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "edge_se_sampler.cli", module)
    with pytest.raises(SystemExit) as end:
        __main__.main()
    assert (end.value.code, capsys.readouterr().err) == (130, "edge-se: interrupted\n")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="Linux's")
@pytest.mark.parametrize("arguments", ["methods", "--help"])
def test_a_full_disk_under_standard_output_is_one_line(arguments: str):
    command = [sys.executable, "-m", "edge_se_sampler", *arguments.split()]
    with open("/dev/full", "w") as full:
        process = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (process.returncode, process.stderr.count("\n")) == (2, 1), process.stderr
    assert "No space left" in process.stderr


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="a shell's closed files")
def test_a_training_needs_no_standard_output(scene: Path, tmp_path: Path):
    flags = ["train", "edge-se-nerf", "--data", scene, "--output-dir", tmp_path, *SMALL]
    command = 'exec "$@" >&- 2>&-'
    python = [sys.executable, "-m", "edge_se_sampler"]
    assert subprocess.run(["sh", "-c", command, "sh", *python, *map(str, flags)], check=False).returncode == 0
    assert len(list(tmp_path.glob("*/*/*/checkpoints/*"))) == 1
