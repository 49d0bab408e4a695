"""edge-se view on its address: newer checkpoints, ports and hosts, and Ctrl-C."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from tiny import SMALL

from edge_se_sampler.engine.checkpoint import load_checkpoint, save_checkpoint
from edge_se_sampler.engine.run_folder import RunFolder, config_digest
from edge_se_sampler.methods import method_configs

viser = pytest.importorskip("viser", reason="the viewer needs the [view] extra")

from browsers import wait_until  # noqa: E402

from edge_se_sampler.viewer.address import ViewerConfig  # noqa: E402
from edge_se_sampler.viewer.viewed import Viewed  # noqa: E402


def files_of(run: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in run.rglob("*") if path.is_file()}


def test_a_newer_checkpoint_is_shown_and_nothing_is_written(run: Path) -> None:
    before = files_of(run)
    viewed = Viewed.load(RunFolder(run), RunFolder(run).config(method_configs()))
    assert (viewed.trainer.next_step, viewed.strategy) == (6, "se")
    viewed.reload()
    model = viewed.model
    assert files_of(run) == before
    (old,) = (run / "checkpoints").iterdir()
    # what another process would write at a later step
    state = load_checkpoint(old, config_digest(viewed.trainer.config))
    state["step"], name = 8, next(name for name in state["model"] if "weight" in name)
    state["model"][name] += 1
    save_checkpoint(run / "checkpoints", 8, state)
    viewed.reload()
    assert viewed.trainer.next_step == 9
    assert viewed.model is not model
    assert torch.equal(viewed.model.state_dict()[name], state["model"][name])


def test_what_was_learnt_of_other_images_is_not_shown(run: Path) -> None:
    config = RunFolder(run).config(method_configs())
    (old,) = (run / "checkpoints").iterdir()
    state = load_checkpoint(old, config_digest(config))
    state |= {"data_digest": "another", "sampler": {"late.selector": "of images that are no more"}}
    save_checkpoint(run / "checkpoints", 8, state)
    assert Viewed.load(RunFolder(run), config).trainer.next_step == 6


def test_an_address_has_no_meaning_without_the_viewer(edge_se) -> None:
    answer = edge_se("train", "lean-nerf", "--viewer.port", 8000, "--data", "nowhere")
    assert answer.code == 2
    assert "no effect without --view" in answer.err


def test_a_port_that_is_taken_is_named(run: Path, edge_se) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        answer = edge_se("view", run, "--port", port)
        training = edge_se("train", "lean-nerf", "--view", "--viewer.port", port, "--data", "nowhere")
    for result in (answer, training):
        assert result.code == 2
        assert result.err.count("\n") == 1
        assert f"port {port} of 127.0.0.1 is taken" in result.err


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (("--port", "70000"), "70000"),
        (("--host", "no.such.host.invalid"), "no.such.host.invalid"),
        (("--host", ".."), "--host '..'"),
    ],
)
def test_an_address_that_is_none_is_refused(run: Path, edge_se, flags: tuple[str, str], named: str) -> None:
    answer = edge_se("view", run, *flags)
    assert answer.code == 2
    assert named in answer.err.splitlines()[-1]


def test_another_host_has_a_warning(capsys: pytest.CaptureFixture[str]) -> None:
    ViewerConfig(port=0).check()
    assert not capsys.readouterr().err
    ViewerConfig(host="0.0.0.0", port=0).check()
    assert capsys.readouterr().err.count("\n") == 1


def test_without_viser_the_extra_is_named(run: Path, edge_se, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edge_se_sampler.viewer.address.find_spec", lambda _: None)
    for arguments in (("view", run), ("view", run, "--html", "x.html"), ("train", "lean-nerf", "--view")):
        answer = edge_se(*arguments)
        assert answer.code == 2
        assert "edge-se-sampler[view]" in answer.err


def test_an_address_has_no_meaning_for_a_file(run: Path, tmp_path: Path, edge_se) -> None:
    for flag, value in (("--port", 7008), ("--host", "0.0.0.0")):
        answer = edge_se("view", run, "--html", tmp_path / "x.html", flag, value)
        assert answer.code == 2
        assert "no effect with --html" in answer.err


@contextmanager
def ended(process: subprocess.Popen) -> Iterator[None]:
    """Whatever fails, nothing waits for the process."""
    try:
        yield
    finally:
        process.kill()


@pytest.mark.parametrize("trains", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_page_is_served_on_a_free_port_until_ctrl_c(run: Path, scene: Path, tmp_path: Path, trains: bool) -> None:
    flags = ["view", run, "--port", 0]
    if trains:
        flags = [
            "train",
            "edge-se-nerf",
            "--data",
            scene,
            "--output-dir",
            tmp_path,
            *SMALL,
            "--view",
            "--viewer.port",
            0,
        ]
    command = [sys.executable, "-m", "edge_se_sampler", *map(str, flags)]
    with (
        subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # ignored, where a shell started the tests with &
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        ) as process,
        ended(process),
    ):
        assert process.stdout is not None
        found = re.search(r"http://127\.0\.0\.1:(\d+)", process.stdout.readline())
        assert found is not None
        assert int(found[1]) > 0
        page = urllib.request.urlopen(found[0], timeout=60).read()
        assert b"<html" in page.lower()
        if trains:
            wait_until(lambda: "goes on until Ctrl-C" in process.stdout.readline())  # type: ignore[union-attr]
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=120)
    assert (process.returncode, out, err) == (0, "", "")
