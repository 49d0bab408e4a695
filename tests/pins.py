"""What must not change by accident: weights after 300 steps, drawn pixels, random streams. `python tests/pins.py` pins
them anew in pins.json; do that only where a change is meant, and say so in the changelog."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from batches import LATE, MIXED, SAME, batch_of, following, half_masks

from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.checkpoint import latest_checkpoint
from edge_se_sampler.engine.config import MachineConfig
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.session import load_model, prepare
from edge_se_sampler.methods import method_configs
from edge_se_sampler.sampling.random_streams import Stream, stream

PINS = Path(__file__).with_name("pins.json")
STEPS = 300
METHODS = (
    "vanilla-nerf", "precrop-nerf", "se-nerf", "precrop-se-nerf", "edge-nerf", "edge-se-nerf",
    "info-nerf", "edge-se-info-nerf",
)  # fmt: skip
"""Those that stay faithful to the papers; how lean-nerf's compiled kernels round depends on the processor."""


def digest(parts: Iterable[Any]) -> str:
    """Of arrays, tensors, and what prints the same."""
    told = hashlib.sha256()
    for part in parts:
        array = part.detach().cpu().contiguous().numpy() if isinstance(part, torch.Tensor) else np.asarray(part)
        told.update(f"{array.dtype.str}{array.shape}".encode() + array.tobytes())
    return told.hexdigest()[:16]


def train(method: str, scene: Path, output_dir: Path) -> dict[str, Any]:
    """Train 300 small steps on one thread: the weights' digest, the same for the checkpoint read back,
    and first losses."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        config = method_configs()[method]
        small = {"width": 16, "depth": 2, "num_coarse_samples": 8, "num_importance_samples": 8}
        manager = replace(config.pipeline.datamanager, train_num_rays_per_batch=32)
        model = replace(config.pipeline.model, **small)
        trainer = prepare(
            replace(
                config, data=scene, output_dir=output_dir, max_num_iterations=STEPS, steps_per_eval_image=STEPS,
                machine=MachineConfig(seed=7, device_type="cpu"),
                pipeline=replace(config.pipeline, datamanager=manager, model=model),
            )
        )  # fmt: skip
        trainer.train()
        weights = [weight for group in trainer.optimizer.param_groups for weight in group["params"]]
        run = RunFolder(trainer.run.path)
        loaded, checkpoint = load_model(run, run.config(method_configs()))
        assert checkpoint == latest_checkpoint(trainer.run.checkpoints)
        assert digest(weights) == digest(weight for group in loaded.parameter_groups() for weight in group.parameters)
        return {
            "weights": digest(weights),
            "losses": [line["loss"] for line in trainer.run.metrics() if "loss" in line][:3],
        }
    finally:
        torch.set_num_threads(threads)


def scene_in(folder: Path) -> Path:
    """The scene that is trained on."""
    return make_scenes(folder, ["mic"], size=24, num_train=3, num_val=1, num_test=1)[0]


def arithmetic() -> str:
    """How this machine and this torch round: where it is another, weights cannot be the same."""
    generator = torch.Generator().manual_seed(0)
    x, first, second = (torch.randn(size, generator=generator) for size in ((96, 27), (27, 16), (16, 4)))
    weights = [first.requires_grad_(), second.requires_grad_()]
    optimizer = torch.optim.Adam(weights, 1e-2)
    for _ in range(20):
        h = torch.relu(torch.cat((torch.sin(x), torch.cos(3 * x)), dim=0) @ weights[0])
        density = torch.exp((h @ weights[1]).clamp(max=4)).cumsum(dim=0)
        loss = (torch.exp(-density) - torch.sigmoid(h[:, :4])).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return digest([*weights, torch.__version__])


def draws() -> dict[str, str]:
    """10,000 pixels of every strategy, from stacked, masked and mixed images; with their weights, if they have any."""
    found = {}
    early = {"uniform": 0, "precrop": 0, "edge": 0}
    for name, sizes in (("same", SAME), ("mixed", MIXED)):
        for masked in (False, True):
            batch = batch_of(sizes, channels=4, masks=half_masks(sizes) if masked else None)
            for images in ("one", "all"):
                for strategy, step in (early | {"se": LATE}).items():
                    settings: dict[str, Any] = {"early": "edge" if strategy == "se" else strategy, "late": "se"}
                    weight = 0.5 if strategy in ("edge", "se") else 0.0
                    sampler = following(
                        step, rays=10_000, seed=5, images_per_step=images, importance_weight=weight, **settings
                    )
                    pixels = sampler.sample(batch)
                    parts = [pixels["indices"], pixels["image"], *([pixels["weight"]] if weight else [])]
                    key = f"{strategy}, {images}, {name}{', masked' if masked else ''}"
                    found[key] = digest(parts)
    return found


def streams() -> dict[str, list[int]]:
    """The first numbers of every stream."""
    return {purpose.name: stream(2**40 + 3, 11, purpose, 2).bit_generator.random_raw(2).tolist() for purpose in Stream}


def main() -> None:
    """Pin everything anew."""
    with tempfile.TemporaryDirectory() as folder:
        scene = scene_in(Path(folder) / "scenes")
        runs = {method: train(method, scene, Path(folder) / "runs") for method in METHODS}
    pins = {"arithmetic": arithmetic(), "runs": runs, "draws": draws(), "streams": streams()}
    PINS.write_text(json.dumps(pins, indent=1) + "\n")


if __name__ == "__main__":
    main()
