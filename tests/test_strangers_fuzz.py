"""Runs, captures and results that are changed at random: they are used, or refused in one line."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from spoiled_folders import Folders, attack
from strangers import contents

from edge_se_sampler.bench.report import write_report
from edge_se_sampler.data.blender import has_split
from edge_se_sampler.data.dataset import list_frames, read_split
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.session import load_model, prepare_resume
from edge_se_sampler.methods import method_configs


def load(run: Path) -> None:
    load_model(RunFolder(run), RunFolder(run).config(method_configs()))


def read(scene: Path) -> None:
    """As training does; the images of NeRF's format alone, which are few."""
    read_split(scene, "train") if has_split(scene, "train") else list_frames(scene, "train")


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


CHEAP: dict[str, tuple[int, Callable[[Folders], Callable[[random.Random], None]]]] = {
    "config": (40, lambda folders: partial(folders.config, use=load)),
    "checkpoint": (50, lambda folders: partial(folders.checkpoint, use=load)),
    "metrics": (40, lambda folders: folders.metrics),
    "capture": (100, lambda folders: partial(folders.capture, use=read)),
}
"""How many of each, and what."""


@pytest.mark.slow
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
        (225, partial(folders.capture, use=read)),
        (25, partial(folders.result, use=write_report)),
    ]
    for count, case in cases:
        for seed in range(1000 + part * count, 1000 + (part + 1) * count):
            attack(case, seed)
