"""Checkpoints: written completely or not at all, and never an arbitrary pickle."""

from __future__ import annotations

import errno
import hashlib
import os
import pickle
import random
import subprocess
import sys
import time
from pathlib import Path
from typing import BinaryIO

import pytest
import torch

from edge_se_sampler.engine.checkpoint import (
    MAGIC,
    DamagedCheckpoint,
    latest_checkpoint,
    load_checkpoint,
    load_latest,
    save_checkpoint,
)
from edge_se_sampler.engine.files import write_atomically
from edge_se_sampler.errors import InputError


def state(value: float, digest: str = "d") -> dict:
    return {"step": 1, "config_digest": digest, "model": {"w": torch.full((50, 50), value)}}


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def flip(path: Path, position: int) -> None:
    content = bytearray(path.read_bytes())
    content[position] ^= 1
    path.write_bytes(content)


def test_the_latest_checkpoint_is_loaded_and_the_one_before_is_kept(tmp_path: Path):
    for i in (9, 19, 29):
        (tmp_path / f".step-{i - 5:09d}.ckpt.tmp").touch()  # of a killed process
        save_checkpoint(tmp_path, i, state(float(i)))
    assert names(tmp_path) == ["step-000000019.ckpt", "step-000000029.ckpt"]
    path, loaded = load_latest(tmp_path, "d")
    assert path.name == "step-000000029.ckpt"
    assert torch.equal(loaded["model"]["w"], torch.full((50, 50), 29.0))


def test_a_damaged_checkpoint_gives_way_to_the_one_before_and_that_is_said(tmp_path: Path, capsys):
    before, newest = (save_checkpoint(tmp_path, i, state(float(i))) for i in (9, 19))
    flip(newest, 2000)
    path, loaded = load_latest(tmp_path, "d")
    assert (path, float(loaded["model"]["w"][0, 0])) == (before, 9.0)
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert newest.name in said
    assert before.name in said
    save_checkpoint(tmp_path, 12, state(12.0))  # what is trained after the one before takes the damaged one's place
    assert names(tmp_path) == ["step-000000009.ckpt", "step-000000012.ckpt"]
    for path in tmp_path.iterdir():
        flip(path, 2000)
    with pytest.raises(InputError, match=r"step-000000012\.ckpt: truncated or changed"):
        load_latest(tmp_path, "d")


def test_another_configuration_does_not_fall_back(tmp_path: Path):
    for i, digest in ((9, "d"), (19, "e")):
        save_checkpoint(tmp_path, i, state(1.0, digest))
    with pytest.raises(InputError, match="another configuration"):
        load_latest(tmp_path, "d")


def test_the_latest_checkpoint_has_the_highest_step(tmp_path: Path):
    for step in (999, 5):
        (tmp_path / f"step-{step:09d}.ckpt").write_bytes(b"")
    (tmp_path / "step-1000000000.ckpt").write_bytes(b"")
    (tmp_path / ".step-9999999999.ckpt.tmp").write_bytes(b"")
    (tmp_path / "step-2000000000 (copy).ckpt").write_bytes(b"")
    assert latest_checkpoint(tmp_path).name == "step-1000000000.ckpt"


@pytest.mark.parametrize("position", [0, 19, 30, 84, 85, 200, -1])
def test_a_flipped_bit_is_refused(tmp_path: Path, position: int):
    path = save_checkpoint(tmp_path, 1, state(1.0))
    flip(path, position)
    with pytest.raises(InputError, match=r"step-000000001\.ckpt: (truncated or changed|not a checkpoint)"):
        load_checkpoint(path, "d")


@pytest.mark.parametrize("kept", [0, 10, 84, 1000])
def test_a_truncated_checkpoint_is_refused(tmp_path: Path, kept: int):
    path = save_checkpoint(tmp_path, 1, state(1.0))
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(InputError, match=r"truncated|not a checkpoint"):
        load_checkpoint(path, "d")


LITTLE_MEMORY = """
import resource, sys
from pathlib import Path
from edge_se_sampler.engine.checkpoint import load_checkpoint
small, large = map(Path, sys.argv[1:])
load_checkpoint(small, "d")  # what torch needs to load any
taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (taken + large.stat().st_size * 3 // 2,) * 2)
print(load_checkpoint(large, "d")["w"].shape)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc and RLIMIT_AS")
def test_loading_takes_little_more_memory_than_the_tensors(tmp_path: Path):
    small = save_checkpoint(tmp_path, 1, state(1.0))
    large = save_checkpoint(tmp_path, 2, {"config_digest": "d", "w": torch.zeros(100, 10**6)})
    command = [sys.executable, "-c", LITTLE_MEMORY, str(small), str(large)]
    assert subprocess.run(command, check=True, capture_output=True, text=True).stdout == "torch.Size([100, 1000000])\n"


def test_a_checkpoint_that_cannot_be_read_while_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = save_checkpoint(tmp_path, 1, state(1.0))

    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(torch, "load", fail)
    with pytest.raises(DamagedCheckpoint, match=r"step-000000001\.ckpt: cannot be read \(Input/output error\)"):
        load_checkpoint(path, "d")


def test_another_configuration_is_refused(tmp_path: Path):
    path = save_checkpoint(tmp_path, 1, state(1.0))
    with pytest.raises(InputError, match="another configuration"):
        load_checkpoint(path, "e")


class Bomb:
    def __reduce__(self):
        return os.mkdir, ("exploded",)


@pytest.mark.parametrize("how", ["pickle", "torch"])
def test_a_pickle_is_refused_and_never_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str):
    monkeypatch.chdir(tmp_path)
    payload_path = tmp_path / "payload"
    if how == "torch":
        torch.save({"config_digest": "d", "model": Bomb()}, payload_path)
    else:
        payload_path.write_bytes(pickle.dumps(Bomb()))
    payload = payload_path.read_bytes()
    path = tmp_path / "step-000000001.ckpt"
    path.write_bytes(MAGIC + hashlib.sha256(MAGIC + payload).hexdigest().encode() + b"\n" + payload)
    with pytest.raises(InputError, match="pickle"):
        load_checkpoint(path, "d")
    assert not (tmp_path / "exploded").exists()


FULL_DISK = """
import resource, signal, sys
from pathlib import Path
import torch
from edge_se_sampler.engine.checkpoint import save_checkpoint
from edge_se_sampler.errors import InputError
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))
try:
    save_checkpoint(Path(sys.argv[1]), 2, {"step": 2, "config_digest": "d", "w": torch.zeros(100_000)})
except InputError as problem:
    print(problem)
"""


def test_a_full_disk_leaves_the_old_checkpoint(tmp_path: Path):
    save_checkpoint(tmp_path, 1, state(1.0))
    command = [sys.executable, "-c", FULL_DISK, str(tmp_path)]
    message = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert "step-000000002.ckpt: cannot be written" in message
    assert message.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["step-000000001.ckpt"]
    assert load_checkpoint(latest_checkpoint(tmp_path), "d")["model"]["w"][0, 0] == 1


SAVE_FOREVER = """
import sys
from pathlib import Path
import torch
from edge_se_sampler.engine.checkpoint import save_checkpoint
step = 0
while True:
    step += 1
    save_checkpoint(Path(sys.argv[1]), step, {"step": step, "config_digest": "d", "w": torch.rand(1_000_000)})
    print(step, flush=True)
"""


@pytest.mark.slow
def test_a_checkpoint_loads_after_a_kill_at_a_random_moment(tmp_path: Path):
    moments = random.Random(0)
    for _ in range(3):
        process = subprocess.Popen([sys.executable, "-c", SAVE_FOREVER, str(tmp_path)], stdout=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()  # one is certainly there
        time.sleep(moments.uniform(0, 0.1))
        process.kill()
        process.wait()
        process.stdout.close()
        assert load_checkpoint(latest_checkpoint(tmp_path), "d")["w"].shape == (1_000_000,)


def test_write_atomically_replaces_the_whole_file(tmp_path: Path):
    path = tmp_path / "a.json"
    write_atomically(path, b"old")
    with pytest.raises(InputError, match="untouched"):
        write_atomically(tmp_path / "missing" / "a.json", b"new")
    write_atomically(path, b"new")
    assert path.read_bytes() == b"new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_a_file_that_another_process_has_begun_to_write_is_left_to_it(tmp_path: Path):
    path, temporary = tmp_path / "turn.gif", tmp_path / ".turn.gif.tmp"
    write_atomically(path, b"old")

    def overtaken(file: BinaryIO) -> None:
        file.write(b"the first one's")
        temporary.unlink()
        temporary.write_bytes(b"half of the second o")

    with pytest.raises(InputError, match=r"untouched \(another process writes it, too\)"):
        write_atomically(path, overtaken)
    assert path.read_bytes() == b"old"
    assert temporary.read_bytes() == b"half of the second o"
