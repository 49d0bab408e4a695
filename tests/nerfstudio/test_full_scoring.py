"""The whole host: scoring candidates compares as the model's loss does, and leaves the model as it was."""
# pyright: reportMissingImports=false

from __future__ import annotations

import contextlib
import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

pytestmark = pytest.mark.nerfstudio_full
pytest.importorskip("nerfstudio.engine.trainer", reason="needs all of nerfstudio 1.1.5")

from full_host import config_of, trainer_of  # noqa: E402

from edge_se_sampler.errors import InputError  # noqa: E402
from edge_se_sampler.nerfstudio import scoring  # noqa: E402
from edge_se_sampler.sampling.edges import WHITE  # noqa: E402

METHODS = ["se-nerf", "edge-se-nerfacto"]


def late(trainer: Any, step: int = 10) -> Any:
    """The trainer's sampler in its late phase."""
    sampler = trainer.pipeline.datamanager.train_pixel_sampler
    sampler.set_step(step)
    assert sampler.strategy == "se"
    return sampler


def candidates_of(trainer: Any, count: int = 50) -> dict[str, torch.Tensor]:
    """Pixels of the training images, drawn by ourselves."""
    batch = trainer.pipeline.datamanager.train_image_dataloader.cached_collated_batch
    generator = torch.Generator().manual_seed(0)
    k, row, column = (torch.randint(size, (count,), generator=generator) for size in batch["image"].shape[:3])
    return {
        "indices": torch.stack((batch["image_idx"][k], row, column), dim=1),
        "image": batch["image"][k, row, column],
    }


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("name", METHODS)
def test_scoring_leaves_no_trace(name: str, training: bool, host_scene: Path, tmp_path: Path) -> None:
    trainer = trainer_of(config_of(name, host_scene, tmp_path))
    trainer.train_iteration(0)  # a state worth keeping
    model = trainer.pipeline.model
    model.train(training)
    state = copy.deepcopy(trainer.pipeline.state_dict())
    gradients = [p.grad if p.grad is None else p.grad.clone() for p in model.parameters()]
    counters = [vars(m).get("_steps_since_update") for m in model.modules()]
    rng = torch.get_rng_state()
    errors = late(trainer)._squared_error(candidates_of(trainer))
    assert errors.shape == (50,)
    assert not errors.requires_grad
    assert torch.equal(torch.get_rng_state(), rng)
    assert all(m.training == training for m in (model, *model.children()))
    assert [vars(m).get("_steps_since_update") for m in model.modules()] == counters
    after = trainer.pipeline.state_dict()
    assert all(torch.equal(after[key], value) for key, value in state.items())
    for p, gradient in zip(model.parameters(), gradients, strict=True):
        assert (p.grad is None) == (gradient is None)
        assert gradient is None or torch.equal(p.grad, gradient)


def proposal_gradients(trainer: Any, steps: int, score: bool) -> list[bool]:
    """At which steps nerfacto's proposal networks get a gradient, from the tenth on (before, at every one)."""
    networks = trainer.pipeline.model.proposal_networks
    had = []
    for step in range(steps):
        for callback in trainer.callbacks:
            callback.func(step=step)
        trainer.pipeline.datamanager.train_pixel_sampler.set_step(10**4 if score else 0)  # late, or early
        for p in networks.parameters():
            p.grad = None
        trainer.train_iteration(step)
        had.append(any(p.grad is not None for p in networks.parameters()))
    return had[10:]


@contextlib.contextmanager
def as_any_forward_pass(_: Any) -> Iterator[None]:
    yield


def test_nerfactos_proposal_networks_learn_at_the_same_steps_as_without_scoring(
    host_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = config_of("edge-se-nerfacto", host_scene, tmp_path)
    config.pipeline.model.proposal_warmup = 1
    config.pipeline.model.proposal_update_every = 4
    plain = proposal_gradients(trainer_of(config), 25, score=False)
    assert 0 < plain.count(True) < len(plain)
    assert proposal_gradients(trainer_of(config), 25, score=True) == plain
    monkeypatch.setattr(scoring, "_preserved_state", as_any_forward_pass)
    assert not any(proposal_gradients(trainer_of(config), 25, score=True))  # the trap: none ever again


def test_pose_corrections_are_part_of_the_score(host_scene: Path, tmp_path: Path) -> None:
    trainer = trainer_of(config_of("edge-se-nerfacto", host_scene, tmp_path))
    model = trainer.pipeline.model.eval()
    score = late(trainer)._squared_error
    before = score(candidates_of(trainer))
    with torch.no_grad():
        model.camera_optimizer.pose_adjustment += 0.5
    assert (score(candidates_of(trainer)) - before).abs().max() > 1e-4


@pytest.mark.parametrize("background", ["white", "black", "random"])
@pytest.mark.parametrize("name", METHODS)
def test_the_score_is_what_the_loss_averages(
    name: str, background: str, host_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """RGBA images that reach the model: its loss on the candidates is the mean of their scores."""
    config = config_of(name, host_scene, tmp_path, alpha=None)
    config.pipeline.model.background_color = background
    trainer = trainer_of(config)
    assert trainer.pipeline.datamanager.train_image_dataloader.cached_collated_batch["image"].shape[3] == 4
    model = trainer.pipeline.model.train()
    batch = candidates_of(trainer)
    rays = trainer.pipeline.datamanager.train_ray_generator(batch["indices"])
    # the same random numbers in both; the colour of a random background is drawn anew for every comparison
    monkeypatch.setattr(scoring, "_preserved_state", as_any_forward_pass)
    monkeypatch.setattr(torch, "rand_like", lambda image: torch.full_like(image, 0.3))
    with torch.no_grad():
        torch.manual_seed(3)
        errors = scoring.ray_errors(model, rays, batch)
        torch.manual_seed(3)
        outputs = model(rays)
        loss = model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))
    torch.testing.assert_close(errors.mean() / 3, loss["rgb_loss_fine" if name == "se-nerf" else "rgb_loss"])


@pytest.mark.parametrize(
    ("background", "shade"),
    [("white", WHITE), ("black", (0.0, 0.0, 0.0)), ("random", WHITE), ("last_sample", (0, 0, 0))],
)
def test_edges_are_taken_in_front_of_the_models_background(
    background: str, shade: Any, host_scene: Path, tmp_path: Path
) -> None:
    config = config_of("edge-se-nerfacto", host_scene, tmp_path, alpha=None)
    config.pipeline.model.background_color = background
    assert trainer_of(config).pipeline.datamanager.train_pixel_sampler.background_color == shade


def test_a_model_without_colours_is_refused() -> None:
    class Depth(torch.nn.Module):
        def forward(self, rays: Any) -> dict[str, Any]:
            return {"depth": rays}

    with pytest.raises(InputError, match="Depth renders neither rgb nor rgb_fine"):
        scoring.ray_errors(Depth(), torch.zeros(3), {"image": torch.zeros((3, 3))})
