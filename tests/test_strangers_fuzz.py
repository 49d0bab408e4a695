"""Runs, captures and results that are changed at random: they are used, or refused in one line."""

from __future__ import annotations

import contextlib
import io
import json
import random
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from capture_folder import NAMES, colmap_files, transforms, write_images
from changes import change_bytes, change_value
from strangers import contents, memory_bound, replace_payload

from edge_se_sampler.bench.report import write_report
from edge_se_sampler.data.dataset import list_frames, read_split
from edge_se_sampler.engine.checkpoint import latest_checkpoint
from edge_se_sampler.engine.run_folder import RunFolder, config_digest
from edge_se_sampler.engine.session import load_model, prepare_resume
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs

CONFIGS = Path(__file__).parent.parent / "configs"


def dump(value: Any) -> bytes:
    return json.dumps(value).encode()


class Folders:
    """Good runs and captures, and what a case reads: each is spoiled in a folder of its own, and mended again."""

    def __init__(self, folder: Path, runs: dict[str, Path]) -> None:
        self.folder = folder
        self.runs = [Path(shutil.copytree(run, folder / "runs" / name)) for name, run in runs.items()]
        self.scene = Path(shutil.copytree(next(iter(runs.values())).parents[3] / "data" / "mic", folder / "scene"))
        for name in ("transforms", "colmap", "text", "llff"):
            write_images(folder / name / "images")
        self.colmap = {text: colmap_files(text=text) for text in (False, True)}
        for text, name in ((False, "colmap"), (True, "text")):
            (folder / name / "sparse").mkdir()
            for file, data in self.colmap[text].items():
                (folder / name / "sparse" / file).write_bytes(data)
        rows, file = np.zeros((len(NAMES), 17)), io.BytesIO()
        rows[:, :15] = np.concatenate((np.eye(3, 4), [[36.0], [48.0], [40.0]]), axis=1).ravel()
        rows[:, 15:] = 1, 4
        np.save(file, rows)
        self.poses = file.getvalue()
        (folder / "llff" / "poses_bounds.npy").write_bytes(self.poses)
        self.results = []
        for name in ("lean-ten-seeds", "schedule", "stability", "real", "paper", "micro", "nerfstudio"):
            shutil.copytree(CONFIGS / name, folder / "results" / name)
            self.results += (folder / "results" / name).rglob("*.json")

    def config(self, rng: random.Random, use: Callable[[Path], object]) -> None:
        """Settings of a run."""
        run = rng.choice(self.runs)
        path = run / "config.json"
        with kept(path) as good:
            value = json.loads(good)
            del value["checksum"]
            change_value(value, rng)
            path.write_bytes(dump(value) if rng.random() < 0.8 else change_bytes(good, rng))
            self.sign(run)
            use(run)

    def sign(self, run: Path) -> None:
        """Make the checkpoint one of the settings, if these are any."""
        with contextlib.suppress(InputError):
            digest = config_digest(RunFolder(run).config(method_configs()))
            self.write_state(run, self.state(run) | {"config_digest": digest})

    def state(self, run: Path) -> dict[str, Any]:
        content = latest_checkpoint(run / "checkpoints").read_bytes()
        return torch.load(io.BytesIO(content.partition(b"\n")[2]), weights_only=True)

    def write_state(self, run: Path, state: dict[str, Any]) -> None:
        payload = io.BytesIO()
        torch.save(state, payload)
        replace_payload(run, payload.getvalue())

    def checkpoint(self, rng: random.Random, use: Callable[[Path], object]) -> None:
        """What a checkpoint holds, its checksum right."""
        run = rng.choice(self.runs)
        with kept(latest_checkpoint(run / "checkpoints")) as good:
            if rng.random() < 0.2:
                replace_payload(run, change_bytes(good.partition(b"\n")[2], rng))
            else:
                state = self.state(run)
                group = rng.choice([state, *[state[k] for k in state if isinstance(state[k], dict) and state[k]]])
                for _ in range(rng.randint(1, 2)):
                    change_value(group, rng)
                self.write_state(run, state)
            use(run)

    def metrics(self, rng: random.Random) -> None:
        """Lines of a run's metrics."""
        run = rng.choice(self.runs)
        with kept(run / "metrics.jsonl") as good:
            (run / "metrics.jsonl").write_bytes(change_bytes(good, rng))
            RunFolder(run).metrics()

    def capture(self, rng: random.Random) -> None:
        """Files of cameras, and images."""
        name = rng.choice(("transforms", "colmap", "text", "llff", "image"))
        folder = self.folder / name
        if name == "image":
            path = next((self.scene / "train").iterdir())
            with kept(path) as good:
                path.write_bytes(change_bytes(good, rng))
                read_split(self.scene, "train")
            return
        if name == "transforms":
            value = transforms()
            change_value(value, rng)
            (folder / "transforms.json").write_bytes(dump(value))
            path, changed = None, None
        elif name == "llff":
            path, changed = folder / "poses_bounds.npy", change_bytes(self.poses, rng)
            if rng.random() < 0.5:  # of the header
                changed = change_bytes(self.poses[:128], rng) + self.poses[128:]
        else:
            file = rng.choice(list(self.colmap[name == "text"]))
            path, changed = folder / "sparse" / file, change_bytes(self.colmap[name == "text"][file], rng)
        if path is None or changed is None:
            list_frames(folder, "train")
            return
        with kept(path):
            path.write_bytes(changed)
            list_frames(folder, "train")

    def result(self, rng: random.Random, use: Callable[[Path], object]) -> None:
        """A result.json."""
        path = rng.choice(self.results)
        with kept(path) as good:
            value = json.loads(good)
            group = rng.choice((value, value, *value.get("runs", ())[:5]))
            change_value(group, rng)
            path.write_bytes(dump(value))
            use(self.folder / "results" / path.relative_to(self.folder / "results").parts[0])


@contextlib.contextmanager
def kept(path: Path) -> Iterator[bytes]:
    """A file's content, written again at the end."""
    good = path.read_bytes()
    state = {other: other.read_bytes() for other in path.parent.glob("checkpoints/*.ckpt")}
    try:
        yield good
    finally:
        for other, content in {path: good, **state}.items():
            other.write_bytes(content)


def load(run: Path) -> None:
    load_model(RunFolder(run), RunFolder(run).config(method_configs()))


def step(run: Path, copies: Path) -> None:
    """Resume a copy of a run for a step."""
    copied = Path(shutil.copytree(run, copies / "run"))
    try:
        folder = RunFolder(copied)
        trainer = prepare_resume(folder, folder.config(method_configs()))
        trainer.train_iteration(trainer.next_step)
    finally:
        shutil.rmtree(copied)


@pytest.fixture(scope="module")
def folders(stranger_runs: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Folders:
    return Folders(tmp_path_factory.mktemp("fuzz"), stranger_runs)


def attack(case: Callable[[random.Random], None], seed: int) -> None:
    """A case is used, or refused in one line; other exceptions are raised."""
    message = ""
    try:
        with memory_bound(2**31):
            case(random.Random(seed))
    except (InputError, FloatingPointError) as problem:
        message = str(problem)
    except Exception as problem:
        raise AssertionError(f"seed {seed} of {case}") from problem
    assert "\n" not in message
    assert len(message) < 3000


CHEAP: dict[str, tuple[int, Callable[[Folders], Callable[[random.Random], None]]]] = {
    "config": (40, lambda folders: partial(folders.config, use=load)),
    "checkpoint": (50, lambda folders: partial(folders.checkpoint, use=load)),
    "metrics": (40, lambda folders: folders.metrics),
    "capture": (100, lambda folders: folders.capture),
}
"""How many of each, and what."""


@pytest.mark.parametrize("kind", CHEAP)
def test_any_change(kind: str, folders: Folders) -> None:
    count, case = CHEAP[kind]
    before = contents(folders.folder / "runs")
    for seed in range(count):
        attack(case(folders), seed)
    assert contents(folders.folder / "runs") == before


def test_any_change_is_resumed_or_refused(folders: Folders, tmp_path: Path) -> None:
    for seed in range(6):
        attack(partial(folders.checkpoint, use=partial(step, copies=tmp_path)), seed)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(10))
def test_ten_thousand_changes(part: int, folders: Folders, tmp_path: Path) -> None:
    resume = partial(step, copies=tmp_path)
    cases: list[tuple[int, Callable[[random.Random], None]]] = [
        (250, partial(folders.config, use=load)),
        (250, partial(folders.checkpoint, use=load)),
        (50, partial(folders.config, use=resume)),
        (150, partial(folders.checkpoint, use=resume)),
        (50, folders.metrics),
        (225, folders.capture),
        (25, partial(folders.result, use=write_report)),
    ]
    for count, case in cases:
        for seed in range(1000 + part * count, 1000 + (part + 1) * count):
            attack(case, seed)
