"""Several processes that train one model: the same training as one process's, and how they end."""

from __future__ import annotations

import atexit
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from torch.distributed import TCPStore  # pyright: ignore[reportPrivateImportUsage]

from edge_se_sampler.engine.checkpoint import latest_checkpoint
from edge_se_sampler.engine.config import MANAGER, MODEL, SAMPLER, override
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.session import prepare, prepare_resume
from edge_se_sampler.methods import method_configs
from edge_se_sampler.ranks import is_main

STEPS = 50
STORES: list[TCPStore] = []
"""They end with the last reference."""

NETWORK = {"width": 8, "depth": 3, "position_frequencies": 2, "num_coarse_samples": 8, "num_importance_samples": 8}
DENSE = {
    f"{MANAGER}.train_num_rays_per_batch": 65,
    **{f"{MODEL}.{name}": value for name, value in (NETWORK | {"density_noise": 0.1}).items()},
    f"{MODEL}.background_color": "random",
    f"{SAMPLER}.early_fraction": 0.3,
}
LEAN = {f"{MANAGER}.train_num_rays_per_batch": 250, f"{SAMPLER}.late": "se", f"{SAMPLER}.early_fraction": 0.3}
HARD = DENSE | {f"{MODEL}.hard_samples": True}
CACHED = {f"{SAMPLER}.error_source": "cached"}
LEARNING = ("error-map", "error-cdf", "soft-mining", "actray", "regions", "quadtree")
TRAININGS = {
    **{f"dense, {name}": ("vanilla-nerf", DENSE | {f"{SAMPLER}.late": name}) for name in LEARNING},
    "dense": ("edge-se-nerf", DENSE),
    # one more than a chunk has: one of two processes has no ray of the second
    "dense, in chunks": ("edge-se-nerf", DENSE | {f"{MANAGER}.train_num_rays_per_batch": 683}),
    "dense, cached errors": ("edge-se-nerf", DENSE | CACHED),
    "dense, adaptive schedule": ("edge-se-nerf", DENSE | {f"{SAMPLER}.schedule": "adaptive", "reinit_dead": True}),
    "dense, hard samples": ("vanilla-nerf", HARD | {f"{MANAGER}.train_num_rays_per_batch": 683}),
    "dense, hard samples in cells": ("edge-se-info-nerf", HARD | {f"{MODEL}.empty_space_skipping": True}),
    "unseen rays": ("edge-se-info-nerf", DENSE | {f"{MODEL}.num_unseen_rays": 7}),
    "lean": ("lean-nerf", {f"{MANAGER}.train_num_rays_per_batch": 250}),
    "lean, rendered errors": ("lean-nerf", LEAN),
    "lean, cached errors": ("lean-nerf", LEAN | CACHED),
    "lean, without alpha": (
        "lean-nerf",
        LEAN | CACHED | {f"{SAMPLER}.early": "auto", f"{MODEL}.cull_by_alpha": False},
    ),
}

SUMS = """
import torch
from edge_se_sampler import ranks

ranks.join("cpu")
for step in range(100):
    ranks.add_up(torch.ones(50_000))
    ranks.agree(1.0)
"""


def curves_of(training: str, data: Path, output_dir: Path) -> tuple[list[float], list[float]]:
    """The loss of each step, and what a grid has seen by then, on whatever processes there are; a last checkpoint is
    saved."""
    method, changes = TRAININGS[training]
    paths = {"data": data, "output_dir": output_dir, "machine.device_type": "cpu", "max_num_iterations": STEPS}
    trainer = prepare(override(method_configs()[method], changes | paths))
    losses, seen = [], []
    for step in range(STEPS):
        losses.append(trainer.train_iteration(step))
        if (grid := trainer.pipeline.model.grid) is not None:
            seen += [float(grid.num_seen), float(grid.max_weight.sum())]
    trainer.next_step = STEPS
    trainer.save()
    return losses, seen


def start(world: int, *arguments: object) -> list[subprocess.Popen[str]]:
    """Processes in the environment that torchrun would give them: it keeps the store at which they meet."""
    store = TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    STORES.append(store)
    shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(store.port), "WORLD_SIZE": str(world)}
    shared |= {"TORCHELASTIC_USE_AGENT_STORE": "True", "TORCHELASTIC_RESTART_COUNT": "0", "OMP_NUM_THREADS": "1"}
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    command = [sys.executable, *map(str, arguments)]
    return [
        subprocess.Popen(command, env=os.environ | shared | {"RANK": str(rank), "LOCAL_RANK": str(rank)}, **pipes)
        for rank in range(world)
    ]


def finish(processes: list[subprocess.Popen[str]], timeout: float = 240) -> str:
    """What rank 0 prints; the others print nothing."""
    try:
        (out, err), *others = [process.communicate(timeout=timeout) for process in processes]
    finally:
        for process in processes:
            process.kill()
    assert [process.returncode for process in processes] == [0] * len(processes), (err, others)
    assert [text for text, _ in others] == [""] * len(others)
    return out


def check_same_losses(trainings: list[str], scene: Path, output_dir: Path) -> None:
    two = json.loads(finish(start(2, __file__, scene, output_dir / "two", *trainings)))
    for training in trainings:
        losses, seen = curves_of(training, scene, output_dir / "one")
        assert two[training][0] == pytest.approx(losses, rel=2e-2), training
        # rounding puts a sample on either side of a threshold now and then, which the losses show from then on
        different = [step for step in range(STEPS) if two[training][0][step] != pytest.approx(losses[step], rel=1e-4)]
        assert len(different) <= STEPS // 10, (training, different)
        assert two[training][1] == pytest.approx(seen, rel=1e-3), training
    assert len(list(output_dir.glob("two/*/*/*/checkpoints/*.ckpt"))) == len(trainings)


@pytest.mark.slow
def test_two_processes_have_the_loss_curve_of_one(scene: Path, tmp_path: Path) -> None:
    check_same_losses(["lean, without alpha"], scene, tmp_path)


@pytest.mark.slow
def test_processes_end_whose_threads_still_free_tensors(tmp_path: Path) -> None:
    (script := tmp_path / "sums.py").write_text(SUMS)
    for _ in range(3):  # one alone may end in time
        finish(start(2, script), timeout=60)


def test_one_process_alone_writes_to_a_run_that_is_resumed(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    monkeypatch.setattr("edge_se_sampler.ranks._rank", 1)
    folder = RunFolder(run)
    trainer = prepare_resume(folder, folder.config(method_configs()), max_num_iterations=7)
    trainer.train()
    assert trainer.next_step == 7
    assert before == {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_two_processes_have_it_whatever_samplers_learn_from(scene: Path, tmp_path: Path) -> None:
    check_same_losses(list(TRAININGS), scene, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("killed", [0, 1])
def test_a_killed_process_ends_the_other_and_the_run_goes_on_with_three(
    killed: int, scene: Path, tmp_path: Path
) -> None:
    flags = ["--data", scene, "--output-dir", tmp_path / "runs", "--machine.device-type", "cpu", "--steps-per-save", 5]
    flags += ["--pipeline.datamanager.train-num-rays-per-batch", 64]
    processes = start(2, "-m", "edge_se_sampler", "train", "lean-nerf", *flags)
    deadline = time.monotonic() + 120
    while not (saved := list(tmp_path.glob("runs/*/*/*/checkpoints/*.ckpt"))) and time.monotonic() < deadline:
        time.sleep(0.1)
    processes[killed].kill()
    _, err = processes[1 - killed].communicate(timeout=30)
    assert processes[1 - killed].returncode == 1
    assert err.count("\n") == 1, err
    assert "another process of this training has ended" in err
    run = RunFolder(saved[0].parent.parent)
    before = latest_checkpoint(run.checkpoints).name
    out = finish(start(3, "-m", "edge_se_sampler", "resume", run.path, "--max-seconds", 3))
    assert f"edge-se resume {run.path}" in out
    assert latest_checkpoint(run.checkpoints).name > before


@pytest.mark.slow
def test_a_signal_to_any_process_and_the_clock_of_the_slowest_hold_for_all(scene: Path, tmp_path: Path) -> None:
    flags = ["--data", scene, "--output-dir", tmp_path / "runs", "--machine.device-type", "cpu", "--time-budget", "1h"]
    processes = start(2, "-m", "edge_se_sampler", "train", "lean-nerf", *flags)
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("runs/*/*/*/metrics.jsonl")) and time.monotonic() < deadline:
        time.sleep(0.1)
    processes[1].send_signal(signal.SIGTERM)
    (out, _), _ = (process.communicate(timeout=240) for process in processes)
    assert [process.returncode for process in processes] == [0, 130]
    assert "edge-se resume" in out
    (run,) = tmp_path.glob("runs/*/*/*")
    assert len(list(run.glob("checkpoints/*.ckpt"))) == 1


def print_threads_of_gloo() -> None:
    """Those that are left, which may abort a process that ends before they do: only rank 0 is to print."""
    threads = (Path(thread, "comm").read_text().strip() for thread in Path("/proc/self/task").glob("*"))
    if left := [thread for thread in threads if "gloo" in thread]:
        print(left)


if __name__ == "__main__":
    atexit.register(print_threads_of_gloo)  # before the processes join, and so called after they have left their group
    data, folder, *names = sys.argv[1:]
    found = {name: curves_of(name, Path(data), Path(folder)) for name in names}
    if is_main():
        print(json.dumps(found))
