"""Several processes that train one model: the same training as one process's, and how they end."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from edge_se_sampler.engine.config import MANAGER, MODEL, SAMPLER, override

NETWORK = {"width": 8, "depth": 3, "position_frequencies": 2, "num_coarse_samples": 8, "num_importance_samples": 8}
DENSE = {
    f"{MANAGER}.train_num_rays_per_batch": 683,  # one more than a chunk has: one of two processes has no ray of it
    **{f"{MODEL}.{name}": value for name, value in (NETWORK | {"density_noise": 0.1}).items()},
    f"{MODEL}.background_color": "random",
    f"{SAMPLER}.early_fraction": 0.3,
}
LEAN = {f"{MANAGER}.train_num_rays_per_batch": 250, f"{SAMPLER}.early_fraction": 0.3}
TRAININGS = {
    "dense": ("edge-se-nerf", DENSE),
    "dense, cached errors": ("edge-se-nerf", DENSE | {f"{SAMPLER}.error_source": "cached"}),
    "dense, adaptive schedule": ("edge-se-nerf", DENSE | {f"{SAMPLER}.schedule": "adaptive", "reinit_dead": True}),
    "unseen rays": ("edge-se-info-nerf", DENSE | {f"{MODEL}.num_unseen_rays": 7}),
    "lean": ("lean-nerf", LEAN),
    "lean, rendered errors": ("lean-nerf", LEAN | {f"{SAMPLER}.error_source": "fine"}),
    "lean, without alpha": ("lean-nerf", LEAN | {f"{MODEL}.cull_by_alpha": False}),
}


def session(training: str, data: str, output_dir: str, steps: str) -> None:
    """A process of a training: rank 0 prints the loss of each step."""
    from edge_se_sampler.engine.session import prepare
    from edge_se_sampler.methods import method_configs
    from edge_se_sampler.ranks import is_main

    method, changes = TRAININGS[training]
    paths = {"data": Path(data), "output_dir": Path(output_dir), "machine.device_type": "cpu"}
    trainer = prepare(override(method_configs()[method], changes | paths | {"max_num_iterations": int(steps)}))
    losses = [trainer.train_iteration(step) for step in range(int(steps))]
    trainer.next_step = int(steps)
    trainer.save()
    if is_main():
        print(json.dumps({"losses": losses, "run": str(trainer.run.path), "strategy": trainer.pipeline.datamanager.train_pixel_sampler.strategy, "level": int(getattr(trainer.pipeline.model.grid, "level", 0))}))


def start(world: int, *arguments: object) -> list[subprocess.Popen[str]]:
    """Processes in the environment that torchrun would give them."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": str(world), "OMP_NUM_THREADS": "1"}
    return [
        subprocess.Popen(
            [sys.executable, *map(str, arguments)],
            env=os.environ | shared | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(world)
    ]


def train(world: int, *arguments: object) -> dict[str, Any]:
    processes = start(world, __file__, *arguments)
    (out, err), *others = [process.communicate(timeout=240) for process in processes]
    assert [process.returncode for process in processes] == [0] * world, (err, others)
    assert all(out == "" for out, _ in others)
    return json.loads(out)


@pytest.mark.parametrize("training", TRAININGS)
def test_two_processes_have_the_loss_curve_of_one(training: str, scene: Path, tmp_path: Path) -> None:
    one, two = (train(world, training, scene, tmp_path / str(world), 50) for world in (1, 2))
    print(training, one["strategy"], one["level"], max(abs(a / b - 1) for a, b in zip(one["losses"], two["losses"])))
    assert two["losses"] == pytest.approx(one["losses"], rel=1e-5)


if __name__ == "__main__":
    session(*sys.argv[1:])
