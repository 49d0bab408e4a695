"""The whole model: what it renders in training and in evaluation, its loss, and that loss's gradients."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from tiny import check_gradients, grid_of, tiny_model, tiny_rays, with_constant_density
from torch import Tensor, nn

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.models import nerf
from edge_se_sampler.models.nerf import NeRFModel
from edge_se_sampler.models.ray_model import target_colors
from edge_se_sampler.occupancy.bricks import BrickGrid
from edge_se_sampler.occupancy.hull import Hull

RAYS = 9
OUTPUTS = ("rgb_coarse", "rgb_fine", "accumulation_coarse", "accumulation_fine", "depth_fine")


def pixels(channels: int = 4, seed: int = 0) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random((RAYS, channels)))


def rendered(model: NeRFModel, seed: int = 3, rays: RayBundle | None = None) -> dict[str, Tensor]:
    model.begin_step(0, seed)
    return model(tiny_rays(RAYS) if rays is None else rays)


def recorded(field: nn.Module, monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """The arguments of every later call of the field."""
    calls: list[tuple[Any, ...]] = []
    forward = field.forward
    monkeypatch.setattr(field, "forward", lambda *arguments: (calls.append(arguments), forward(*arguments))[1])
    return calls


def distances(positions: Tensor, rays: RayBundle) -> Tensor:
    """How far along its ray each sample lies, (n, s); it must lie on the ray."""
    offset = positions.reshape(len(rays), -1, 3) - rays.origins[:, None]
    t = (offset * rays.directions[:, None]).sum(2)
    torch.testing.assert_close(offset, t[..., None] * rays.directions[:, None])
    return t


# --- where the samples are ---


def test_evaluation_samples_lie_between_the_depths_near_and_far(monkeypatch: pytest.MonkeyPatch) -> None:
    """near and far are depths along the optical axis: a ray aside is directions_norm times longer."""
    model, rays = tiny_model(near=1.5, far=5.5).eval(), tiny_rays(RAYS)
    coarse, fine = recorded(model.coarse, monkeypatch), recorded(model.fine, monkeypatch)
    model(rays)
    expected = torch.linspace(1.5, 5.5, 6, dtype=torch.float64) * rays.metadata["directions_norm"]
    torch.testing.assert_close(distances(coarse[0][0], rays), expected)
    t = distances(fine[0][0], rays)
    assert t.shape == (RAYS, 11)
    assert bool((t[:, 1:] >= t[:, :-1]).all())
    for ray in range(RAYS):  # the fine network sees the coarse samples too
        gaps = (t[ray][None] - expected[ray][:, None]).abs().min(dim=1).values
        assert float(gaps.max()) < 1e-9


def test_importance_samples_go_where_the_coarse_network_has_seen_something(monkeypatch: pytest.MonkeyPatch) -> None:
    """A coarse network that sees one shell: nearly all further samples fall within the bins around it."""
    model, rays = tiny_model(num_coarse_samples=17, num_importance_samples=200).eval(), tiny_rays(RAYS)
    rays.metadata["directions_norm"].fill_(1)

    def shell(positions: Tensor, directions: Tensor, ray_indices: None, noise: None) -> tuple[Tensor, Tensor]:
        t = distances(positions, rays).reshape(-1)
        return 100.0 * ((t > 3.2) & (t < 3.3)).double(), torch.zeros_like(positions)

    monkeypatch.setattr(model.coarse, "forward", shell)  # of the samples 2, 2.25, ... it is the one at 3.25
    fine = recorded(model.fine, monkeypatch)
    model(rays)
    t = distances(fine[0][0], rays)
    share = float(((t > 3.125 - 1e-9) & (t < 3.375 + 1e-9)).double().sum(1).min()) - 1
    assert share >= 198


def test_training_jitters_within_the_bins(monkeypatch: pytest.MonkeyPatch) -> None:
    model, rays = tiny_model().train(), tiny_rays(RAYS)
    rays.metadata["directions_norm"].fill_(1)
    coarse = recorded(model.coarse, monkeypatch)
    rendered(model, rays=rays)
    t = distances(coarse[0][0], rays).numpy()
    bins = [2, 2.4, 3.2, 4.0, 4.8, 5.6, 6]
    for ray in range(RAYS):
        assert np.histogram(t[ray], bins)[0].tolist() == [1] * 6
    assert t.std(axis=0).min() > 0.02  # every ray its own


# --- randomness ---


def test_evaluation_is_deterministic_and_ignores_the_seed() -> None:
    model = tiny_model(density_noise=1.0, background_color="random").eval()
    first, second = rendered(model, 1), rendered(model, 2)
    for key, value in first.items():
        assert torch.equal(value, second[key])


def test_training_repeats_from_its_seed() -> None:
    model = tiny_model(density_noise=1.0, background_color="random").train()
    first, again, other = rendered(model, 1), rendered(model, 1), rendered(model, 2)
    for key, value in first.items():
        assert torch.equal(value, again[key])
        assert not torch.equal(value, other[key])


def numpy_state() -> list[int]:
    return np.random.get_state(legacy=False)["state"]["key"].tolist()  # noqa: NPY002


def test_global_generators_are_neither_read_nor_moved() -> None:
    model = tiny_model(density_noise=1.0, background_color="random").train()
    torch.manual_seed(1)
    first = rendered(model)
    torch.manual_seed(2)
    states = torch.get_rng_state(), numpy_state(), random.getstate()
    second = rendered(model)
    assert torch.equal(torch.get_rng_state(), states[0])
    assert numpy_state() == states[1]
    assert random.getstate() == states[2]
    for key, value in first.items():
        assert torch.equal(value, second[key])


def test_density_noise_acts_in_training_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    quiet, noisy = tiny_model(), tiny_model(density_noise=0.5)
    for key, value in rendered(quiet.eval()).items():
        assert torch.equal(value, rendered(noisy.eval())[key])
    rays = tiny_rays(2000)
    calls = [recorded(field, monkeypatch) for field in (noisy.coarse, noisy.fine)]
    rendered(noisy.train(), rays=rays)
    for [(_, _, _, noise)] in calls:
        assert float(noise.std()) == pytest.approx(0.5, rel=0.05)
        assert abs(float(noise.mean())) < 0.02
    unheard = recorded(quiet.coarse, monkeypatch)
    rendered(quiet.train())
    assert unheard[0][3] is None


# --- background ---


@pytest.mark.parametrize(("name", "gray"), [("white", 1.0), ("black", 0.0)])
@pytest.mark.parametrize("training", [True, False])
def test_an_empty_model_shows_its_background(name: Any, gray: float, training: bool) -> None:
    model = with_constant_density(tiny_model(background_color=name), -1).train(training)
    outputs = rendered(model)
    for level in ("coarse", "fine"):
        assert bool((outputs[f"rgb_{level}"] == gray).all())
        assert not outputs[f"accumulation_{level}"].any()
    far = 6 * tiny_rays(RAYS).metadata["directions_norm"]
    if training:  # the last sample is somewhere in the last bin, from 5.6 on
        assert bool(((outputs["depth_fine"] > far * 5.5 / 6) & (outputs["depth_fine"] <= far)).all())
    else:
        torch.testing.assert_close(outputs["depth_fine"], far)


def test_a_random_background_is_the_same_for_prediction_and_target() -> None:
    model = with_constant_density(tiny_model(background_color="random"), -1).train()
    outputs = rendered(model)
    background = outputs["background"]
    assert bool(((background >= 0) & (background <= 1)).all())
    assert len(torch.unique(background)) == RAYS * 3  # another colour for every ray
    assert torch.equal(outputs["rgb_coarse"], background)
    assert torch.equal(outputs["rgb_fine"], background)
    image = pixels()
    image[:, 3] = 0
    assert not model.loss(outputs, {"image": image})[0].any()
    image[:, 3] = 1
    torch.testing.assert_close(model.squared_error(outputs, image), (background - image[:, :3]).square().sum(1))
    assert bool((rendered(model.eval())["background"] == 1).all())


def test_random_backgrounds_are_uniform() -> None:
    model = tiny_model(background_color="random").train()
    ordered = rendered(model, rays=tiny_rays(3000))["background"].flatten().sort().values.numpy()
    steps = np.arange(len(ordered) + 1) / len(ordered)
    gap = max((steps[1:] - ordered).max(), (ordered - steps[:-1]).max())
    assert gap < np.sqrt(np.log(2e6) / (2 * len(ordered)))  # Kolmogorov-Smirnov at 1e-6


def test_targets_are_composited() -> None:
    """Straight alpha: a quarter of red in front of blue."""
    image, blue = torch.tensor([[1.0, 0.0, 0.0, 0.25]]), torch.tensor([[0.0, 0.0, 1.0]])
    assert target_colors(image, blue).tolist() == [[0.25, 0.0, 0.75]]
    assert target_colors(image[:, :3], blue).tolist() == [[1.0, 0.0, 0.0]]


def test_an_opaque_wall_is_seen_at_its_first_sample() -> None:
    """Density everywhere: the nearest sample takes all, also at the depth it reports."""
    model = with_constant_density(tiny_model(), 1e6).eval()
    outputs = rendered(model)
    torch.testing.assert_close(outputs["depth_fine"], 2 * tiny_rays(RAYS).metadata["directions_norm"])
    torch.testing.assert_close(outputs["accumulation_fine"], torch.ones(RAYS, 1).double())
    rays = tiny_rays(RAYS)
    nearest = rays.origins + outputs["depth_fine"] * rays.directions
    _, color = model.fine(nearest, rays.directions, None)
    torch.testing.assert_close(outputs["rgb_fine"], color)


# --- loss ---


def test_the_loss_is_coarse_and_fine_error_a_mean_over_channels() -> None:
    model = tiny_model()
    outputs = {
        "rgb_coarse": torch.tensor([[0.1, 0.2, 0.3], [0.0, 0.0, 0.0]]),
        "rgb_fine": torch.tensor([[0.5, 0.5, 0.5], [1.0, 1.0, 1.0]]),
        "background": torch.ones(2, 3),
    }
    batch = {"image": torch.tensor([[0.2, 0.4, 0.6], [1.0, 0.0, 1.0]])}
    coarse = torch.tensor([0.01 + 0.04 + 0.09, 2.0])
    fine = torch.tensor([0.09 + 0.01 + 0.01, 1.0])
    torch.testing.assert_close(model.squared_error(outputs, batch["image"]), fine)
    torch.testing.assert_close(model.squared_error(outputs, batch["image"], "coarse"), coarse)
    loss, fine_error = model.loss(outputs, batch)
    torch.testing.assert_close(loss, (coarse + fine) / 3)
    torch.testing.assert_close(fine_error, fine)
    weighted, _ = model.loss(outputs, batch | {"weight": torch.tensor([2.0, 0.0])})
    torch.testing.assert_close(weighted, torch.tensor([2.0, 0.0]) * (coarse + fine) / 3)


def hold_importance(monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on the importance samples are those of the next call: no gradient flows through their positions."""
    draw, held = nerf.importance, []

    def first(*inputs: Tensor) -> Tensor:
        held.append(draw(*inputs))
        return held[0]

    monkeypatch.setattr(nerf, "importance", first)


@pytest.mark.parametrize("culled", [False, True])
def test_gradients_of_every_layer_against_finite_differences(culled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    grid = ball_grid(1.5) if culled else None
    model = tiny_model(grid=grid, density_activation="softplus", density_noise=0.2, background_color="random").train()
    hold_importance(monkeypatch)
    batch = {"image": pixels(), "weight": torch.linspace(0.5, 2, RAYS, dtype=torch.float64)}

    def loss() -> Tensor:
        return model.loss(rendered(model), batch)[0].sum()

    check_gradients(model, loss)


def test_the_fine_error_does_not_pull_at_the_coarse_network() -> None:
    model = tiny_model(density_activation="softplus").train()
    outputs = rendered(model)
    model.squared_error(outputs, pixels()).sum().backward()
    assert all(parameter.grad is None or not parameter.grad.any() for parameter in model.coarse.parameters())
    assert all(parameter.grad is not None and parameter.grad.any() for parameter in model.fine.parameters())


# --- packed rendering ---


def ball_grid(radius: float) -> BrickGrid:
    """Cells whose center lies in a ball around the origin."""
    centers = np.stack(np.meshgrid(*[np.arange(-1.75, 2, 0.5)] * 3, indexing="ij"))
    return grid_of(Hull(np.full(3, -2.0), 0.5, np.linalg.norm(centers, axis=0) < radius))


def mask_density(field: nn.Module, occupied: Callable[[Tensor], Tensor]) -> None:
    """Evaluate everywhere, and throw away what lies where there is nothing: dense culling."""
    forward = field.forward

    def mcalls(positions: Tensor, *others: Any) -> tuple[Tensor, Tensor]:
        density, color = forward(positions, *others)
        return density * occupied(positions), color

    field.forward = mcalls


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("activation", ["relu", "softplus"])
def test_culled_rendering_equals_dense_rendering_of_zeros(training: bool, activation: Any) -> None:
    settings: dict[str, Any] = {"density_activation": activation, "density_noise": 0.5, "background_color": "random"}
    grid = ball_grid(1.2)
    packed, dense = (tiny_model(grid=cells, **settings).train(training) for cells in (grid, None))
    for field in (dense.coarse, dense.fine):
        mask_density(field, grid.contains)
    batch = {"image": pixels()}
    losses, outputs = [], []
    for model in (packed, dense):
        outputs.append(rendered(model))
        losses.append(model.loss(outputs[-1], batch)[0].sum())
        losses[-1].backward()
    for key in OUTPUTS:
        torch.testing.assert_close(outputs[0][key], outputs[1][key], rtol=0, atol=1e-12)
    assert 0.01 < float(outputs[0]["accumulation_fine"].detach().mean()) < 0.99  # something, and not everything
    for one, other in zip(packed.parameters(), dense.parameters(), strict=True):
        torch.testing.assert_close(one.grad, other.grad, rtol=0, atol=1e-12)
        assert one.grad is not None


def test_no_network_is_evaluated_in_empty_space(monkeypatch: pytest.MonkeyPatch) -> None:
    everywhere = recorded((dense := tiny_model().eval()).fine, monkeypatch)
    rendered(dense)
    model = tiny_model(grid=ball_grid(1.2)).eval()
    calls = recorded(model.coarse, monkeypatch)
    rendered(model)
    positions, _, ray_indices, _ = calls[0]
    assert 0 < len(positions) < RAYS * 6
    assert bool(ball_grid(1.2).contains(positions).all())
    rays = tiny_rays(RAYS)
    offset = positions - rays.origins[ray_indices]
    cosine = (offset * rays.directions[ray_indices]).sum(1) / offset.norm(dim=1)
    torch.testing.assert_close(cosine, torch.ones_like(cosine))  # each point with its own ray
    assert len(everywhere[0][0]) == RAYS * 11


def test_where_nothing_is_occupied_the_background_stays_and_there_is_no_gradient() -> None:
    model = tiny_model(grid=ball_grid(0)).train()
    outputs = rendered(model)
    assert bool((outputs["rgb_fine"] == 1).all())
    model.loss(outputs, {"image": pixels()})[0].sum().backward()
    assert all(parameter.grad is None or not parameter.grad.any() for parameter in model.parameters())


def test_on_a_grid_that_is_all_occupied_it_is_the_dense_nerf() -> None:
    everything, middle = (
        grid_of(Hull(np.full(3, -half), size, np.ones((count,) * 3, dtype=bool)))
        for half, size, count in ((9.0, 1.0, 18), (0.3, 0.2, 3))
    )
    dense, whole, part = (
        tiny_model(grid=grid, density_activation="softplus").eval() for grid in (None, everything, middle)
    )
    rays = tiny_rays(RAYS)
    for key, value in dense(rays).items():
        torch.testing.assert_close(whole(rays)[key], value, rtol=0, atol=1e-12)
    assert float((part(rays)["rgb_fine"] - dense(rays)["rgb_fine"]).detach().abs().max()) > 1e-3
