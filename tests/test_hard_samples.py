"""Hard samples: which are kept, the gradients through them, and that nothing else changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny import SMALL, grid_of, resume_trainer, tiny_config, tiny_model, tiny_rays, tiny_trainer, tiny_views
from torch import Tensor

from edge_se_sampler.engine.run_folder import config_digest, config_from_json, config_to_json
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models import hard_samples
from edge_se_sampler.models.config import InfoNeRFModelConfig
from edge_se_sampler.models.field import NeRFField
from edge_se_sampler.models.hard_samples import evaluate_hard_samples, keep_probability
from edge_se_sampler.models.infonerf import InfoNeRFModel
from edge_se_sampler.models.nerf import NeRFModel
from edge_se_sampler.occupancy.hull import Hull

RAYS, SAMPLES = 7, 9


def random(*size: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random(size))


def field_and_points(activation: Any, packed: bool) -> tuple[NeRFField, tuple[Any, Any, Any, Any]]:
    field = NeRFField(tiny_config(density_activation=activation), np.random.default_rng(1)).double()
    indices = torch.arange(RAYS).repeat_interleave(SAMPLES)
    if packed:
        indices = indices[random(len(indices)) < 0.7]
    directions = torch.nn.functional.normalize(random(RAYS, 3, seed=2) - 0.5)
    positions, noise = 2 * random(len(indices), 3, seed=3) - 1, random(len(indices), seed=4)
    return field, (positions, directions, indices if packed else None, noise if packed else None)


def some_loss(density: Tensor, color: Tensor) -> Tensor:
    return (density * random(len(density), seed=5) ** 4).square().sum() + (color[:, 1] - 0.2).square().sum() / 9


def gradients(field: NeRFField, loss: Tensor) -> list[Tensor]:
    return list(torch.autograd.grad(loss, list(field.parameters())))


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("activation", ["relu", "softplus"])
def test_gradients_are_those_of_the_kept_samples(activation: str, packed: bool) -> None:
    """Against one graph over all samples, whose raw outputs' gradients say how hard each is."""
    field, points = field_and_points(activation, packed)
    raw: list[Tensor] = []
    hooks = [layer.register_forward_hook(lambda *call: raw.append(call[2])) for layer in (field.density, field.color)]
    outputs = field(*points)
    for hook in hooks:
        hook.remove()
    by_raw = torch.autograd.grad(some_loss(*outputs), raw, retain_graph=True)
    hardness = torch.cat(by_raw, dim=1).norm(dim=1).tolist()
    number = sum(hardness) ** 2 / sum(g**2 for g in hardness)
    probability = torch.tensor([min(1.0, number * g / sum(hardness)) for g in hardness], dtype=torch.float64)
    uniform = random(len(hardness), seed=6)
    scale = torch.where(uniform < probability, 1 / probability.clamp(min=1e-300), 0.0)
    assert 0 < int((scale > 0).sum()) < len(hardness)
    by_output = torch.autograd.grad(some_loss(*outputs), outputs, retain_graph=True)
    scaled = (by_output[0] * scale, by_output[1] * scale[:, None])
    expected = torch.autograd.grad(outputs, list(field.parameters()), scaled)

    found = evaluate_hard_samples(field, *points, uniform)
    assert torch.equal(found[0], outputs[0])
    assert torch.equal(found[1], outputs[1])
    for gradient, reference in zip(gradients(field, some_loss(*found)), expected, strict=True):
        torch.testing.assert_close(gradient, reference)


def test_the_expected_gradient_is_the_full_one() -> None:
    field, points = field_and_points("softplus", packed=True)
    full = torch.cat([gradient.flatten() for gradient in gradients(field, some_loss(*field(*points)))])

    def deviation(power: float) -> float:
        """Of the mean gradient from the full one, in its standard deviations, if draws are u^power."""
        found = []
        for seed in range(400):
            outputs = evaluate_hard_samples(field, *points, random(len(points[0]), seed=100 + seed) ** power)
            found.append(torch.cat([gradient.flatten() for gradient in gradients(field, some_loss(*outputs))]))
        stacked = torch.stack(found)
        return float((stacked.mean(0) - full).norm() / (stacked.var(0).sum() / len(found)).sqrt())

    assert deviation(1.0) < 2
    assert deviation(1.2) > 3  # draws that keep others than pi says are seen


def test_the_number_kept_falls_as_the_gradient_concentrates() -> None:
    even, one = torch.ones(1000), torch.zeros(1000)
    one[3] = 7
    assert torch.equal(keep_probability(even), even)
    assert torch.equal(keep_probability(one), one / 7)
    steep = torch.arange(1000.0) ** 8
    assert 1 <= float(keep_probability(steep).sum()) < 250
    assert float(keep_probability(steep)[-1]) == 1  # the hardest, always
    tiny = steep * 1e-40  # whose squares underflow
    torch.testing.assert_close(keep_probability(tiny), keep_probability(steep), rtol=1e-2, atol=1e-4)
    assert not keep_probability(torch.zeros(5)).any()


def test_nothing_to_learn_gives_no_gradient() -> None:
    field, points = field_and_points("relu", packed=False)
    density, color = evaluate_hard_samples(field, *points, random(RAYS * SAMPLES))
    assert not any(gradient.any() for gradient in gradients(field, 0 * density.sum() + 0 * color.sum()))


def test_rays_that_meet_no_cell_give_no_gradient() -> None:
    model = MODELS["grid"](True).train()
    model.begin_step(0, 5)
    rays = tiny_rays(RAYS)
    rays.origins.add_(100.0)
    model.training_loss(rays, {"image": random(RAYS, 4)})[0].mean().backward()
    assert all(not parameter.grad.any() for parameter in model.parameters() if parameter.grad is not None)


def fixed_draws(model: NeRFModel, monkeypatch: pytest.MonkeyPatch) -> NeRFModel:
    """The model with draws that depend on their shape alone."""
    monkeypatch.setattr(model, "uniform", lambda rows, columns: random(rows, columns, seed=columns))
    return model


def info_nerf(hard: bool) -> InfoNeRFModel:
    settings = vars(tiny_config(hard_samples=hard)) | {"num_unseen_rays": RAYS, "gain_weight": 0.1}
    return InfoNeRFModel(InfoNeRFModelConfig(**settings), np.random.default_rng(0)).double()


BOX = Hull(np.full(3, -1.0), 0.25, np.ones((8, 8, 8), dtype=bool))
MODELS: dict[str, Callable[[bool], NeRFModel]] = {
    "nerf": lambda hard: tiny_model(hard_samples=hard),
    "noise": lambda hard: tiny_model(hard_samples=hard, density_noise=0.3, density_activation="softplus"),
    "grid": lambda hard: tiny_model(hard_samples=hard, grid=grid_of(BOX), empty_space_skipping=True),
    "info-nerf": info_nerf,
}


@pytest.mark.parametrize("name", MODELS)
def test_with_every_sample_kept_the_gradients_are_the_full_ones(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hard_samples, "keep_probability", torch.ones_like)
    found = []
    for hard in (False, True):
        model = fixed_draws(MODELS[name](hard), monkeypatch).train()
        model.begin_step(3, 5)
        batch = {"image": random(RAYS, 4), "weight": random(RAYS, seed=8)}
        loss = model.training_loss(tiny_rays(RAYS), batch)[0].mean() + model.auxiliary_loss(tiny_rays(RAYS, 1)).mean()
        loss.backward()
        found.append([parameter.grad for parameter in model.parameters()])
        assert all(gradient is not None for gradient in found[-1])
    for full, hard in zip(*found, strict=True):
        torch.testing.assert_close(hard, full)


def test_only_few_samples_of_a_step_are_differentiated(monkeypatch: pytest.MonkeyPatch) -> None:
    model = tiny_model(hard_samples=True).train()
    model.begin_step(0, 5)
    evaluated, forward = [], model.fine.forward

    def recorded(positions: Tensor, *arguments: Any) -> Any:
        evaluated.append((len(positions), torch.is_grad_enabled()))
        return forward(positions, *arguments)

    monkeypatch.setattr(model.fine, "forward", recorded)
    model.training_loss(tiny_rays(200), {"image": random(200, 4)})[0].mean().backward()
    (first, graph), (second, graph_again) = evaluated
    assert (first, graph, graph_again) == (200 * 11, False, True)
    assert 0 < second < first / 2


@pytest.mark.parametrize("training", [False, True])
def test_evaluation_and_scoring_are_those_of_the_full_model(training: bool) -> None:
    outputs = []
    for hard in (False, True):
        model = tiny_model(hard_samples=hard).train(training)
        model.begin_step(0, 5)
        with torch.no_grad():
            outputs.append((model(tiny_rays(RAYS)), model.random.get_state()))
    for key, value in outputs[0][0].items():
        assert torch.equal(value, outputs[1][0][key]), key
    assert torch.equal(outputs[0][1], outputs[1][1])


def test_a_resumed_run_is_the_same_bit_for_bit(tmp_path: Path) -> None:
    config, views = method_configs()["edge-se-nerf"], tiny_views()
    model = tiny_config(hard_samples=True, near=2.0, far=6.0)
    manager = replace(config.pipeline.datamanager, train_num_rays_per_batch=16)
    pipeline = replace(config.pipeline, model=model, datamanager=manager)
    config = replace(config, pipeline=pipeline, max_num_iterations=8)
    whole = tiny_trainer(config, views, tmp_path)
    for step in range(4):
        whole.train_iteration(step)
    whole.next_step = 4
    whole.save()
    resumed = resume_trainer(whole, views)
    assert vars(resumed.config.pipeline.model)["hard_samples"]
    for step in range(4, 8):
        assert whole.train_iteration(step) == resumed.train_iteration(step)
    for weight, again in zip(whole.pipeline.model.parameters(), resumed.pipeline.model.parameters(), strict=True):
        assert torch.equal(weight, again)


def test_runs_from_before_the_setting_are_loaded_and_resumed() -> None:
    config = method_configs()["info-nerf"]
    values = config_to_json(config)
    del values["pipeline"]["model"]["hard_samples"]
    del values["pipeline"]["datamanager"]["pixel_sampler"]["quadtree_threshold"]
    assert config_from_json(config, values, "here") == config
    earlier, chosen = (
        replace(config, pipeline=replace(config.pipeline, model=replace(config.pipeline.model, hard_samples=hard)))
        for hard in (False, True)
    )
    assert config_digest(earlier) == config_digest(config)
    assert config_digest(chosen) != config_digest(config)
    assert config_from_json(config, config_to_json(chosen), "here") == chosen


def test_lean_nerf_has_no_such_flag(edge_se: Any, scene: Path, tmp_path: Path) -> None:
    flags = ("--data", scene, "--output-dir", tmp_path / "outputs", "--pipeline.model.hard-samples", "True")
    refused = edge_se("train", "lean-nerf", *flags)
    assert refused.code == 2
    assert "hard-samples" in refused.err
    assert not (tmp_path / "outputs").exists()
    for method in ("vanilla-nerf", "info-nerf"):
        assert edge_se("train", method, *flags, *SMALL).code == 0
