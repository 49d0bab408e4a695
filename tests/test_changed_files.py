"""Files that have changed since they were written are refused, or mended with a line: never read as if nothing were."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tiny import SMALL, copy_run

from edge_se_sampler.bench.results import new_result, read_result, write_result
from edge_se_sampler.cli import main
from edge_se_sampler.engine.checkpoint import DamagedCheckpoint, latest_checkpoint, load_checkpoint, load_latest
from edge_se_sampler.engine.run_folder import RunFolder, config_digest
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs

SOME, MANY = 60, pytest.param(1000, marks=pytest.mark.slow)


def change(content: bytes, rng: random.Random) -> bytes:
    """The content with a bit flipped, some bytes replaced, blanked, inserted or left out, at a random place."""
    place, length = rng.randrange(len(content)), rng.choice([1, 1, 2, 16])
    new = {
        "flip": bytes([content[place] ^ 1 << rng.randrange(8)]) + content[place + 1 : place + length],
        "replace": rng.randbytes(length),
        "digits": bytes(rng.choice(b"0123456789") for _ in range(length)),
        "blank": bytes(length),
        "insert": rng.randbytes(length) + content[place : place + length],
        "delete": b"",
    }
    return content[:place] + new[rng.choice(list(new))] + content[place + length :]


def check_changes(path: Path, read: Callable[[], Any], times: int) -> None:
    """Change a file many times: reading it then raises InputError, or finds what was written."""
    content, written, rng = path.read_bytes(), read(), random.Random(0)
    messages: list[str] = []
    for _ in range(times):
        path.write_bytes(changed := change(content, rng))
        try:
            found = read()
        except InputError as problem:
            messages.append(str(problem))
        else:
            assert found == written, f"{content} became {changed}"
    path.write_bytes(content)
    assert all(path.name in message and "\n" not in message for message in messages)
    assert len(messages) > 0.8 * times  # others are blanks, or 1e5 for 1E5


@pytest.fixture(scope="module")
def _trained(_rendered_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    flags = ["--steps-per-save", "3", "--steps-per-log", "1", "--pipeline.model.width", "8"]
    folder = tmp_path_factory.mktemp("changed")
    main(["train", "edge-se-nerf", "--data", str(_rendered_scene), "--output-dir", str(folder), *SMALL, *flags])
    return next(folder.glob("*/*/*"))


@pytest.fixture
def trained(_trained: Path, scene: Path, tmp_path: Path) -> Path:
    """A run with two checkpoints."""
    run = copy_run(_trained, scene, tmp_path / "o")
    assert len(list(run.glob("checkpoints/*"))) == 2
    return run


@pytest.mark.slow
@pytest.mark.parametrize("times", [SOME, MANY])
def test_a_changed_checkpoint(times: int, trained: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder, rng = RunFolder(trained), random.Random(0)
    digest = config_digest(folder.config(method_configs()))
    newest = latest_checkpoint(folder.checkpoints)
    content = newest.read_bytes()
    for _ in range(times):
        newest.write_bytes(changed := change(content, rng))
        if changed == content:
            continue
        with pytest.raises(DamagedCheckpoint):
            load_checkpoint(newest, digest)
        capfd.readouterr()
        path, state = load_latest(folder.checkpoints, digest)
        assert (path.name, state["step"]) == ("step-000000002.ckpt", 2)
        assert capfd.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("times", [SOME, MANY])
def test_a_changed_config(times: int, trained: Path) -> None:
    check_changes(trained / "config.json", lambda: RunFolder(trained).config(method_configs()), times)


@pytest.mark.parametrize("times", [SOME, MANY])
def test_changed_metrics(times: int, trained: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """What is cut short at their end is left out, and that is said."""
    whole = RunFolder(trained).metrics()

    def read() -> list[dict[str, Any]]:
        capfd.readouterr()
        lines = RunFolder(trained).metrics()
        is_cut = "cut short" in capfd.readouterr().err
        return lines + whole[len(lines) :] if is_cut else lines

    check_changes(trained / "metrics.jsonl", read, times)


@pytest.mark.parametrize("times", [SOME, MANY])
def test_a_changed_result(times: int, tmp_path: Path) -> None:
    path, rng = tmp_path / "result.json", random.Random(0)
    runs = [{"scene": "mic", "seed": seed, "psnr": 30 * rng.random(), "curve": [[2, 1e-7]]} for seed in range(9)]
    write_result(path, {**new_result("toy", {"steps": 3}), "errors": [], "runs": runs, "seconds": {10: 0.5, 9: 1.5}})
    check_changes(path, lambda: read_result(path), times)


def test_a_result_without_its_checksum_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    write_result(path, {**new_result("toy", {}), "errors": [], "runs": []})
    content = json.loads(path.read_text())
    del content["checksum"]
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="checksum"):
        read_result(path)


def flip_newest(run: Path) -> Path:
    newest = latest_checkpoint(run / "checkpoints")
    content = bytearray(newest.read_bytes())
    content[len(content) // 2] ^= 4
    newest.write_bytes(content)
    return newest


@pytest.mark.parametrize("command", ["eval", "render", "export", "view", "resume"])
def test_every_command_takes_the_checkpoint_before_a_damaged_one(
    command: str, trained: Path, tmp_path: Path, edge_se, capfd: pytest.CaptureFixture[str]
) -> None:
    flags = {
        "eval": ["--output-path", tmp_path / "eval.json"],
        "render": ["--output-path", tmp_path / "turn.gif", "--num-frames", 2],
        "export": ["points", "--output-path", tmp_path / "points.ply"],
    }
    if command == "export":
        pytest.importorskip("manifold3d", reason="points need the [export] extra")
    newest = flip_newest(trained)
    if command == "view":
        pytest.importorskip("viser", reason="the viewer needs the [view] extra")
        from edge_se_sampler.viewer.viewed import Viewed

        viewed = Viewed.load(RunFolder(trained), RunFolder(trained).config(method_configs()))
        viewed.reload()
        viewed.reload()
        assert viewed.trainer.next_step == 3
        said = capfd.readouterr().err
    else:
        answer = edge_se(command, trained, *flags.get(command, []))
        assert answer.code == 0, answer.err
        said = answer.err
    assert said.count("takes its place") == 1
    if command == "resume":
        assert (
            load_latest(trained / "checkpoints", config_digest(RunFolder(trained).config(method_configs())))[0]
            == newest
        )
        return
    newest.unlink()
    flip_newest(trained)
    if command != "view":
        answer = edge_se(command, trained, *flags.get(command, []))
        assert (answer.code, answer.err.count("\n")) == (2, 1)
        assert "truncated or changed" in answer.err


@pytest.mark.parametrize("command", ["eval", "resume", "render", "export"])
def test_a_run_whose_data_has_moved_is_mended_as_its_message_says(
    command: str, trained: Path, tmp_path: Path, edge_se
) -> None:
    flags = {
        "eval": ["--output-path", tmp_path / "eval.json"],
        "resume": ["--max-num-iterations", 7],
        "render": ["--output-path", tmp_path / "a.gif", "--num-frames", 2],
        "export": ["cameras", "--output-path", tmp_path / "cameras.json"],
    }[command]
    written = json.loads((trained / "config.json").read_text())
    moved = Path(written["data"]).rename(tmp_path / "moved")
    answer = edge_se(command, trained, *flags)
    assert (answer.code, answer.err.count("\n")) == (2, 1)
    assert all(word in answer.err for word in (written["data"], "config.json", '"data"', '"checksum"'))
    del written["checksum"]
    (trained / "config.json").write_text(json.dumps(written | {"data": str(moved)}))
    answer = edge_se(command, trained, *flags)
    assert answer.code == 0, answer.err
