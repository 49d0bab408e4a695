"""`bench step`: a stand-in for nerf-pytorch takes its steps in turn with vanilla-nerf."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from edge_se_sampler.bench.micro import step
from edge_se_sampler.errors import InputError

SLEEPER = """
import time

def render_path(*args, **kwargs):
    raise AssertionError("is replaced")

def train():
    while True:
        time.sleep(0.02)
        render_path()
"""


def checkout(folder: Path, text: str) -> Path:
    """A git checkout of a program that is called run_nerf.py, as nerf-pytorch's is."""
    folder.mkdir()
    (folder / "run_nerf.py").write_text(text)
    git = ["git", "-C", str(folder), "-c", "user.name=a", "-c", "user.email=a@b"]
    for command in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "a program"]):
        subprocess.run([*git, *command], check=True)
    return folder


@pytest.fixture(autouse=True)
def small_scene(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(step, "cached_scene", lambda *_: scene)


def test_both_programs_are_timed_as_often(tmp_path: Path) -> None:
    result = step.measure(checkout(tmp_path / "sleeper", SLEEPER), tmp_path, 3, "tiny", 8)
    assert {name: len(seconds) for name, seconds in result["seconds"].items()} == {"nerf-pytorch": 3, "vanilla-nerf": 3}
    assert min(result["seconds"]["nerf-pytorch"]) >= 0.02


def test_a_program_that_fails_is_named(tmp_path: Path) -> None:
    broken = checkout(tmp_path / "broken", "render_path = None\ndef train():\n    raise OSError\n")
    with pytest.raises(InputError, match="nerf-pytorch does not train"):
        step.measure(broken, tmp_path, 1, "tiny", 8)
