"""Files beside nerfstudio's checkpoints: what is written, for which steps, and what a resumed run takes of them. Its
trainer is a stand-in."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from edge_se_sampler.errors import InputError
from edge_se_sampler.nerfstudio.resume import (
    OLD_SAMPLER_FILE,
    SAMPLER_FILE,
    SCHEDULE_FILE,
    restore_sampler,
    restore_schedule,
    sampler_writer,
    schedule_writer,
)
from edge_se_sampler.sampling.schedule import AdaptiveSchedule
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig
from edge_se_sampler.sampling.strategies import Edge

SIZES = {0: (8, 6), 1: (8, 6)}


def trainer_in(folder: Path, *, resumes: int | None = None, **changes: Any) -> Any:
    """nerfstudio's trainer of a run in a folder, or of one that goes on from a step of that run."""
    options = {"max_num_iterations": 30, "steps_per_save": 5, "save_only_latest_checkpoint": True}
    loads = {"load_dir": None if resumes is None else folder / "nerfstudio_models", "load_checkpoint": None}
    return SimpleNamespace(
        config=SimpleNamespace(**(options | loads | changes)),
        checkpoint_dir=(folder if resumes is None else folder / "again") / "nerfstudio_models",
        local_rank=0,
        _start_step=0 if resumes is None else resumes + 1,
    )


def learning_sampler() -> Any:
    """A sampler of ActRay's that has met two images."""
    sampler: Any = EdgeSEPixelSamplerConfig(early="actray", late="actray").setup(num_rays_per_batch=9)
    sampler.bind(squared_error=lambda _: torch.zeros(9), progress=lambda step: step / 30, seed=0)
    images = torch.from_numpy(np.random.default_rng(0).random((2, 8, 6, 3), dtype=np.float32))
    for step in range(3):
        sampler.set_step(step)
        sampler.sample({"image": images, "image_idx": torch.tensor([0, 1])})
        sampler.observe(torch.full((9,), 0.1 * step))
    return sampler


def clock(sampler: Any) -> int:
    return sampler.state_dict()["actray.distribution"]["clock"]


@pytest.mark.parametrize("keeps_all", [False, True])
def test_of_the_last_two_checkpoints_it_is_known_what_was_learnt(keeps_all: bool, tmp_path: Path) -> None:
    """nerfstudio saves after us, and may be killed in between: then the one before is the last. Where it keeps all of
    its checkpoints, each can be resumed."""
    sampler, trainer = learning_sampler(), trainer_in(tmp_path, save_only_latest_checkpoint=not keeps_all)
    write = sampler_writer(trainer, sampler, rank=0)
    for step in range(30):
        write(step)
    steps = [5, 10, 15, 20, 25, 29] if keeps_all else [25, 29]
    names = {SAMPLER_FILE.format(rank=0, step=step) for step in steps}
    assert {path.name for path in tmp_path.iterdir()} == names
    for step in steps:
        fresh = learning_sampler()
        fresh.parts()["actray.distribution"].clock = 0
        restore_sampler(trainer_in(tmp_path, resumes=step), fresh, 0, SIZES)
        assert clock(fresh) == clock(sampler) == 3


def test_a_file_of_an_earlier_version_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sampler, fresh = learning_sampler(), learning_sampler()
    torch.save({"step": 7, "state": sampler.state_dict()}, tmp_path / OLD_SAMPLER_FILE.format(rank=0))
    fresh.parts()["actray.distribution"].clock = 0
    restore_sampler(trainer_in(tmp_path, resumes=6), fresh, 0, SIZES)
    assert clock(fresh) == 0
    assert "has no state of step 6: the strategies learn anew" in capsys.readouterr().err
    restore_sampler(trainer_in(tmp_path, resumes=7), fresh, 0, SIZES)
    assert clock(fresh) == 3


def test_a_full_disk_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: int) -> None:
        raise OSError(28, "No space left on device")

    write = sampler_writer(trainer_in(tmp_path), learning_sampler(), rank=0)
    monkeypatch.setattr("edge_se_sampler.engine.files.os.fsync", fail)
    with pytest.raises(InputError, match=r"edge-se-sampler-0-5\.pt: cannot be written.*No space left"):
        write(5)
    assert not list(tmp_path.iterdir())


def test_without_checkpoints_only_the_last_step_is_kept(tmp_path: Path) -> None:
    """0 is nerfstudio's for never; and it saves none at step 0."""
    for trainer, expected in (
        (trainer_in(tmp_path / "a", steps_per_save=0), ["29"]),
        (trainer_in(tmp_path / "b"), ["5", "10", "15", "20", "25", "29"]),
    ):
        (trainer.checkpoint_dir.parent).mkdir()
        write = schedule_writer(trainer, AdaptiveSchedule(Edge(EdgeSEPixelSamplerConfig())))
        for step in range(30):
            write(step)
        assert list(json.loads((trainer.checkpoint_dir.parent / SCHEDULE_FILE).read_text())) == expected


@pytest.mark.parametrize(
    "state", [{"current": "middle"}, {"_edges": None}, 3, {"current": "late", "observations": float("nan")}]
)
def test_what_is_no_schedules_state_is_refused(state: Any, tmp_path: Path) -> None:
    schedule = AdaptiveSchedule(Edge(EdgeSEPixelSamplerConfig()))
    whole = schedule.state_dict() | state if isinstance(state, dict) else state
    (tmp_path / SCHEDULE_FILE).write_text(json.dumps({"5": whole}))
    with pytest.raises(InputError, match=f"{SCHEDULE_FILE}: cannot be read .*; delete it to begin with the early"):
        restore_schedule(trainer_in(tmp_path, resumes=5), schedule)
    assert schedule.current == "early"


def test_a_schedule_that_is_not_known_begins_anew_and_that_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    schedule = AdaptiveSchedule(Edge(EdgeSEPixelSamplerConfig()))
    restore_schedule(trainer_in(tmp_path, resumes=5), schedule)
    assert f"{SCHEDULE_FILE} has no state of step 5: the early phase begins anew" in capsys.readouterr().err
    (tmp_path / SCHEDULE_FILE).write_text(json.dumps({"5": schedule.state_dict() | {"current": "late"}}))
    restore_schedule(trainer_in(tmp_path, resumes=5), schedule)
    assert schedule.current == "late"
    assert not capsys.readouterr().err
