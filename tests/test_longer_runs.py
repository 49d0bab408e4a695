"""Where a training ends: finished runs are extended, those without gain end early, and data must not change unseen."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from tiny import SMALL

from edge_se_sampler.engine.checkpoint import latest_checkpoint
from edge_se_sampler.engine.early_stopping import EarlyStopping
from edge_se_sampler.engine.run_folder import EventWriter, RunFolder
from edge_se_sampler.engine.session import prepare_resume
from edge_se_sampler.methods import method_configs


def lines_with(run: Path, key: str) -> list[dict[str, Any]]:
    return [line for line in RunFolder(run).metrics() if key in line]


def test_a_finished_run_is_extended(run: Path, edge_se) -> None:
    """Its learning rate follows the new length, its early phase the old one."""
    answer = edge_se("resume", run, "--max-num-iterations", 30)
    assert answer.code == 0, answer.err
    assert "30 of 30 iterations" in answer.out
    assert latest_checkpoint(run / "checkpoints").name == "step-000000029.ckpt"
    lines = {line["step"]: line for line in lines_with(run, "learning_rate")}
    assert list(lines) == [0, 5, 10, 20, 29]
    initial = lines[0]["learning_rate"]
    assert lines[5]["learning_rate"] == pytest.approx(initial * 0.1 ** (5 / 6))
    for step in (10, 20, 29):
        assert lines[step]["learning_rate"] == pytest.approx(initial * 0.1 ** (step / 30))
        assert lines[step]["strategy"] == "se"
    assert "30 of 30" in edge_se("resume", run).out  # it remains as long
    config = RunFolder(run).config(method_configs())
    assert (config.max_num_iterations, config.new_num_iterations) == (6, 30)


def test_an_extended_run_goes_on_from_its_optimizers_state(run: Path) -> None:
    folder = RunFolder(run)
    trainer = prepare_resume(folder, folder.config(method_configs()), max_num_iterations=30)
    steps = {int(state["step"]) for state in trainer.optimizer.state.values()}
    assert steps == {6}
    assert trainer.optimizer.param_groups[0]["lr"] == pytest.approx(trainer.config.preset.learning_rate * 0.1**0.2)


def test_tensorboard_shows_no_step_of_a_killed_training_twice(run: Path, edge_se) -> None:
    event_accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    lost = EventWriter(run)
    for step in (10, 15, 20):
        lost.write({"step": step, "loss": 9.0})
    lost.close()
    assert edge_se("resume", run, "--max-num-iterations", 16).code == 0
    shown = event_accumulator.EventAccumulator(str(run)).Reload().Scalars("loss")
    assert [event.step for event in shown] == [line["step"] for line in lines_with(run, "loss")] == [0, 5, 10, 15]
    assert max(event.value for event in shown) < 9


def test_a_run_that_is_longer_than_its_config_says_has_ended(run: Path) -> None:
    folder = RunFolder(run)
    config = replace(folder.config(method_configs()), new_num_iterations=3)
    trainer = prepare_resume(folder, config, max_seconds=20)
    trainer.train()
    assert trainer.next_step == 6


def test_a_run_that_is_made_much_longer_does_not_begin_anew_with_edges(run: Path) -> None:
    folder = RunFolder(run)
    trainer = prepare_resume(folder, folder.config(method_configs()), max_num_iterations=600)
    sampler = trainer.pipeline.datamanager.train_pixel_sampler
    sampler.set_step(trainer.next_step)
    assert (trainer.next_step, sampler.strategy) == (6, "se")
    assert trainer.progress(6) == 0.01


@pytest.mark.parametrize("length", [6, 3, 0])
def test_a_run_is_not_made_shorter_than_it_is(run: Path, edge_se, length: int) -> None:
    config = (run / "config.json").read_bytes()
    answer = edge_se("resume", run, "--max-num-iterations", length)
    assert answer.code == 2
    assert "--max-num-iterations" in answer.err
    assert (run / "config.json").read_bytes() == config


@pytest.mark.parametrize(
    ("values", "due_at"),
    [([10, 11, 12, 13, 14], None), ([10, 10.4, 10.8, 11.2], None), ([10, 10.4, 10.1, 20], 2), ([10, 12, 9, 12.4], 3)],
)
def test_patience_ends_without_a_gain_over_the_best(values: list[float], due_at: int | None) -> None:
    stopping = EarlyStopping(2, 0.5)
    due = []
    for value in values:
        restored = EarlyStopping(2, 0.5)
        restored.load_state_dict(stopping.state_dict())
        stopping = restored
        stopping.update(value)
        due.append(stopping.is_due)
        if stopping.is_due:
            break
    assert (due.index(True) if any(due) else None) == due_at


def test_a_training_without_gain_is_ended_and_can_go_on(scene: Path, tmp_path: Path, edge_se) -> None:
    flags = ["--patience", 3, "--min-gain", 90, "--steps-per-eval-image", 1, "--output-dir", tmp_path / "o"]
    answer = edge_se("train", "edge-nerf", "--data", scene, *SMALL, *flags)
    assert answer.code == 0
    assert "4 of 6 iterations" in answer.out  # the first preview is a gain
    run = next(tmp_path.glob("o/*/*/*"))
    assert f"edge-se resume {run}" in answer.out
    assert latest_checkpoint(run / "checkpoints").name == "step-000000003.ckpt"
    assert len(lines_with(run, "val_psnr")) == 4
    assert "stopped: no gain" in answer.out
    answer = edge_se("resume", run)  # with new patience
    assert "6 of 6 iterations" in answer.out
    assert "stopped" not in answer.out


def test_what_ends_by_itself_was_not_stopped(scene: Path, tmp_path: Path, edge_se) -> None:
    flags = ["--patience", 1, "--min-gain", 90, "--steps-per-eval-image", 3, "--output-dir", tmp_path / "o"]
    answer = edge_se("train", "edge-nerf", "--data", scene, *SMALL, *flags)
    assert "6 of 6 iterations" in answer.out
    assert "stopped" not in answer.out


@pytest.mark.parametrize("flags", [("--patience", 0), ("--min-gain", -1), ("--min-gain", "nan")])
def test_a_patience_without_meaning_is_refused(flags: tuple[str, Any], scene: Path, tmp_path: Path, edge_se) -> None:
    answer = edge_se("train", "edge-nerf", "--data", scene, "--output-dir", tmp_path / "o", *flags)
    assert (answer.code, answer.err.count("\n")) == (2, 1)
    assert flags[0] in answer.err


def test_patience_needs_a_held_out_view(scene: Path, tmp_path: Path, edge_se) -> None:
    for split in ("val", "test"):
        (scene / f"transforms_{split}.json").unlink()
    answer = edge_se("train", "edge-nerf", "--data", scene, *SMALL, "--patience", 1, "--output-dir", tmp_path / "o")
    assert answer.code == 2
    assert "--patience" in answer.err


def turn_a_camera(scene: Path) -> None:
    document = json.loads((scene / "transforms_train.json").read_text())
    document["frames"][1]["transform_matrix"][0][3] += 0.01
    (scene / "transforms_train.json").write_text(json.dumps(document))


def change_a_pixel(scene: Path) -> None:
    path = next((scene / "train").glob("*.png"))
    image = iio.imread(path).copy()
    image[3, 4, 0] ^= 1
    iio.imwrite(path, image)


@pytest.mark.parametrize("change", [turn_a_camera, change_a_pixel])
def test_changed_data_is_refused_unless_insisted_on(change: Any, run: Path, scene: Path, edge_se) -> None:
    for path in (scene / "train").glob("*.png"):
        iio.imwrite(path, np.ascontiguousarray(iio.imread(path)), compress_level=1)  # other files, the same pixels
    extend = ("resume", run, "--max-num-iterations")
    assert edge_se(*extend, 7).code == 0
    change(scene)
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    answer = edge_se(*extend, 8)
    assert (answer.code, answer.err.count("\n")) == (2, 1)
    assert "--changed-data" in answer.err
    assert before == {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    assert edge_se(*extend, 8, "--changed-data", "True").code == 0
    assert edge_se(*extend, 9).code == 0  # these are its images now
