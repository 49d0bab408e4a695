"""Writes the small runs that later versions must still read: python tests/format_runs.py N -> tests/runs/format-N.

Each was interrupted half-way; whole.jsonl has the metrics of the same training without the interruption. Their data is
the folder `scene` that `write_scene` renders, in the current directory.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.config import override
from edge_se_sampler.engine.session import prepare
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.methods import method_configs
from edge_se_sampler.protocol import TrainingCallback, TrainingCallbackLocation

RUNS = Path(__file__).parent / "runs"
SETTINGS: dict[str, dict[str, Any]] = {
    "edge-se-nerf": {
        "pipeline.model.width": 8,
        "pipeline.model.depth": 3,
        "pipeline.model.num_coarse_samples": 8,
        "pipeline.model.num_importance_samples": 8,
        "pipeline.datamanager.pixel_sampler.early_fraction": 0.3,
    },
    "lean-nerf": {"pipeline.model.voxel_size_px": 4.0},
}
STEPS = 20


def write_scene(folder: Path) -> Path:
    """Render FOLDER/scene: 3 training views, 1 val, 1 test, 16 x 16."""
    return make_scenes(folder, ["mic"], size=16, num_train=3, num_val=1, num_test=1)[0].rename(folder / "scene")


def train(method: str, folder: Path, interrupted_after: int | None = None) -> Trainer:
    """Train a method on FOLDER/scene, for a number of steps only."""
    common = {
        "data": folder / "scene",
        "output_dir": folder / "outputs",
        "max_num_iterations": STEPS,
        "steps_per_log": 1,
        "steps_per_eval_image": 5,
        "machine.device_type": "cpu",
        "pipeline.datamanager.train_num_rays_per_batch": 32,
    }
    trainer = prepare(override(method_configs()[method], common | SETTINGS[method]))

    def interrupt(step: int) -> None:
        if step + 1 == interrupted_after:
            os.kill(os.getpid(), signal.SIGINT)

    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], interrupt))
    trainer.train()
    return trainer


def main(number: str) -> None:
    for method in SETTINGS:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            write_scene(folder)
            whole, trainer = train(method, folder), train(method, folder, STEPS // 2)
            trainer.run.write_config(replace(trainer.config, data=Path("scene"), output_dir=Path("outputs")))
            target = RUNS / f"format-{number}" / method
            shutil.copytree(trainer.run.path, target, ignore=shutil.ignore_patterns("previews", "events.*"))
            shutil.copy(whole.run.path / "metrics.jsonl", target / "whole.jsonl")


if __name__ == "__main__":
    main(sys.argv[1])
