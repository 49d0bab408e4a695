"""The whole host, distributed: two gloo processes train a DDP-wrapped model on slices of one draw.

nerfstudio itself starts ranks on GPUs only and hands DDP a device number; here that alone is taken away.
"""
# pyright: reportMissingImports=false

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

pytestmark = pytest.mark.nerfstudio_full
pytest.importorskip("nerfstudio.engine.trainer", reason="needs all of nerfstudio 1.1.5")

RANK = """
import os, sys
from pathlib import Path
import torch
import torch.distributed as dist
from full_host import config_of, trainer_of, watch
from nerfstudio.pipelines import base_pipeline

scene, folder, rank, world = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
config = config_of("edge-se-nerf", scene, folder / f"runs-{rank}", rays=32 // world)
if world > 1:
    dist.init_process_group("gloo", init_method=f"file://{folder}/store", world_size=world, rank=rank)
    barrier = dist.barrier
    dist.barrier = lambda device_ids: barrier()

    class OnTheCPU(base_pipeline.DDP):
        def __init__(self, model, device_ids, **kwargs):
            super().__init__(model, **kwargs)

    base_pipeline.DDP = OnTheCPU
config.machine.num_devices = world
config.timestamp = "run"
import random
random.seed(rank)  # as nerfstudio does: every rank collates its images in an order of its own
trainer = config.setup(local_rank=rank, world_size=world)
trainer.setup()
assert isinstance(trainer.pipeline._model, torch.nn.parallel.DistributedDataParallel) == (world > 1)
sampler = trainer.pipeline.datamanager.train_pixel_sampler
seen, candidates = watch(sampler), []
score = sampler._squared_error
sampler._squared_error = lambda batch: (candidates.append(batch["indices"]), score(batch))[1]
for step in (0, 1, 2, 3):
    for callback in trainer.callbacks:
        callback.func(step=step)
    trainer.train_iteration(step)
weights = torch.cat([p.detach().flatten() for p in trainer.pipeline.model.parameters()])
torch.save(
    {
        "strategies": [strategy for _, strategy, _ in seen],
        "indices": [indices for *_, indices in seen],
        "candidates": candidates,
        "weights": weights,
        "order": trainer.pipeline.datamanager.train_image_dataloader.cached_collated_batch["image_idx"],
    },
    folder / f"rank-{rank}-of-{world}.pt",
)
if world > 1:
    dist.destroy_process_group()
"""


def test_the_union_over_ranks_is_one_draw(host_scene: Path, tmp_path: Path) -> None:
    here = Path(__file__).parent
    environment = {**os.environ, "PYTHONPATH": f"{here}:{here.parent}:{here.parent.parent}", "OMP_NUM_THREADS": "1"}

    def start(rank: int, world: int) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-c", RANK, str(host_scene), str(tmp_path), str(rank), str(world)]
        return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)

    for world in (2, 1):
        assert [process.wait(timeout=300) for process in [start(rank, world) for rank in range(world)]] == [0] * world
    first, second, alone = (torch.load(tmp_path / f"rank-{name}.pt") for name in ("0-of-2", "1-of-2", "0-of-1"))
    assert first["strategies"] == second["strategies"] == alone["strategies"] == ["edge", "edge", "se", "se"]
    assert not torch.equal(first["order"], second["order"])
    for step in (0, 1):
        union = torch.stack((first["indices"][step], second["indices"][step]), dim=1).reshape(-1, 3)
        assert torch.equal(union, alone["indices"][step])
    for part_0, part_1, whole in zip(first["candidates"], second["candidates"], alone["candidates"], strict=True):
        assert torch.equal(torch.stack((part_0, part_1), dim=1).reshape(-1, 3), whole)
    assert torch.equal(first["weights"], second["weights"])
    plans = sorted(tmp_path.glob("runs-*/**/edge-se-plan.json"))
    assert [plan.relative_to(tmp_path).parts[0] for plan in plans] == ["runs-0"]  # the first rank writes it
