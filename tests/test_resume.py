"""An interrupted and resumed run equals the uninterrupted one bit for bit."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny import resume_trainer, tiny_config, tiny_trainer, tiny_views

from edge_se_sampler.engine.checkpoint import latest_checkpoint
from edge_se_sampler.engine.config import override
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.methods import method_configs
from edge_se_sampler.protocol import TrainingCallback, TrainingCallbackLocation
from edge_se_sampler.run_commands import train
from edge_se_sampler.sampling import schedule

ONE_STEP = {"max_num_iterations": 1, "pipeline.model": tiny_config()}
SESSION = """
import hashlib, json, os, signal, sys
from dataclasses import replace
from pathlib import Path
from edge_se_sampler.engine.config import MachineConfig
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.session import prepare, prepare_resume
from edge_se_sampler.methods import method_configs
from edge_se_sampler.protocol import TrainingCallback, TrainingCallbackLocation

command, folder, data, interrupt_at, method = sys.argv[1:]
folder, data, interrupt_at = Path(folder), Path(data), int(interrupt_at)
if command == "resume":
    run = RunFolder(folder)
    trainer = prepare_resume(run, run.config(method_configs()))
else:
    config = method_configs()[method.split()[0]]
    changes = {"early_fraction": 0.7}
    samples = {"num_coarse_samples": 8, "num_importance_samples": 8, "density_noise": 0.1}
    if method == "lean-nerf without alpha":  # where the early phase is watched
        changes, samples = {}, {"cull_by_alpha": False}
    sampler = replace(config.pipeline.datamanager.pixel_sampler, **changes)
    manager = replace(config.pipeline.datamanager, train_num_rays_per_batch=24, pixel_sampler=sampler)
    model = replace(config.pipeline.model, **samples)
    trainer = prepare(replace(
        config, data=data, output_dir=folder, max_num_iterations=20, steps_per_log=3, steps_per_eval_image=5,
        machine=MachineConfig(seed=3, device_type="cpu"),
        pipeline=replace(config.pipeline, datamanager=manager, model=model),
    ))

def interrupt(step):
    if step == interrupt_at:
        os.kill(os.getpid(), signal.SIGINT)

trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], interrupt))
pixels = []
draw = trainer.pipeline.datamanager.next_train
def recorded(step):
    rays, batch = draw(step)
    pixels.append([step, hashlib.sha256(batch["indices"].numpy().tobytes()).hexdigest()])
    return rays, batch
trainer.pipeline.datamanager.next_train = recorded
trainer.train()
print(json.dumps({"run": str(trainer.run.path), "pixels": pixels}))
"""


def session(command: str, folder: Path, scene: Path, interrupt_at: int = -1, method: str = "edge-se-nerf") -> dict:
    arguments = [command, str(folder), str(scene), str(interrupt_at), method]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}  # more threads for so little wait for each other
    settings: Any = {"check": True, "capture_output": True, "text": True, "env": environment}
    return json.loads(subprocess.run([sys.executable, "-c", SESSION, *arguments], **settings).stdout)


def metrics(run: Path) -> list[dict]:
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in line.items() if key not in ("seconds", "crc32")} for line in lines]


def state(run: Path) -> dict[str, bytes | float | str]:
    """Everything in the last checkpoint, flat, tensors as bytes; the time aside."""
    content = latest_checkpoint(run / "checkpoints").read_bytes().partition(b"\n")[2]
    flat: dict[str, bytes | float | str] = {}

    def flatten(name: str, value: Any) -> None:
        if isinstance(value, dict | list | tuple):
            for key, item in value.items() if isinstance(value, dict) else enumerate(value):
                flatten(f"{name}.{key}", item)
        else:
            flat[name] = value.numpy().tobytes() if isinstance(value, torch.Tensor) else value

    flatten("", torch.load(io.BytesIO(content), weights_only=True))
    del flat[".elapsed"], flat[".setup_seconds"]
    return flat


@pytest.mark.parametrize(
    ("method", "interrupt_at"),
    [
        ("edge-se-nerf", 8),  # in the edge phase
        pytest.param("edge-se-nerf", 16, marks=pytest.mark.slow),  # in the SE phase
        pytest.param("lean-nerf without alpha", 12, marks=pytest.mark.slow),  # with alpha: test_lean_cells
    ],
)
def test_resumed_equals_uninterrupted(tmp_path: Path, scene: Path, method: str, interrupt_at: int):
    with ThreadPoolExecutor() as pool:
        uninterrupted = pool.submit(session, "train", tmp_path / "whole", scene, method=method)
        first = session("train", tmp_path / "parts", scene, interrupt_at, method)
        whole = uninterrupted.result()
    run = Path(first["run"])
    assert [step for step, _ in first["pixels"]] == list(range(interrupt_at + 1))
    assert latest_checkpoint(run / "checkpoints").name == f"step-{interrupt_at:09d}.ckpt"
    # what a killed process may leave: metrics of later steps, an unfinished line
    RunFolder(run).log({"step": 19, "loss": 1.0})
    with open(run / "metrics.jsonl", "a") as file:
        file.write('{"step": 1')
    second = session("resume", run, scene)
    assert first["pixels"] + second["pixels"] == whole["pixels"]
    assert metrics(run) == metrics(Path(whole["run"]))
    assert state(run) == state(Path(whole["run"]))
    assert any(isinstance(value, bytes) for value in state(run).values())


@pytest.mark.parametrize(("saved_after", "phase"), [(10, "edge"), (30, "se"), (40, "edge")])
def test_a_checkpoint_keeps_the_adaptive_schedules_state(
    saved_after: int, phase: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Saved in the early phase, in the late one, and in the early one that follows: all three are forced."""
    monkeypatch.setattr(schedule, "GAIN_TO_END", float("inf"))
    monkeypatch.setattr(schedule, "REMAINING_TO_END", 1e6)
    monkeypatch.setattr(schedule, "REMAINING_TO_RETURN", 0.0)
    views = tiny_views(3, 12, 12)
    changes = {
        "pipeline.datamanager.train_num_rays_per_batch": 16,
        "pipeline.datamanager.pixel_sampler.schedule": "adaptive",
        "pipeline.model": tiny_config(),
        "max_num_iterations": 400,
    }
    trainer = tiny_trainer(override(method_configs()["edge-se-nerf"], changes), views, tmp_path)

    def train(trainer: Any, steps: range) -> list[tuple[float, str]]:
        sampler = trainer.pipeline.datamanager.train_pixel_sampler
        return [(trainer.train_iteration(step), sampler.strategy) for step in steps]

    assert train(trainer, range(saved_after))[-1][1] == phase
    trainer.next_step = saved_after
    trainer.save()
    later = range(saved_after, saved_after + 30)
    went_on = train(trainer, later)
    assert {strategy for _, strategy in went_on} == {"edge", "se"}
    assert train(resume_trainer(trainer, views), later) == went_on


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="its processes get no signals")
@pytest.mark.parametrize("name", ["SIGINT", "SIGHUP"])
def test_ctrl_c_and_a_closed_terminal_save_a_checkpoint_and_print_one_line(name: str, tmp_path: Path, scene: Path):
    number = getattr(signal, name)
    command = [
        sys.executable, "-m", "edge_se_sampler", "train", "vanilla-nerf", "--data", str(scene),
        "--output-dir", str(tmp_path / "o"), "--pipeline.datamanager.train-num-rays-per-batch", "16",
    ]  # fmt: skip
    pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(command, preexec_fn=lambda: signal.signal(number, signal.SIG_DFL), **pipes)
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob("o/*/*/*/metrics.jsonl")) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err.count("\n") == 1
    assert "saved" in err
    assert "edge-se resume" in err
    run = next(tmp_path.glob("o/*/*/*"))
    assert latest_checkpoint(run / "checkpoints")


def test_a_stop_in_the_last_iteration_is_its_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trainer = tiny_trainer(override(method_configs()["edge-nerf"], ONE_STEP), tiny_views(), tmp_path)

    def stop(step: int) -> None:
        trainer.stop_requested = True

    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], stop))
    train(trainer)
    assert "1 of 1 iterations" in capsys.readouterr().out
