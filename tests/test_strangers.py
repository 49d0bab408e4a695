"""Runs, folders and results from a stranger, who can compute a checksum: each attack ends in one line, writes nothing,
and asks for no more than a bounded memory."""

from __future__ import annotations

import io
import json
import os
import pickle
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from blender_folder import chunk, png
from capture_folder import NAMES, write_colmap, write_images, write_transforms
from strangers import change_config, change_state, contents, memory_bound, replace_payload

from edge_se_sampler.bench.results import write_result
from edge_se_sampler.engine.checkpoint import MAGIC, latest_checkpoint

BOUND = 2**30
CONFIGS = Path(__file__).parent.parent / "configs"


@pytest.fixture
def nerf(stranger_runs: dict[str, Path], tmp_path: Path) -> Path:
    return Path(shutil.copytree(stranger_runs["edge-se-nerf"], tmp_path / "nerf"))


@pytest.fixture
def lean(stranger_runs: dict[str, Path], tmp_path: Path) -> Path:
    return Path(shutil.copytree(stranger_runs["lean-nerf"], tmp_path / "lean"))


@pytest.fixture
def refused(edge_se: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """The one line of a command that reads what a stranger made."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> str:
        before = contents(tmp_path)
        with memory_bound(BOUND):
            answer = edge_se(*arguments)
        assert answer.code == 2, answer
        assert (answer.out, answer.err.count("\n")) == ("", 1), answer
        assert len(answer.err) < 1000
        assert "not enough memory" not in answer.err  # what was found is said, not what it led to
        assert contents(tmp_path) == before
        return answer.err

    return call


def set_weight(name: str, value: Any) -> Callable[[dict], None]:
    return lambda state: state["model"].update({name: value})


def keep_a_brick(state: dict) -> None:
    """Of a grid that is right otherwise: the first, all of its cells occupied, and weights of as many rows."""
    weights = state["model"]
    for name in ("bricks", "occupied", "sampled"):
        weights[f"grid.{name}"] = weights[f"grid.{name}"][:1].clone()
    weights["grid.occupied"].fill_(True)
    for name in ("grid.max_weight", "density", "features"):
        weights[name] = weights[name][:64].clone()


STATES = {
    "a grid of 10^6 cells a side": set_weight("grid.size", torch.tensor([10**6] * 3)),
    "a grid of 2^62 cells a side": set_weight("grid.size", torch.tensor([2**62] * 3)),
    "a grid of no cells": set_weight("grid.size", torch.tensor([0, 4, 4])),
    "bricks outside of the box": lambda state: state["model"]["grid.bricks"].add_(10**5),
    "a brick twice": lambda state: state["model"]["grid.bricks"].copy_(state["model"]["grid.bricks"][0].clone()),
    "cells whose corners are not stored": keep_a_brick,
    "samples in empty cells": lambda state: state["model"]["grid.sampled"].fill_(-1),
    "cells of size 0": lambda state: state["model"]["grid.cell_size"].zero_(),
    "sizes as floats": set_weight("grid.size", torch.tensor([4.0, 4.0, 4.0])),
    "one number, shown 10^12 times": set_weight("features", torch.zeros(1).expand(10**6, 10**6)),
    "one number, shown 10^12 times, in a grid": set_weight("grid.occupied", torch.ones(1).bool().expand(2**34, 64)),
    "a weight that is not finite": lambda state: state["model"]["density"].fill_(float("nan")),
    "a density of other rows": set_weight("density", torch.zeros(3, 1)),
    "a list for a weight": set_weight("density", [0.0]),
    "a weight without a name": lambda state: state["model"].update({3: torch.zeros(1)}),
    "a step of 70 bits": lambda state: state.update(step=2**70),
    "no model": lambda state: state.pop("model"),
}


@pytest.mark.parametrize("attack", STATES)
def test_a_checkpoint_of_another_grid_or_weights(attack: str, lean: Path, refused: Callable) -> None:
    change_state(lean, STATES[attack])
    refused("render", lean, "--num-frames", 1)


TRAININGS = {
    "moments of another shape": lambda state: state["optimizer"]["state"][0].update(exp_avg=torch.zeros(1)),
    "moments that show one number again": lambda state: again(state["optimizer"]["state"][0], "exp_avg"),
    "squares that show one number again": lambda state: again(state["optimizer"]["state"][0], "exp_avg_sq"),
    "moments of a step below 0": lambda state: state["optimizer"]["state"][0]["step"].fill_(-1),
    "moments of an unknown weight": lambda state: state["optimizer"]["state"].update({99: {}}),
    "an optimizer of other settings": lambda state: state["optimizer"]["param_groups"][0].update(capturable=True),
    "a group without epsilon": lambda state: state["optimizer"]["param_groups"][0].pop("eps"),
    "groups that are none": lambda state: state["optimizer"].update(param_groups=[3]),
    "a learning rate that is none": lambda state: state["optimizer"]["param_groups"][0].update(lr="high"),
    "a scheduler of other steps": lambda state: state["scheduler"].update(last_epoch=-(10**9)),
    "rates that are none": lambda state: state["scheduler"].update(base_lrs=3),
    "a plan of 10^4 segments": lambda state: state["plan"].update(segments=[1] * 10**4),
    "networks that are none": lambda state: state["dead_network_reset"].update(steps_without_gradient={"x": 1}),
    "errors of images of 10^9 pixels a side": lambda state: errors_of(state).update(sizes=[[0, 10**9, 10**9]]),
    "errors of no image": lambda state: errors_of(state).update(sizes=[[77, 16, 16]]),
    "fewer errors than pixels": lambda state: errors_of(state).update(
        values=torch.zeros(3), updated=torch.zeros(3, dtype=torch.int32)
    ),
    "errors as texts": lambda state: errors_of(state).update(sum="x"),
}


def again(moments: dict, name: str) -> None:
    """The right shape, in a storage that is large enough, of which one number is shown."""
    moments[name] = torch.zeros(moments[name].numel())[-1:].expand(moments[name].shape)


def errors_of(state: dict) -> dict:
    return state["sampler"]["se.selector"]


@pytest.mark.parametrize("attack", TRAININGS)
def test_a_checkpoint_of_another_training(attack: str, nerf: Path, refused: Callable) -> None:
    change_state(nerf, TRAININGS[attack])
    refused("resume", nerf)


@pytest.mark.parametrize("kind", ["nerf", "lean"])
def test_one_moment_for_a_row_of_a_network(kind: str, request: pytest.FixtureRequest, edge_se: Callable) -> None:
    """As tables of sparse gradients have it; torch's fused step would write behind it."""
    run: Path = request.getfixturevalue(kind)

    def shorten(state: dict) -> None:
        moments = state["optimizer"]["state"][0]
        moments["exp_avg_sq"] = moments["exp_avg_sq"][:, :1].clone()

    change_state(run, shorten)
    answer = edge_se("resume", run, "--max-num-iterations", 9)
    assert answer.code == 2, answer
    assert "optimizer" in answer.err
    assert answer.err.count("\n") == 1


class Zeros:
    """A pickle that asks for 100 GB, with a function that torch allows."""

    def __reduce__(self) -> tuple:
        return bytearray, (10**11,)


@pytest.mark.parametrize("attack", ["deflated", "bytearray", "legacy", "nothing", "no zip"])
def test_an_archive_that_is_more_than_it_seems(attack: str, nerf: Path, refused: Callable) -> None:
    payload = io.BytesIO()
    if attack == "bytearray":
        torch.save({"model": Zeros()}, payload)
    elif attack == "legacy":  # which says itself how large its tensors are
        torch.save({"model": torch.zeros(9)}, payload, _use_new_zipfile_serialization=False)
    elif attack == "deflated":
        plain = io.BytesIO()
        torch.save({"model": torch.zeros(2**20)}, plain)
        with zipfile.ZipFile(plain) as source, zipfile.ZipFile(payload, "w", zipfile.ZIP_DEFLATED) as target:
            for name in source.namelist():
                target.writestr(name, source.read(name))
    elif attack == "no zip":
        payload.write(pickle.dumps({"model": 3}))
    replace_payload(nerf, payload.getvalue())
    assert "a pickle" in refused("eval", nerf)


SETTINGS = {
    "networks of 10^6 neurons": ("pipeline.model.width", 10**6),
    "networks of 10^9 layers": ("pipeline.model.depth", 10**9),
    "10^9 samples a ray": ("pipeline.model.num_coarse_samples", 10**9),
    "10^9 rays a step": ("pipeline.datamanager.train_num_rays_per_batch", 10**9),
    "an integer of 400 digits": ("optimizer.lr", 10**400),
    "no such size": ("pipeline.model.size", "x"),
    "no such background": ("pipeline.model.background_color", []),
    "a folder above": ("experiment_name", "../x"),
    "views that are texts": ("views", [["x"]]),
    "a path with a zero byte": ("data", "a\0b"),
    "a text of 10^6 characters": ("machine.seed", "x" * 10**6),
    "a budget of two lines": ("time_budget", "1\n2"),
    "an endless budget": ("time_budget", "9" * 400),
}


@pytest.mark.parametrize("attack", SETTINGS)
def test_settings_that_no_training_had(attack: str, nerf: Path, refused: Callable) -> None:
    path, value = SETTINGS[attack]

    def change(config: dict) -> None:
        *groups, name = path.split(".")
        for group in groups:
            config = config[group]
        assert name in config
        config[name] = value

    change_config(nerf, change)
    refused("eval", nerf)


DEEP = '{"a":' * 10**4 + "1" + "}" * 10**4
JSONS = {
    "nested": DEEP,
    "NaN": '{"a": NaN}',
    "1e999": '{"a": [1e999]}',
    "digits": '{"a": ' + "9" * 10**4 + "}",
    "list": "[1]",
}


@pytest.mark.parametrize("attack", JSONS)
def test_json_that_is_none(attack: str, nerf: Path, tmp_path: Path, refused: Callable) -> None:
    scene = tmp_path / "scene"
    scene.mkdir()
    for path in (nerf / "metrics.jsonl", nerf / "config.json", scene / "transforms.json", scene / "result.json"):
        path.write_text(JSONS[attack] + "\n")
        command = {"transforms.json": ("train", "lean-nerf", "--data"), "result.json": ("bench", "report")}
        refused(*command.get(path.name, ("resume",)), path.parent)


@pytest.mark.parametrize("name", ["checkpoints", "previews", "config.json", "metrics.jsonl"])
def test_a_run_with_a_link_that_leads_out(name: str, nerf: Path, tmp_path: Path, refused: Callable) -> None:
    (nerf / name).rename(tmp_path / "outside")
    os.symlink(tmp_path / "outside", nerf / name)
    assert "leads out of the folder" in refused("resume", nerf)


@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_a_run_whose_checkpoint_is_no_file(kind: str, nerf: Path, refused: Callable) -> None:
    path = latest_checkpoint(nerf / "checkpoints")
    path.unlink()
    os.mkfifo(path) if kind == "pipe" else os.symlink("/dev/zero", path)
    assert "not a regular file" in refused("eval", nerf)


def test_metrics_that_are_a_pipe_are_not_waited_for(nerf: Path, refused: Callable) -> None:
    (nerf / "metrics.jsonl").unlink()
    os.mkfifo(nerf / "metrics.jsonl")
    assert "not a regular file" in refused("resume", nerf)


def test_a_temporary_file_that_is_a_link_is_not_written_through(nerf: Path, tmp_path: Path, edge_se: Callable) -> None:
    (tmp_path / "outside").write_text("mine")
    for name in (".metrics.jsonl.tmp", "checkpoints/.step-000000005.ckpt.tmp"):
        os.symlink(tmp_path / "outside", nerf / name)
    assert edge_se("resume", nerf).code == 0
    assert (tmp_path / "outside").read_text() == "mine"


def jpeg(width: int, height: int) -> bytes:
    frame = struct.pack(">BBHBHHB", 0xFF, 0xC0, 17, 8, height, width, 3) + bytes([1, 17, 0, 2, 17, 1, 3, 17, 1])
    return b"\xff\xd8" + frame + b"\xff\xda" + bytes([0, 12, 3, 1, 0, 2, 17, 3, 17, 0, 63, 0]) + b"\xff\xd9"


IMAGES = {
    "png": png(10**5, 10**5, 8, 2, b""),
    "jpeg": jpeg(65500, 65500),
    "mask": png(13_000, 13_000, 8, 0, bytes(13_000 * 13_001)),
    "text": png(48, 36, 8, 2, bytes(36 * 145), chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(10**8)))),
}


@pytest.mark.parametrize("attack", IMAGES)
def test_an_image_that_is_larger_than_it_should_be(attack: str, tmp_path: Path, refused: Callable) -> None:
    folder = tmp_path / "scene"
    write_transforms(folder)
    if attack == "mask":
        (folder / "masks").mkdir()
    name = f"masks/{NAMES[1]}.png" if attack == "mask" else f"images/{NAMES[1]}"
    (folder / name).write_bytes(IMAGES[attack])
    assert NAMES[1] in refused("train", "lean-nerf", "--data", folder, "--output-dir", tmp_path / "o")


NPY = {
    "10^12 rows": "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 17)}",
    "2^70 rows": f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({2**70}, 17)}}",
    "-1 rows": "{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 17)}",
    "objects": "{'descr': '|O', 'fortran_order': False, 'shape': (2, 17)}",
    "bytes of size 0": "{'descr': '|V0', 'fortran_order': False, 'shape': (1000000000, 17)}",
    "nested": "(" * 5000,
    "open": "{'descr': '''",
}


@pytest.mark.parametrize("attack", NPY)
def test_poses_that_are_no_numbers(attack: str, tmp_path: Path, refused: Callable) -> None:
    header = NPY[attack].encode()
    write_images(tmp_path / "images")
    (tmp_path / "poses_bounds.npy").write_bytes(b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header)
    assert "poses_bounds.npy" in refused("inspect", "--data", tmp_path)


def test_images_and_masks_that_lead_out(tmp_path: Path, refused: Callable) -> None:
    folder, outside = tmp_path / "scene", tmp_path / "outside"
    write_colmap(folder)
    (folder / "images").rename(outside)
    os.symlink(outside, folder / "images")
    assert "leads out of the folder" in refused("inspect", "--data", folder)
    (folder / "images").unlink()
    outside.rename(folder / "images")
    (tmp_path / "empty").mkdir()
    os.symlink(tmp_path / "empty", folder / "masks")
    assert "masks is there already" in refused("masks", "--data", folder)


RESULTS: dict[str, Callable[[dict], object]] = {
    "a script": lambda result: result["runs"][0].update(scene="<script>alert(1)</script>"),
    "a link": lambda result: result["runs"][0].update(scene="[x](javascript:alert(1))"),
    "a table's cell": lambda result: result["runs"][0].update(scene="a | b"),
    "the end of a block": lambda result: result.update(command="```\n# x"),
    "a picture as processor": lambda result: result["machine"].update(processor="![x](http://x)"),
    "a path": lambda result: result["runs"][0].update(scene="../../x"),
    "no numbers": lambda result: result["runs"][0].update(curve=["x"]),
    "a variant that is a list": lambda result: result["runs"][0].update(variant=["x"]),
    "no settings": lambda result: result.update(settings=[]),
    "a run that is none": lambda result: result["runs"].append(3),
    "no machine": lambda result: result.pop("machine"),
}


@pytest.mark.parametrize("attack", RESULTS)
def test_a_result_that_would_be_more_than_text(attack: str, tmp_path: Path, refused: Callable) -> None:
    result = json.loads((CONFIGS / "lean-ten-seeds" / "result.json").read_text())
    RESULTS[attack](result)
    write_result(tmp_path / "result.json", result)
    refused("bench", "report", tmp_path)


def test_checkpoints_are_still_loaded(nerf: Path, lean: Path, tmp_path: Path, edge_se: Callable) -> None:
    assert latest_checkpoint(nerf / "checkpoints").read_bytes().startswith(MAGIC)
    for run in (nerf, lean):
        change_state(run, lambda state: None)
        with memory_bound(BOUND):
            assert edge_se("eval", run, "--output-path", tmp_path / "eval.json").code == 0
        assert edge_se("resume", run).code == 0
