"""Small runs to spoil, checkpoints whose checksum a stranger has computed, and a bound of memory."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from tiny import SMALL

from edge_se_sampler.cli import main
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.checkpoint import MAGIC, latest_checkpoint, load_checkpoint, save_checkpoint
from edge_se_sampler.engine.run_folder import RunFolder, config_digest
from edge_se_sampler.methods import method_configs

resource = pytest.importorskip("resource")  # Unix's
FLAGS = {
    "edge-se-nerf": (
        *SMALL, "--pipeline.model.width", "8", "--pipeline.model.depth", "2", "--reinit-dead", "True",
        "--pipeline.datamanager.pixel-sampler.error-source", "cached",
        "--pipeline.datamanager.pixel-sampler.early-fraction", "0",
    ),
    "lean-nerf": (
        "--max-num-iterations", "6", "--pipeline.datamanager.train-num-rays-per-batch", "16",
        "--machine.device-type", "cpu", "--pipeline.model.voxel-size-px", "1",
    ),
}  # fmt: skip


def make_runs(folder: Path) -> dict[str, Path]:
    """A run of each method, stopped after its first step, in folder/runs; its data in folder/data."""
    (data,) = make_scenes(folder / "data", ["mic"], size=16, num_train=3, num_val=1, num_test=1)
    runs = {}
    for method, flags in FLAGS.items():
        arguments = ("--data", str(data), "--output-dir", str(folder / "runs"), "--max-seconds", "1e-9")
        main(["train", method, *arguments, *flags])
        (runs[method],) = (folder / "runs" / "mic" / method).iterdir()
    return runs


def change_state(run: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change what a run's checkpoint holds; its checksum is right."""
    path = latest_checkpoint(run / "checkpoints")
    state = load_checkpoint(path, config_digest(RunFolder(run).config(method_configs())))
    change(state)
    save_checkpoint(run / "checkpoints", int(path.stem.removeprefix("step-")), state)


def replace_payload(run: Path, payload: bytes) -> None:
    """Other bytes in a run's checkpoint, with their checksum."""
    digest = hashlib.sha256(MAGIC + payload).hexdigest().encode()
    latest_checkpoint(run / "checkpoints").write_bytes(MAGIC + digest + b"\n" + payload)


def change_config(run: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a run's settings; its checkpoint is of the new ones."""
    path, states = run / "config.json", []
    change_state(run, lambda state: states.append(dict(state)))
    config = json.loads(path.read_text())
    del config["checksum"]
    change(config)
    path.write_text(json.dumps(config))
    try:
        states[0]["config_digest"] = config_digest(RunFolder(run).config(method_configs()))
    except ValueError:
        return  # it is refused before the checkpoint is read
    save_checkpoint(run / "checkpoints", states[0]["step"], states[0])


@contextmanager
def memory_bound(num_bytes: int) -> Iterator[None]:
    """Let this process ask for no more than so many further bytes."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + num_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def contents(folder: Path) -> dict[str, bytes | str]:
    """Every file of a folder, and where its links lead."""
    paths = sorted(folder.rglob("*"))
    links = {str(path): os.readlink(path) for path in paths if path.is_symlink()}
    return links | {str(path): path.read_bytes() for path in paths if path.is_file() and not path.is_symlink()}
