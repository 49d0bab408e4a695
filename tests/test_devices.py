"""Other devices than the CPU: which is chosen, and what training does with tensors on one that has no float64."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import lean_models
import pytest
import torch
from fake_device import DEVICE, FakeTensor, fake_device
from tiny import tiny_config, tiny_trainer, tiny_views

from edge_se_sampler import devices
from edge_se_sampler.engine.config import TrainerConfig, override
from edge_se_sampler.engine.session import choose_device
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models import voxel_backend
from edge_se_sampler.models.voxel_ops import sum_along_rays


@pytest.fixture(autouse=True)
def _no_float64(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "WITHOUT_FLOAT64", ["mps", DEVICE.type])


@pytest.mark.parametrize(
    ("device_type", "found", "expected"),
    [
        ("auto", "cuda mps", "cuda"),
        ("auto", "mps", "mps"),
        ("auto", "", "cpu"),
        ("cpu", "cuda mps", "cpu"),
        ("mps", "cuda mps", "mps"),
        ("mps", "cuda", None),
        ("cuda", "mps", None),
    ],
)
def test_the_device_that_is_chosen(
    device_type: str, found: str, expected: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: "cuda" in found)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: "mps" in found)
    if expected is not None:
        assert choose_device(device_type) == expected
        return
    with pytest.raises(InputError, match=device_type):
        choose_device(device_type)


def nerf_trainer(method: str, device: str, **model: Any) -> Trainer:
    config: TrainerConfig = method_configs()[method]
    manager = replace(config.pipeline.datamanager, train_num_rays_per_batch=37)
    small = vars(tiny_config(**model))
    changed = {key: small[key] for key in (*model, "size", "width", "depth", "num_coarse_samples")}
    pipeline = replace(
        config.pipeline, datamanager=manager, model=replace(config.pipeline.model, num_importance_samples=5, **changed)
    )
    return tiny_trainer(replace(config, pipeline=pipeline, max_num_iterations=8), tiny_views(3, 12, 12), device=device)


def losses(trainer: Trainer, steps: int) -> list[float]:
    return [trainer.train_iteration(step) for step in range(steps)]


@pytest.mark.parametrize(
    ("method", "model"),
    [
        ("edge-se-nerf", {}),
        ("edge-se-nerf", {"density_noise": 0.5, "hard_samples": True, "background_color": "random"}),
        ("info-nerf", {}),
    ],
)
def test_nerfs_train_on_a_device_of_their_own(method: str, model: dict[str, Any]) -> None:
    with fake_device():
        trainer = nerf_trainer(method, str(DEVICE), **model)
        found = losses(trainer, 8)
        assert isinstance(next(trainer.pipeline.model.parameters()), FakeTensor)
    assert found == pytest.approx(losses(nerf_trainer(method, "cpu", **model), 8), rel=1e-5)


def test_lean_nerf_trains_on_a_device_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(voxel_backend, "compiled_ops", lambda: None)
    config = override(lean_models.config_of(40), {"optimizer.fused": False})  # which torch has for real devices alone
    with fake_device():
        trainer = tiny_trainer(config, lean_models.VIEWS, device=str(DEVICE))
        found = losses(trainer, 40)
        assert isinstance(trainer.pipeline.model.density, FakeTensor)
        assert trainer.pipeline.model.grid.level > 0
    assert found == pytest.approx(losses(tiny_trainer(config, lean_models.VIEWS), 40), rel=1e-2)


def test_sums_along_rays_without_float64(monkeypatch: pytest.MonkeyPatch) -> None:
    random = torch.Generator().manual_seed(0)
    rays = torch.randint(5000, (100_000,), generator=random).sort().values
    tau = 10 ** (4 * torch.rand(len(rays), generator=random) - 3)
    expected = sum_along_rays(tau, rays, 5003)
    monkeypatch.setattr(devices, "WITHOUT_FLOAT64", ["cpu"])
    found = sum_along_rays(tau, rays, 5003)
    for one, exact in zip(found, expected, strict=True):
        assert one.dtype == torch.float32
        torch.testing.assert_close(one.double(), exact, rtol=1e-5, atol=1e-6)
    assert [len(x) for x in sum_along_rays(tau[:0], rays[:0], 0)] == [0, 0]


def test_the_fake_device_refuses_what_a_real_one_does() -> None:
    with fake_device():
        there, here = torch.ones(3, device=DEVICE), torch.ones(3)
        with pytest.raises(RuntimeError, match="same device"):
            there + here
        with pytest.raises(TypeError, match="float64"):
            there.double()
        with pytest.raises(TypeError, match="float64"):
            there.to("cpu", torch.float64)
        with pytest.raises(TypeError, match="float64"):
            here.double().to(DEVICE)
        assert torch.equal((there + here.to(DEVICE)).cpu().double(), torch.full((3,), 2.0, dtype=torch.float64))
