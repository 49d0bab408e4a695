"""Bad input at the command line: exit code 2, a message on stderr that says what and where, nothing written."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from tiny import SMALL
from torch.optim.lr_scheduler import LambdaLR


def files(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def rejected(edge_se: Callable, folder: Path, *arguments: object) -> str:
    """What the parser (tyro) says about flags that it does not know or cannot read; the folder stays as it was."""
    before = files(folder)
    answer = edge_se(*arguments)
    assert answer.code == 2, answer
    assert "Traceback" not in answer.err
    assert answer.out == ""
    assert files(folder) == before
    return answer.err


def refused(edge_se: Callable, folder: Path, *arguments: object) -> str:
    """The one line about input that the parser accepts; the folder stays as it was."""
    line = rejected(edge_se, folder, *arguments)
    assert line.startswith("edge-se: ")
    assert line.count("\n") == 1, line
    return line


def spoil(scene: Path, change: Callable[[dict], object]) -> None:
    path = scene / "transforms_train.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


DATA = {
    "angle": (lambda scene: spoil(scene, lambda c: c.update(camera_angle_x="wide")), "camera_angle_x"),
    "no frames": (lambda scene: spoil(scene, lambda c: c.update(frames=[])), "frames"),
    "broken json": (
        lambda scene: (scene / "transforms_train.json").write_text('{"frames": ['),
        "transforms_train.json",
    ),
    "missing file": (lambda scene: (scene / "transforms_train.json").unlink(), "transforms_train.json"),
    "missing image": (lambda scene: (scene / "train" / "r_1.png").unlink(), "r_1"),
    "truncated image": (
        lambda scene: (scene / "train" / "r_1.png").write_bytes((scene / "train" / "r_1.png").read_bytes()[:300]),
        "r_1.png",
    ),
    "leaving path": (lambda scene: spoil(scene, lambda c: c["frames"][2].update(file_path="../r_0")), "frames[2]"),
    "bad pose": (lambda scene: spoil(scene, lambda c: c["frames"][1].update(transform_matrix=[[1]])), "frames[1]"),
}


@pytest.mark.parametrize("case", DATA)
def test_train_on_bad_data(case: str, scene: Path, tmp_path: Path, edge_se):
    break_it, named = DATA[case]
    break_it(scene)
    arguments = ("train", "edge-nerf", "--data", scene, "--output-dir", tmp_path / "o", *SMALL)
    assert named in refused(edge_se, tmp_path, *arguments)


def test_all_pixels_masked(scene: Path, tmp_path: Path, edge_se):
    iio.imwrite(scene / "mask.png", np.zeros((24, 24), np.uint8))
    spoil(scene, lambda c: [frame.update(mask_path="mask.png") for frame in c["frames"]])
    arguments = ("train", "edge-nerf", "--data", scene, "--output-dir", tmp_path / "o", *SMALL)
    assert "mask" in refused(edge_se, tmp_path, *arguments)


def test_alpha_edges_of_images_without_alpha(scene: Path, tmp_path: Path, edge_se):
    for path in (scene / "train").iterdir():
        iio.imwrite(path, iio.imread(path)[..., :3])
    flags = ["--pipeline.datamanager.pixel-sampler.edge-source", "alpha", "--output-dir", tmp_path / "o", *SMALL]
    assert "alpha" in refused(edge_se, tmp_path, "train", "edge-nerf", "--data", scene, *flags)


def test_nothing_left_in_the_crop(scene: Path, tmp_path: Path, edge_se):
    mask = np.full((24, 24), 255, np.uint8)
    mask[4:20, 4:20] = 0
    iio.imwrite(scene / "mask.png", mask)
    spoil(scene, lambda c: [frame.update(mask_path="mask.png") for frame in c["frames"]])
    arguments = ("--data", scene, "--output-dir", tmp_path / "o", *SMALL)
    assert "'precrop'" in refused(edge_se, tmp_path, "train", "precrop-nerf", *arguments)
    assert edge_se("train", "edge-nerf", *arguments).code == 0


UNPARSABLE = [
    (["--pipeline.datamanager.pixel-sampler.erly", "edge"], "pixel-sampler.early"),
    (["--pipeline.datamanager.pixel-sampler.early", "edgy"], "'edgy'"),
    (["--max-num-iterations", "many"], "--max-num-iterations"),
]


@pytest.mark.parametrize(("flags", "named"), UNPARSABLE, ids=[" ".join(flags) for flags, _ in UNPARSABLE])
def test_flags_that_cannot_be_parsed(flags, named: str, scene: Path, tmp_path: Path, edge_se):
    arguments = ("train", "edge-nerf", "--data", scene, "--output-dir", tmp_path / "o", *flags)
    assert named in rejected(edge_se, tmp_path, *arguments)


SETTINGS = [
    (["--pipeline.datamanager.pixel-sampler.early-fraction", "1.5"], "early-fraction"),
    (["--pipeline.datamanager.pixel-sampler.early-steps", "9"], "schedule"),
    (["--pipeline.datamanager.pixel-sampler.edge-epsilon", "0"], "edge-epsilon"),
    (["--pipeline.datamanager.pixel-sampler.se-candidates", "1" + 17 * "0"], "to 1000"),
    (["--max-num-iterations", "0"], "--max-num-iterations"),
    (["--machine.seed", str(2**63)], "--machine.seed"),
    (["--max-seconds", "nan"], "--max-seconds"),
    (["--max-seconds", "inf"], "--max-seconds"),
    (["--optimizer.lr", "-1"], "--optimizer.lr"),
    (["--pipeline.model.near", "7"], "near"),
    (["--pipeline.model.depth", "0"], "depth"),
    (["--experiment-name", "../up"], "--experiment-name"),
    (["--machine.device-type", "cuda"], "cuda"),
]


@pytest.mark.parametrize(("flags", "named"), SETTINGS, ids=[" ".join(flags) for flags, _ in SETTINGS])
def test_settings_out_of_range(flags, named: str, scene: Path, tmp_path: Path, edge_se):
    if "cuda" in flags and torch.cuda.is_available():
        pytest.skip("there is a GPU here")
    line = refused(edge_se, tmp_path, "train", "edge-nerf", "--data", scene, "--output-dir", tmp_path / "o", *flags)
    assert named in line


def test_missing_and_unknown_names(tmp_path: Path, edge_se):
    assert "did you mean train?" in refused(edge_se, tmp_path, "trian")
    assert "did you mean edge-se-nerf?" in refused(edge_se, tmp_path, "train", "edge-se-nref", "--data", tmp_path)
    assert "strategies" in refused(edge_se, tmp_path, "bench", "everything")
    assert "demo" in rejected(edge_se, tmp_path)
    assert "--out" in rejected(edge_se, tmp_path, "scenes")
    assert "--data" in refused(edge_se, tmp_path, "train", "edge-nerf")
    assert "mic" in refused(edge_se, tmp_path, "scenes", "--out", tmp_path / "s", "--names", "mike")


def test_the_hint_at_a_misspelt_flag_names_the_whole_command(tmp_path: Path, edge_se):
    for command, flag in (("train edge-nerf", "--max-num-iteratons"), ("bench chart", "--secnds")):
        assert f"edge-se {command} --help" in rejected(edge_se, tmp_path, *command.split(), flag, 3)


def test_the_parsers_message_needs_no_unicode(scene: Path):
    plain = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [sys.executable, "-m", "edge_se_sampler", "show", "--data", scene, "--sed", "3"]
    answer = subprocess.run(command, env=plain, capture_output=True, text=True)
    assert answer.returncode == 2
    assert "--sed" in answer.stderr
    assert "--seed" in answer.stderr  # the nearest flag
    assert "Traceback" not in answer.stderr


def test_an_output_folder_that_cannot_be_written(scene: Path, tmp_path: Path, edge_se):
    (tmp_path / "file").write_text("in the way")
    line = refused(edge_se, tmp_path, "train", "edge-nerf", "--data", scene, "--output-dir", tmp_path / "file", *SMALL)
    assert "--output-dir" in line


@pytest.mark.parametrize(
    ("command", "flag", "path"),
    [
        (("demo",), "--output-dir", "file"),
        (("bench", "chart"), "--output-dir", "file/below"),
        (("bench", "samplers"), "--output-dir", "file/below"),
    ],
)
def test_an_output_that_cannot_be_made_is_refused_early(command, flag: str, path: str, tmp_path: Path, edge_se):
    (tmp_path / "file").write_text("in the way")
    line = refused(edge_se, tmp_path, *command, flag, tmp_path / path)
    assert flag in line
    assert "cannot be created" in line


def test_the_bench_inside_nerfstudio_needs_nerfstudio(tmp_path: Path, edge_se):
    assert "needs all of nerfstudio" in refused(
        edge_se, tmp_path, "bench", "nerfstudio", "--output-dir", tmp_path / "o"
    )


class TestRuns:
    def test_no_run(self, tmp_path: Path, edge_se):
        for command in ("eval", "render", "resume"):
            assert "no such run folder" in refused(edge_se, tmp_path, command, tmp_path / "nowhere")
            assert "config.json" in refused(edge_se, tmp_path, command, tmp_path)
            assert r"no\nsuch\x1b[31m run: " in refused(edge_se, tmp_path, command, "no\nsuch\x1b[31m run")

    def test_without_checkpoint(self, run: Path, edge_se):
        next((run / "checkpoints").iterdir()).unlink()
        for command in ("eval", "resume"):
            assert "no checkpoint" in refused(edge_se, run, command, run)

    def test_with_a_flipped_byte(self, run: Path, edge_se):
        path = next((run / "checkpoints").iterdir())
        content = bytearray(path.read_bytes())
        content[5000] ^= 8
        path.write_bytes(content)
        for command in ("eval", "resume", "render"):
            assert path.name in refused(edge_se, run, command, run)

    def test_with_a_checkpoint_elsewhere(self, run: Path, tmp_path: Path, edge_se):
        path = next((run / "checkpoints").iterdir())
        path.rename(tmp_path / path.name)
        path.symlink_to(tmp_path / path.name)
        for command in ("eval", "resume"):
            assert "leads out of the folder" in refused(edge_se, run, command, run)

    def test_that_cannot_be_extended(self, run: Path, edge_se):
        assert "63 bits" in refused(edge_se, run, "resume", run, "--max-num-iterations", 10**20)
        shutil.rmtree(run / "previews")
        (run / "previews").touch()
        assert "previews: cannot be created" in refused(edge_se, run, "resume", run, "--max-num-iterations", "50")

    def test_with_another_configuration(self, run: Path, edge_se):
        config = json.loads((run / "config.json").read_text())
        config["pipeline"]["model"]["width"] = 32
        (run / "config.json").write_text(json.dumps(config))
        assert "checksum" in refused(edge_se, run, "eval", run)
        del config["checksum"]  # as who insists does
        (run / "config.json").write_text(json.dumps(config))
        assert "another configuration" in refused(edge_se, run, "eval", run)

    @pytest.mark.parametrize(
        ("change", "named"),
        [
            (lambda c: c.pop("optimizer"), "optimizer"),
            (lambda c: c.update(surprise=1), "surprise"),
            (lambda c: c.update(method_name="gone"), "method_name"),
            (lambda c: c["pipeline"].update(model=3), "model"),
            (lambda c: c["machine"].update(seed="a"), "seed"),
            (lambda c: c.update(steps_per_log=1.5), "steps_per_log"),
            (lambda c: c.update(data=None, checksum=None), "data"),
            (lambda c: c.update(format=4), "format"),
            (lambda c: c["pipeline"]["model"].update(size="auto") or c.update(checksum=None), "size"),
        ],
    )
    def test_with_a_config_of_another_version(self, run: Path, edge_se, change, named: str):
        config = json.loads((run / "config.json").read_text())
        change(config)
        (run / "config.json").write_text(json.dumps(config))
        assert named in refused(edge_se, run, "eval", run)

    @pytest.mark.parametrize(
        ("change", "named"),
        [
            (lambda c: c.update(data="/elsewhere"), "data"),
            (lambda c: c.update(eval_every=3), "eval_every"),
            (lambda c: c.update(masks="object"), "masks"),
            (lambda c: c.update(data_format="transforms"), "data_format"),
            (lambda c: c["pipeline"]["model"].update(background_color="black"), "background_color"),
        ],
    )
    def test_of_another_scene_for_the_mean(self, run: Path, tmp_path: Path, edge_se, change, named: str):
        other = Path(shutil.copytree(run, tmp_path / "other"))
        config = json.loads((other / "config.json").read_text())
        change(config)
        (other / "config.json").write_text(json.dumps({**config, "checksum": None}))
        for command in ("eval", "render"):
            line = refused(edge_se, run, command, run, "--average-with", other)
            assert named in line
            assert str(other) in line

    def test_of_itself_for_the_mean(self, run: Path, edge_se):
        assert "named twice" in refused(edge_se, run, "eval", run, "--average-with", run / ".." / run.name)

    def test_with_data_that_is_gone(self, run: Path, scene: Path, edge_se):
        scene.rename(scene.with_name("moved"))
        assert "scene" in refused(edge_se, run, "eval", run)

    def test_outputs_that_cannot_be_written(self, run: Path, tmp_path: Path, edge_se):
        assert "--output-path" in refused(edge_se, run, "eval", run, "--output-path", tmp_path / "no" / "e.json")
        assert ".gif or .mp4" in refused(edge_se, run, "render", run, "--output-path", tmp_path / "x.avi")
        assert "--num-frames" in refused(edge_se, run, "render", run, "--num-frames", 0)
        for unit in (1e-9, 0.001):
            assert "--depth-unit" in refused(edge_se, run, "render", run, "--depth-unit", unit)
        frames = ("--output-path", run / "frames", "--num-frames", 60)
        assert "raw-depth" in refused(edge_se, run, "render", run, *frames, "--depth-unit", 0.001)
        assert "folder of frames" in refused(edge_se, run, "render", run, *frames, "--frames-per-second", 5)
        assert "--num-frames" in refused(edge_se, run, "render", run, *frames, "--kind", "test")
        assert "--num-frames" in refused(edge_se, run, "render", run, *frames, "--camera-path", "path.json")
        assert ".json" in refused(edge_se, run, "eval", run, "--output-path", tmp_path / "eval.png")
        both = ("--kind", "test", "--camera-path", tmp_path / "path.json")
        assert "give one of them" in refused(edge_se, run, "render", run, *both)
        assert "path.json" in refused(edge_se, run, "render", run, *both[2:])
        alone = ("--dataparser-transforms", tmp_path / "dataparser_transforms.json")
        assert "without --camera-path" in refused(edge_se, run, "render", run, *alone)
        assert "--outputs" in refused(edge_se, run, "render", run, "--outputs", "rgb", "rgb")
        for path in (".", tmp_path):
            assert "must name a file" in refused(edge_se, run, "eval", run, "--output-path", path)
        for content in ("{}", "no json"):
            (tmp_path / "other.json").write_text(content)
            assert "no evaluation" in refused(edge_se, run, "eval", run, "--output-path", tmp_path / "other.json")
            assert (tmp_path / "other.json").read_text() == content
        os.mkfifo(tmp_path / "pipe")
        assert "no regular file" in refused(edge_se, run, "eval", run, "--output-path", tmp_path / "pipe")
        assert (tmp_path / "pipe").is_fifo()
        for flag in ("--output-path", "--camera-path"):
            assert "name too long" in refused(edge_se, run, "render", run, flag, tmp_path / (300 * "a" + ".gif"))

    def test_with_damaged_metrics(self, run: Path, edge_se):
        for content in ('{"loss": 1}\n', "no json\n", '{"step": "a"}\n'):
            (run / "metrics.jsonl").write_text(content)
            assert "metrics.jsonl: damaged" in refused(edge_se, run, "resume", run)

    @pytest.mark.parametrize("seconds", ["-5", "0", "nan", "inf"])
    def test_a_time_limit_out_of_range(self, run: Path, edge_se, seconds: str):
        assert "--max-seconds" in refused(edge_se, run, "resume", run, "--max-seconds", seconds)


@pytest.mark.parametrize("command", ["show", "inspect"])
def test_outputs_of_show_and_inspect_that_cannot_be_written(command: str, scene: Path, tmp_path: Path, edge_se):
    for path in (".", tmp_path, tmp_path / "no" / "x.png"):
        assert "--output-path" in refused(edge_se, tmp_path, command, "--data", scene, "--output-path", path)
    jpeg = tmp_path / "x.jpg"
    assert "must end in .png" in refused(edge_se, tmp_path, command, "--data", scene, "--output-path", jpeg)
    if command == "show":
        flags = ["--data", scene, "--output-path", tmp_path / "x.png", "--pixel-sampler.num-rays-per-batch"]
        for count in (-5, 10**20):
            assert f"num-rays-per-batch is {count}" in refused(edge_se, tmp_path, "show", *flags, count)


def test_too_little_memory_is_one_line(scene: Path, tmp_path: Path, edge_se):
    flags = ["--data", scene, "--output-dir", tmp_path / "o", "--pipeline.model.width", 10**7]
    line = refused(edge_se, scene, "train", "vanilla-nerf", *flags)
    assert "transforms_train.json: training on its 3 images takes 11,925,811.8 GiB of memory" in line


@pytest.mark.parametrize("problem", [MemoryError(), torch.cuda.OutOfMemoryError("CUDA out of memory")])
def test_allocations_that_fail_elsewhere_are_one_line_too(problem: Exception, tmp_path: Path, edge_se, monkeypatch):
    monkeypatch.setattr("edge_se_sampler.commands.registered_methods", raising(problem))
    assert "not enough memory" in refused(edge_se, tmp_path, "methods")


def test_other_runtime_errors_are_not_hidden(edge_se, monkeypatch):
    monkeypatch.setattr("edge_se_sampler.commands.registered_methods", raising(RuntimeError("allocation of blame")))
    with pytest.raises(RuntimeError, match="blame"):
        edge_se("methods")


def raising(problem: Exception) -> Callable[[], None]:
    def function() -> None:
        raise problem

    return function


@pytest.mark.parametrize("previews", [1, 100])
def test_a_training_that_diverges_keeps_its_last_good_checkpoint(
    previews: int, scene: Path, tmp_path: Path, edge_se, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(LambdaLR, "get_lr", lambda self: [1e-3 if self.last_epoch < 3 else float("inf")])
    flags = ["--steps-per-eval-image", previews, "--steps-per-save", 1, "--output-dir", tmp_path / "o"]
    answer = edge_se("train", "vanilla-nerf", "--data", scene, *SMALL, *flags)
    assert answer.code == 1
    assert "not finite" in answer.err
    assert answer.err.count("\n") == 1
    kept = sorted(path.name for path in tmp_path.glob("o/*/*/*/checkpoints/*"))
    assert kept == ["step-000000001.ckpt", "step-000000002.ckpt"]
