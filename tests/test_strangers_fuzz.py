"""Runs, captures and results that are changed at random: they are used, or refused in one line."""

from __future__ import annotations

import contextlib
import copy
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
from strangers import contents, memory_bound, replace_payload
from torch import Tensor

from edge_se_sampler.bench.report import write_report
from edge_se_sampler.data.dataset import list_frames, read_split
from edge_se_sampler.engine.checkpoint import latest_checkpoint
from edge_se_sampler.engine.run_folder import RunFolder, config_digest
from edge_se_sampler.engine.session import load_model, prepare_resume
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs

CONFIGS = Path(__file__).parent.parent / "configs"
NUMBERS = (0, 1, -1, 2, 17, 2**31, 2**62, 10**30, 0.5, -0.25, 1e-300, 1e300, float("nan"), float("inf"))
VALUES = (*NUMBERS, None, True, "", "x", "../x", "/", "a\0b", "\n", "\ud800", [], {}, [[1]], "x" * 5000, [0.0] * 4)


def places(value: Any, path: tuple = ()) -> Iterator[tuple]:
    """Where a nested value has others."""
    children = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, (list, tuple)) else ()
    )
    for key, child in children:
        yield (*path, key)
        yield from places(child, (*path, key))


def change_value(value: Any, rng: random.Random) -> None:
    """Replace, remove or repeat something in a nested value."""
    paths = list(places(value))
    if not paths:
        return
    path = rng.choice(paths)
    for key in path[:-1]:
        value = value[key]
    key, old = path[-1], value[path[-1]]
    if isinstance(value, tuple):
        return
    if isinstance(old, Tensor):
        value[key] = changed_tensor(old, rng)
    elif rng.random() < 0.1:
        del value[key]
    elif rng.random() < 0.1 and isinstance(value, list):
        value.append(old)
    elif isinstance(old, (int, float)) and rng.random() < 0.3:
        value[key] = rng.choice((-old, 2 * old, old + 1, old / 3, old * 1e10))
    else:
        value[key] = copy.deepcopy(rng.choice(VALUES))


def changed_tensor(tensor: Tensor, rng: random.Random) -> Any:
    """Another shape, type or number."""
    if tensor.numel() > 2**24:  # it repeats its numbers already
        return tensor
    ways: list[Callable[[], Any]] = [
        lambda: tensor.double(),
        lambda: tensor.to(torch.int16),
        lambda: tensor[None],
        lambda: tensor.flatten()[: rng.randrange(tensor.numel() + 1)].clone(),
        lambda: torch.cat((tensor, tensor)) if tensor.ndim else tensor,
        lambda: tensor.flatten()[:1].expand(2**40),
        lambda: tensor.to_sparse() if tensor.ndim and tensor.dtype != torch.bool else None,
    ]
    if tensor.numel() and rng.random() < 0.7:
        changed, number = tensor.clone(), rng.choice(NUMBERS)
        integer = not changed.dtype.is_floating_point
        number = int(min(max(number, -(2**62)), 2**62)) if integer and number == number else 3 if integer else number
        limits = {torch.uint8: 255, torch.int32: 2**31 - 1}
        number = number if integer else float(min(number, 3e38))
        changed.view(-1)[rng.randrange(tensor.numel())] = min(number, limits.get(changed.dtype, number))
        return changed
    return rng.choice(ways)()


def change_bytes(data: bytes, rng: random.Random) -> bytes:
    """Flip, cut, insert or repeat some bytes."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 3)):
        start, length = rng.randrange(len(changed) + 1), rng.choice((0, 1, 1, 2, 8, 100))
        changed[start : start + length] = rng.choice((b"", b"\0", b"\xff" * 8, rng.randbytes(rng.randint(1, 9))))
    return bytes(changed[: rng.randrange(len(changed) + 1)] if rng.random() < 0.1 else changed)


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
