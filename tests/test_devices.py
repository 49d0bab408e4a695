"""Other devices than the CPU: which is chosen, and what training does with tensors on one that has no float64."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lean_models
import numpy as np
import pytest
import torch
from fake_device import DEVICE, FakeTensor, fake_device
from tiny import tiny_config, tiny_trainer

from edge_se_sampler import devices
from edge_se_sampler.engine import session
from edge_se_sampler.engine.config import MANAGER, MODEL, override
from edge_se_sampler.engine.rendering import render_rays
from edge_se_sampler.engine.run_folder import RunFolder
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
        ("auto", "mps", "cpu"),
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
    assert choose_device(device_type, of_run=True) == (expected or "cpu")
    if expected is not None:
        assert choose_device(device_type) == expected
        return
    with pytest.raises(InputError, match=device_type):
        choose_device(device_type)


def nerf_trainer(method: str, device: str, **changes: Any) -> Trainer:
    small = tiny_config()
    names = ("size", "width", "depth", "num_coarse_samples", "num_importance_samples")
    changes = {name: getattr(small, name) for name in names} | changes
    changes = {f"{MODEL}.{name}": value for name, value in changes.items()}
    sizes = {f"{MANAGER}.train_num_rays_per_batch": 37, "max_num_iterations": 6}
    return tiny_trainer(override(method_configs()[method], sizes | changes), lean_models.VIEWS, device=device)


def lean_trainer(device: str) -> Trainer:
    config = override(lean_models.config_of(24), {"optimizer.fused": False})  # torch has it for real devices alone
    return tiny_trainer(config, lean_models.VIEWS, device=device)


def found_by(trainer: Trainer) -> list[float]:
    """Losses of all steps, and what the trained model renders."""
    losses = [trainer.train_iteration(step) for step in range(trainer.plan.num_steps or 0)]
    rays = trainer.pipeline.datamanager.probe_rays(20, np.random.default_rng(0))
    return losses + render_rays(trainer.pipeline.model, rays).flatten().tolist()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "changes"),
    [
        ("edge-se-nerf", {}),
        ("edge-se-nerf", {"density_noise": 0.5, "hard_samples": True, "empty_space_skipping": True}),
        ("info-nerf", {"gain_weight": 1e-3, "background_color": "random"}),
    ],
)
def test_nerfs_train_on_a_device_of_their_own(method: str, changes: dict[str, Any]) -> None:
    with fake_device():
        trainer = nerf_trainer(method, str(DEVICE), **changes)
        found = found_by(trainer)
        assert isinstance(next(trainer.pipeline.model.parameters()), FakeTensor)
    assert found == pytest.approx(found_by(nerf_trainer(method, "cpu", **changes)), rel=1e-4)


def test_runs_of_several_devices_are_averaged_on_the_first_ones(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with fake_device():
        trainers = [nerf_trainer("vanilla-nerf", device) for device in (str(DEVICE), "cpu")]
        rays = trainers[0].pipeline.datamanager.probe_rays(20, np.random.default_rng(0))
        models = iter([trainer.pipeline.model for trainer in trainers])
        monkeypatch.setattr(session, "load_model", lambda *_: (next(models), Path()))
        mean, _ = session.load_ensemble([(RunFolder(tmp_path / f"{i}"), trainers[i].config) for i in range(2)])
        (found,), (alone,) = ([render_rays(model, rays)] for model in (mean, trainers[0].pipeline.model))
    torch.testing.assert_close(found, alone)  # the same initial weights


@pytest.mark.slow
def test_lean_nerf_trains_on_a_device_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(voxel_backend, "compiled_ops", lambda: None)
    with fake_device():
        trainer = lean_trainer(str(DEVICE))
        found = found_by(trainer)
        assert isinstance(trainer.pipeline.model.density, FakeTensor)
        assert trainer.pipeline.model.grid.level > 0
    assert found == pytest.approx(found_by(lean_trainer("cpu")), rel=1e-2, abs=1e-3)


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
            _ = there + here
        with pytest.raises(TypeError, match="float64"):
            there.double()
        with pytest.raises(TypeError, match="float64"):
            there.to("cpu", torch.float64)
        with pytest.raises(TypeError, match="float64"):
            here.double().to(DEVICE)
        assert torch.equal((there + here.to(DEVICE)).cpu().double(), torch.full((3,), 2.0, dtype=torch.float64))
