"""InfoNeRF's losses against closed forms and finite differences, its unseen poses, and a training step."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny import SMALL, tiny_config, tiny_rays, tiny_views
from torch import Tensor

from edge_se_sampler.data.cameras import Cameras, RayBundle
from edge_se_sampler.data.config import VanillaDataManagerConfig
from edge_se_sampler.data.synthetic.cameras import poses
from edge_se_sampler.engine.pipeline import Pipeline
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.session import resolve_config
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models.config import InfoNeRFModelConfig
from edge_se_sampler.models.infonerf import InfoNeRFModel, information_gain, ray_entropy, rotate_rays, rotation_matrix

HIT = torch.ones(1, 1).double()

# -- the losses


@pytest.mark.parametrize("samples", [2, 8, 192])
def test_the_entropy_of_even_opacity_is_the_logarithm_of_the_samples(samples: int) -> None:
    alpha = torch.full((1, samples), 0.3).double()
    assert float(ray_entropy(alpha, HIT, 0.1)) == pytest.approx(math.log2(samples), abs=1e-6)


def test_one_opaque_sample_has_no_entropy() -> None:
    alpha = torch.zeros(1, 64).double()
    alpha[0, 17] = 0.9
    assert float(ray_entropy(alpha, HIT, 0.1)) == pytest.approx(0, abs=1e-7)


def test_the_entropy_of_a_known_distribution() -> None:
    alpha = torch.tensor([[0.1, 0.2, 0.4, 0.1]]).double()  # p = 1/8, 1/4, 1/2, 1/8
    assert float(ray_entropy(alpha, HIT, 0.1)) == pytest.approx(1.75, abs=1e-6)


def test_rays_that_hit_nothing_count_as_0_and_pass_no_gradient() -> None:
    alpha = torch.rand(3, 9, dtype=torch.float64, requires_grad=True)
    accumulation = torch.tensor([[0.05], [0.09], [0.11]]).double().requires_grad_()
    entropy = ray_entropy(alpha, accumulation, 0.1)
    assert entropy[:2].tolist() == [0, 0]
    assert entropy[2] > 0
    entropy.sum().backward()
    assert accumulation.grad is None  # the mask is no path
    assert not alpha.grad[:2].any()  # type: ignore[index]
    assert alpha.grad[2].any()  # type: ignore[index]


def test_an_empty_ray_is_finite() -> None:
    nothing = torch.zeros(2, 5, requires_grad=True)
    loss = ray_entropy(nothing, torch.ones(2, 1), 0.1) + information_gain(nothing, nothing)
    loss.sum().backward()
    assert torch.equal(loss, torch.zeros(2))
    assert torch.isfinite(nothing.grad).all()  # type: ignore[arg-type]


def test_information_gain_is_the_kl_divergence_of_known_distributions() -> None:
    p, q = torch.tensor([[0.25, 0.75]]).double(), torch.tensor([[0.5, 0.5]]).double()
    expected = 0.5 * math.log(0.5 / 0.25) + 0.5 * math.log(0.5 / 0.75)  # of q against p, as in the public code
    assert float(information_gain(0.8 * p, 0.2 * q)) == pytest.approx(expected, abs=1e-8)
    assert float(information_gain(0.8 * p, 0.3 * p)) == pytest.approx(0, abs=1e-8)
    assert float(information_gain(0.8 * q, 0.2 * p)) != pytest.approx(expected, abs=1e-3)  # it is not symmetric


def test_information_gain_is_torchs_batchmean() -> None:
    alpha, near = torch.rand(7, 20).double(), torch.rand(7, 20).double()
    p, q = (a / (a.sum(1, keepdim=True) + 1e-10) + 1e-10 for a in (alpha, near))
    expected = torch.nn.KLDivLoss(reduction="batchmean")(p.log(), q)
    torch.testing.assert_close(information_gain(alpha, near).mean(), expected)


@pytest.mark.parametrize(
    "loss",
    [
        lambda density, near: ray_entropy(1 - (-density * near).exp(), torch.ones(len(density), 1), 0.1),
        lambda density, near: information_gain(1 - (-density).exp(), 1 - (-near).exp()),
    ],
)
def test_gradients_are_finite_differences(loss: Callable[[Tensor, Tensor], Tensor]) -> None:
    torch.manual_seed(0)
    inputs = [torch.rand(3, 6, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    assert torch.autograd.gradcheck(loss, inputs)


# -- poses


def rotation(axis: list[float], degrees: float) -> Tensor:
    """Rodrigues' formula."""
    unit = np.array(axis) / np.linalg.norm(axis)
    skew = np.cross(np.eye(3), unit)
    angle = math.radians(degrees)
    return torch.from_numpy(np.eye(3) + math.sin(angle) * skew + (1 - math.cos(angle)) * skew @ skew)


def cameras(*rotations: Tensor, distance: float = 4.0) -> Cameras:
    """Cameras that look at the origin."""
    poses = torch.stack([torch.cat((r, distance * r[:, 2:]), dim=1) for r in rotations])
    ones = torch.ones(len(rotations), 1)
    return Cameras(poses, 50 * ones, 50 * ones, 5 * ones, 4 * ones, 10 * ones.long(), 8 * ones.long())


@pytest.mark.parametrize("degrees", [0, 1e-5, 30, 120, 179.999])
@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_between_turns_evenly_and_keeps_looking_at_the_same_point(degrees: float, share: float) -> None:
    start = rotation([1, 2, -1], 70)
    both = cameras(start, start @ rotation([0.3, -1, 0.5], degrees))
    between = both.interpolate(0, 1, share)
    expected = start @ rotation([0.3, -1, 0.5], share * degrees)
    torch.testing.assert_close(between.camera_to_worlds[0, :, :3], expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(between.camera_to_worlds[0, :, 3], 4 * expected[:, 2], atol=1e-5, rtol=0)
    assert (len(between), int(between.width), float(between.fx)) == (1, 10, 50.0)


def test_half_a_turn_is_a_rotation_on_the_way() -> None:
    half = cameras(torch.eye(3).double(), rotation([0, 0, 1], 180)).interpolate(0, 1, 0.5).camera_to_worlds[0, :, :3]
    torch.testing.assert_close(half @ half, rotation([0, 0, 1], 180), atol=1e-9, rtol=0)


def test_unseen_rays_are_uniform_in_images_between_training_views() -> None:
    cameras = Cameras.of(poses("train", 3), fx=7, fy=8, cx=3, cy=4, width=6, height=8)
    views = replace(tiny_views(3, 8, 6), cameras=cameras)
    manager = VanillaDataManagerConfig(train_num_rays_per_batch=5).setup(views=views)
    origins = manager.cameras.camera_to_worlds[:, :, 3]
    rays = [manager.unseen_rays(40, np.random.default_rng(seed)) for seed in range(30)]
    assert all(len(bundle) == 40 for bundle in rays)
    assert all(len(bundle.origins.unique(dim=0)) == 1 for bundle in rays)  # a pose a step
    eyes = torch.stack([bundle.origins[0] for bundle in rays])
    assert len(eyes.unique(dim=0)) == 30
    assert (torch.cdist(eyes, origins).min(dim=1).values > 1e-3).float().mean() > 0.8  # not the training poses
    again = manager.unseen_rays(40, np.random.default_rng(3))
    torch.testing.assert_close(again.directions, rays[3].directions, rtol=0, atol=0)


def test_one_training_view_is_its_own_neighbour() -> None:
    manager = VanillaDataManagerConfig(train_num_rays_per_batch=5).setup(views=tiny_views(1, 8, 6))
    rays = manager.unseen_rays(10, np.random.default_rng(0))
    expected = manager.cameras.camera_to_worlds[0, :, 3].expand(10, 3)
    torch.testing.assert_close(rays.origins, expected)


def test_rotation_is_about_z_y_and_x_around_the_origin() -> None:
    angles = torch.tensor([0.1, -0.2, 0.3]).double()
    about = [rotation(axis, math.degrees(a)) for axis, a in zip(np.eye(3).tolist(), angles.tolist(), strict=True)]
    torch.testing.assert_close(rotation_matrix(angles), about[0] @ about[1] @ about[2])
    rays = tiny_rays(5)
    away = rotate_rays(rays, rotation_matrix(angles))
    at, there = (bundle.origins + 2 * bundle.directions for bundle in (rays, away))
    torch.testing.assert_close(there, at @ rotation_matrix(angles).T)
    torch.testing.assert_close(away.directions.norm(dim=1), torch.ones(5).double())


# -- the model


def info_model(**changes: Any) -> InfoNeRFModel:
    settings: dict[str, Any] = vars(tiny_config()) | {"num_unseen_rays": 6} | changes
    return InfoNeRFModel(InfoNeRFModelConfig(**settings), np.random.default_rng(0)).double()


def test_the_gains_weight_decays_and_its_rotation_is_small_and_new_at_every_step() -> None:
    model = info_model(gain_weight=0.01, gain_rate=0.5, gain_steps=10)
    rotations = []
    for step, weight in [(0, 0.01), (9, 0.01), (10, 0.005), (25, 0.0025)]:
        model.begin_step(step, seed=step)
        assert model.gain_weight == pytest.approx(weight)
        angle = math.acos((float(model.rotation.trace()) - 1) / 2)
        assert 0 < angle < math.radians(5) * math.sqrt(3) + 1e-6
        rotations.append(model.rotation)
    assert len(torch.stack(rotations).unique(dim=0)) == 4


def test_the_auxiliary_loss_is_the_weighted_entropy_of_unseen_rays() -> None:
    model = info_model(entropy_weight=0.5).train()
    with torch.no_grad():
        model.fine.density.bias.add_(1)  # something to hit
    rays = tiny_rays(6)
    model.begin_step(0, seed=1)
    loss = model.auxiliary_loss(rays)
    model.begin_step(0, seed=1)
    outputs = model(rays)
    alpha = 1 - torch.exp(-outputs["density_fine"] * outputs["delta_fine"])
    torch.testing.assert_close(loss, 0.5 * ray_entropy(alpha, outputs["accumulation_fine"], 0.1))
    assert loss.max() > 0.1


def test_the_gain_is_added_to_seen_and_unseen_rays_and_off_by_default() -> None:
    batch = {"image": torch.rand(6, 3).double()}

    def losses(weight: float, **changes: Any) -> tuple[Tensor, Tensor]:
        model = info_model(gain_weight=weight, entropy_weight=0.0, **changes).train()
        with torch.no_grad():
            model.fine.density.bias.add_(1)
        model.begin_step(0, seed=1)
        model.random.manual_seed(1)  # the gain's turn has moved it on
        return model.training_loss(tiny_rays(6), batch)[0].detach(), model.auxiliary_loss(tiny_rays(6)).detach()

    alone, _ = losses(3.0, num_unseen_rays=0)
    (seen, unseen), (plain, nothing) = losses(3.0), losses(0.0)
    torch.testing.assert_close(alone - plain, 2 * (seen - plain))  # half of it falls to the unseen rays, if any
    assert (seen - plain).min() > -1e-9
    assert (seen - plain).max() > 1e-4
    assert unseen.max() > 1e-4
    assert not nothing.any()
    assert InfoNeRFModelConfig().gain_weight == 0


def trainer_of(method: str, **model: Any) -> Trainer:
    config = method_configs()[method]
    views = tiny_views(4, 12, 10)
    small = replace(config.pipeline.model, **{"width": 8, "depth": 3, "num_coarse_samples": 6, **model})
    config = resolve_config(
        replace(config, max_num_iterations=10, pipeline=replace(config.pipeline, model=small)), views
    )
    return config.setup(run=RunFolder(Path("nowhere")), pipeline=Pipeline.build(config, views, "cpu"), preview=None)


def test_a_step_minimises_the_error_and_the_entropy_of_as_many_unseen_rays() -> None:
    trainer = trainer_of("info-nerf", entropy_weight=0.7)
    manager, model = trainer.pipeline.datamanager, trainer.pipeline.model
    requested, unseen = [], manager.unseen_rays

    def counted(n: int, rng: np.random.Generator) -> RayBundle:
        requested.append(n)
        return unseen(n, rng)

    manager.unseen_rays = counted
    seen, entropy = [], []
    for name, kept in (("training_loss", seen), ("auxiliary_loss", entropy)):
        method = getattr(model, name)
        setattr(model, name, lambda *a, method=method, kept=kept: (kept.append(method(*a)), kept[-1])[1])
    loss = trainer.train_iteration(0)
    assert requested == [trainer.config.pipeline.datamanager.train_num_rays_per_batch]
    assert loss == pytest.approx(
        float((torch.cat([loss for loss, _ in seen]).mean() + torch.cat(entropy).mean()).detach()), rel=1e-5
    )
    assert torch.cat(entropy).mean() > 0


def test_without_unseen_rays_it_is_nerf() -> None:
    losses = [
        [trainer.train_iteration(step) for step in range(3)]
        for trainer in (trainer_of("info-nerf", num_unseen_rays=0), trainer_of("vanilla-nerf"))
    ]
    assert losses[0] == losses[1]
    assert trainer_of("info-nerf").train_iteration(0) != losses[1][0]


@pytest.mark.parametrize(
    ("setting", "value"),
    [("entropy_weight", -1), ("entropy_threshold", 1), ("gain_weight", math.nan), ("gain_steps", 0)],
)
def test_settings_without_meaning_are_refused(setting: str, value: float) -> None:
    with pytest.raises(InputError, match=f"--pipeline.model.{setting.replace('_', '-')} is "):
        trainer_of("info-nerf", **{setting: value})


# -- few views


def test_info_nerf_trains_resumes_and_is_evaluated_on_a_few_views(scene: Path, tmp_path: Path, edge_se: Any) -> None:
    flags = ["--num-views", "2", "--pipeline.model.gain-weight", "0.01", *SMALL]
    answer = edge_se("train", "edge-se-info-nerf", "--data", scene, "--output-dir", tmp_path / "o", *flags)
    assert answer.code == 0, answer
    (run,) = (tmp_path / "o").glob("*/edge-se-info-nerf/*")
    assert json.loads((run / "config.json").read_text())["num_views"] == 2
    assert edge_se("eval", run, "--output-path", tmp_path / "eval.json").code == 0
