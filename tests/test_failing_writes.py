"""A disk that is full, or becomes read-only at any write: one line, exit code 2, and what was there is whole."""

from __future__ import annotations

import builtins
import errno
import os
import random
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import pytest
from killable import toy_experiment
from test_killed import flat, metrics_of, state_of
from tiny import SMALL

from edge_se_sampler.bench.results import read_result
from edge_se_sampler.bench.runner import run_experiment
from edge_se_sampler.engine.config import MODEL, override
from edge_se_sampler.engine.files import check_output
from edge_se_sampler.engine.run_folder import EventWriter
from edge_se_sampler.engine.session import prepare
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs

SOME, ALL = 4, pytest.param(None, marks=pytest.mark.slow)


class FailingDisk:
    """Counts what is written below a folder, and lets all but the first `allowed` writes fail; None: none fails."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
        self.folder, self.code, self.count, self.allowed = folder, errno.ENOSPC, 0, None
        opened, system = builtins.open, {name: getattr(os, name) for name in ("mkdir", "replace", "fsync")}

        def open_and_watch(path: Any, mode: str = "r", *arguments: Any, **keywords: Any) -> Any:
            is_written = isinstance(path, str | os.PathLike) and set(mode) & set("wax") and self._is_below(path)
            if is_written:
                self._write()
            file = opened(path, mode, *arguments, **keywords)
            return WatchedFile(file, self._write) if is_written else file

        def watched(name: str) -> Callable[..., Any]:
            def call(path: Any, *arguments: Any, **keywords: Any) -> Any:
                if name == "fsync" or self._is_below(path):
                    self._write()
                return system[name](path, *arguments, **keywords)

            return call

        monkeypatch.setattr(builtins, "open", open_and_watch)
        for name in system:
            monkeypatch.setattr(os, name, watched(name))

    def fail_after(self, allowed: int | None, code: int = errno.ENOSPC) -> None:
        self.count, self.allowed, self.code = 0, allowed, code

    def _is_below(self, path: Any) -> bool:
        return Path(os.fspath(path)).resolve().is_relative_to(self.folder)

    def _write(self) -> None:
        self.count += 1
        if self.allowed is not None and self.count > self.allowed:
            raise OSError(self.code, os.strerror(self.code))


class WatchedFile:
    """A file whose writes are counted; half of one that fails is written."""

    def __init__(self, file: Any, before_write: Callable[[], None]) -> None:
        self._file, self._before_write = file, before_write

    def __enter__(self) -> WatchedFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def write(self, data: Any) -> int:
        try:
            self._before_write()
        except OSError:
            self._file.write(data[: len(data) // 2])
            raise
        return self._file.write(data)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FailingDisk:
    return FailingDisk(monkeypatch, tmp_path / "disk")


def moments(count: int, some: int | None) -> list[int]:
    """All of a number of moments, or some of them."""
    return list(range(count)) if some is None else sorted(random.Random(0).sample(range(count), some))


def train_flags(scene: Path, output_dir: Path) -> list[object]:
    rest = ("--steps-per-save", 2, "--steps-per-eval-image", 3, "--pipeline.model.width", 8)
    return ["train", "edge-se-nerf", "--data", scene, *SMALL, *rest, "--output-dir", output_dir]


@pytest.mark.parametrize("some", [SOME, pytest.param(200, marks=pytest.mark.slow)])
def test_a_training_goes_on_once_there_is_room(
    some: int | None, scene: Path, tmp_path: Path, edge_se, disk: FailingDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("edge_se_sampler.engine.run_folder.find_spec", lambda name: None)  # TensorBoard has threads
    assert edge_se(*train_flags(scene, tmp_path / "disk" / "whole")).code == 0
    whole, resumed = next(tmp_path.glob("disk/whole/*/*/*")), 0
    disk_writes = disk.count
    for number in moments(disk_writes, some):
        parts = tmp_path / "disk" / f"{number}"
        disk.fail_after(number, [errno.ENOSPC, errno.EROFS, errno.EIO][number % 3])
        answer = edge_se(*train_flags(scene, parts))
        assert (answer.code, answer.err.count("\n")) == (2, 1), (number, answer.err)
        disk.fail_after(None)
        assert all((path / "config.json").exists() for path in parts.glob("*/*/*"))
        saved = [path.parents[1] for path in parts.glob("*/*/*/checkpoints/*.ckpt")]
        if not saved:
            continue
        resumed += 1
        state_of(saved[0])
        assert "takes its place" not in (answer := edge_se("resume", saved[0])).err
        assert answer.code == 0, (number, answer.err)
        assert flat(state_of(saved[0])) == flat(state_of(whole))
        assert metrics_of(saved[0]) == metrics_of(whole)
    print(f"{disk_writes} writes, {resumed} resumed")


@pytest.mark.slow
@pytest.mark.parametrize("some", [2, ALL])
@pytest.mark.parametrize(
    "flags",
    [
        ("eval", "--output-path", "eval.json", "--render-output-path", "views"),
        ("render", "--num-frames", "2", "--output-path", "turn.gif"),
        ("render", "--num-frames", "2", "--outputs", "rgb", "--output-path", "frames"),
        ("export", "cameras", "--output-path", "cameras.json"),
        ("export", "points", "--num-points", "50", "--output-path", "points.ply"),
        ("resume", "--max-num-iterations", "9"),
    ],
    ids=" ".join,
)
def test_commands_on_a_run_leave_what_was_there(
    flags: tuple[str, ...], some: int | None, run: Path, tmp_path: Path, edge_se, disk: FailingDisk
) -> None:
    if "points" in flags:
        pytest.importorskip("manifold3d", reason="points need the [export] extra")
    (tmp_path / "disk").mkdir()
    run = run.rename(tmp_path / "disk" / "run")
    kept = shutil.copytree(run, tmp_path / "kept")
    files = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    state = flat(state_of(run))
    command, *rest = (
        tmp_path / "disk" / flag if "." in flag or flag in ("views", "frames") else flag for flag in flags
    )
    disk.fail_after(0)
    number = 0
    while (answer := edge_se(command, run, *rest)).code:
        assert (answer.code, answer.err.count("\n")) == (2, 1), (number, answer.err)
        if command != "resume":
            assert files == {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
        else:
            assert state_of(run)["step"] >= state["step"]
            disk.fail_after(None)
            shutil.rmtree(run)
            shutil.copytree(kept, run)
        number = number + 1 + number // (10 if some is None else 1) * 2
        disk.fail_after(number, [errno.ENOSPC, errno.EROFS, errno.EIO][number % 3])
    disk.fail_after(None)
    assert not list(tmp_path.rglob("*.tmp"))
    print(f"{number} writes")


@pytest.mark.parametrize("some", [4, ALL])
def test_finished_trials_of_a_bench_stay(some: int | None, tmp_path: Path, disk: FailingDisk) -> None:
    def run(folder: Path) -> None:
        run_experiment(toy_experiment(), folder, lambda: ThreadPoolExecutor(1))

    disk.folder.mkdir()  # of all runs alike
    disk.count = 0
    run(tmp_path / "disk" / "whole")
    whole = read_result(tmp_path / "disk" / "whole" / "result.json")["runs"]
    for number in moments(disk.count, some):
        folder = tmp_path / "disk" / f"{number}"
        disk.fail_after(number)
        with pytest.raises(InputError, match="disk"):
            run(folder)
        disk.fail_after(None)
        if (folder / "result.json").exists():
            found = read_result(folder / "result.json")["runs"]
            assert found == [run for run in whole if run in found]
        run(folder)
        assert read_result(folder / "result.json")["runs"] == whole


@pytest.fixture
def tmpfs(tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """Mounts a file system of so many bytes."""
    folder = tmp_path / "small"
    folder.mkdir()
    mounted = []

    def mount(size: int) -> Path:
        while mounted:
            subprocess.run(["umount", mounted.pop()], check=True)
        command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
        if subprocess.run(command, capture_output=True).returncode:
            pytest.skip("file systems cannot be mounted here")
        mounted.append(folder)
        return folder

    yield mount
    for path in mounted:
        subprocess.run(["umount", path], check=True)


@pytest.mark.parametrize("kilobytes", [16, 80])
def test_a_small_file_system_is_filled(kilobytes: int, scene: Path, tmp_path: Path, edge_se, tmpfs) -> None:
    folder = tmpfs(2**10 * kilobytes)
    assert edge_se(*train_flags(scene, tmp_path / "whole")).code == 0
    whole = next(tmp_path.glob("whole/*/*/*"))
    answer = edge_se(*train_flags(scene, folder))
    assert (answer.code, answer.err.count("\n")) == (2, 1), answer.err
    saved = [path.parents[1] for path in folder.glob("*/*/*/checkpoints/*.ckpt")]
    assert (len(saved) > 0) == (kilobytes > 16)
    if saved:
        before = state_of(saved[0])["step"]
        subprocess.run(["mount", "-o", "remount,size=16m", folder], check=True)
        assert edge_se("resume", saved[0]).code == 0
        assert before < state_of(saved[0])["step"]
        assert flat(state_of(saved[0])) == flat(state_of(whole))


def test_a_file_system_that_becomes_read_only(scene: Path, edge_se, tmpfs) -> None:
    folder = tmpfs(2**24)
    assert edge_se(*train_flags(scene, folder)).code == 0
    run = next(folder.glob("*/*/*"))
    state = flat(state_of(run))
    subprocess.run(["mount", "-o", "remount,ro", folder], check=True)
    for command in (["resume", run, "--max-num-iterations", 9], ["eval", run, "--output-path", folder / "e.json"]):
        answer = edge_se(*command)
        assert (answer.code, answer.err.count("\n")) == (2, 1), answer.err
        assert flat(state_of(run)) == state


def test_a_disk_that_fills_under_tensorboard_is_one_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which writes in a thread of its own."""
    record_writer = pytest.importorskip("tensorboard.summary.writer.record_writer")

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    printed: list[object] = []
    monkeypatch.setattr(threading, "excepthook", printed.append)
    (events := EventWriter(tmp_path)).write({"step": 0, "loss": 1.0})
    monkeypatch.setattr(record_writer.RecordWriter, "write", fail)
    worker = events._writer.file_writer.event_writer._async_writer._worker
    with suppress(InputError):  # whether it has failed by now or not
        events.write({"step": 1, "loss": 1.0})
    worker.join(30)
    with pytest.raises(InputError, match="No space left"):
        events.write({"step": 2, "loss": 1.0})
    assert printed == []


def test_a_folder_whose_name_is_no_text_has_no_events(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"s\xff")
    (events := EventWriter(folder)).write({"step": 0, "loss": 1.0})
    events.close()
    assert not folder.exists()
    pytest.importorskip("tensorboard")
    (events := EventWriter(tmp_path / "s")).write({"step": 0, "loss": 1.0})
    events.close()
    assert (tmp_path / "s").exists()


def test_a_tensorboard_that_cannot_be_imported_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("tensorboard")
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    events = EventWriter(tmp_path)
    for step in range(2):
        events.write({"step": step, "loss": 1.0})
    events.close()
    assert capsys.readouterr().err.count("tensorboard cannot be used") == 1


def test_a_preview_that_cannot_be_written_loses_no_training(scene: Path, tmp_path: Path, edge_se) -> None:
    config = method_configs()["vanilla-nerf"]
    changes = {"data": scene, "output_dir": tmp_path / "o", "max_num_iterations": 6, "steps_per_eval_image": 4}
    trainer = prepare(override(config, changes | {f"{MODEL}.size": "tiny", "machine.device_type": "cpu"}))
    shutil.rmtree(trainer.run.path / "previews")
    with pytest.raises(InputError, match="previews"):
        trainer.train()
    answer = edge_se("resume", trainer.run.path)
    assert answer.code == 0, answer.err
    assert [line["step"] for line in trainer.run.metrics() if "loss" in line] == [0, 5]


def test_a_name_that_is_too_long_is_refused_before_the_work(scene: Path, tmp_path: Path) -> None:
    for length, refused in ((245, False), (246, True)):  # 5 more for the ending, and 5 while it is written
        with pytest.raises(InputError, match="too long") if refused else nullcontext():
            check_output(tmp_path / ("a" * length + ".json"), ".json")


def test_a_training_that_is_interrupted_before_its_first_step_leaves_no_folder(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("edge_se_sampler.engine.config.TrainerConfig.setup", interrupt)
    config = override(method_configs()["vanilla-nerf"], {"data": scene, "output_dir": tmp_path / "o"})
    with pytest.raises(KeyboardInterrupt):
        prepare(config)
    assert [path for path in (tmp_path / "o").rglob("*") if path.is_file()] == []
