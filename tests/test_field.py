"""The radiance field: the paper's network, its skip, its initial weights, and packed against naive evaluation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from tiny import tiny_config
from torch import Tensor, nn

from edge_se_sampler.models.config import NeRFModelConfig, apply_preset
from edge_se_sampler.models.field import NeRFField, encoded_size, positional_encoding
from edge_se_sampler.models.nerf import NeRFModel

PAPER = apply_preset(NeRFModelConfig("paper"), 1024)


def make(seed: int = 0, **changes: Any) -> NeRFField:
    return NeRFField(tiny_config(**changes), np.random.default_rng(seed)).double()


def points(count: int, rays: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Positions (count, 3) and unit directions (rays, 3)."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(rays, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return torch.from_numpy(rng.uniform(-2, 2, (count, 3))), torch.from_numpy(directions)


def linear_layers(module: nn.Module) -> list[nn.Linear]:
    return [layer for layer in module.modules() if isinstance(layer, nn.Linear)]


def reference(field: NeRFField, position: np.ndarray, direction: np.ndarray, octaves: tuple[int, int]) -> np.ndarray:
    """One point as the NeRF paper's figure 7 draws it, by numpy: raw density, red, green, blue."""

    def encode(x: np.ndarray, count: int) -> np.ndarray:
        angles = np.concatenate([2.0**k * x for k in range(count)])
        return np.concatenate((x, np.sin(angles), np.cos(angles)))

    def apply(layer: nn.Module, x: np.ndarray) -> np.ndarray:
        assert isinstance(layer, nn.Linear)
        return layer.weight.detach().numpy() @ x + layer.bias.detach().numpy()

    encoded = encode(position, octaves[0])
    h = encoded
    for number, layer in enumerate(field.layers, start=1):
        if number == 6:  # after the fifth
            h = np.concatenate((encoded, h))
        h = np.maximum(apply(layer, h), 0)
    raw = apply(field.density, h)
    h = np.concatenate((apply(field.feature, h), encode(direction, octaves[1])))
    h = np.maximum(apply(field.view, h), 0)
    return np.concatenate((raw, 1 / (1 + np.exp(-apply(field.color, h)))))


def test_the_papers_network_has_the_originals_parameters() -> None:
    model = NeRFModel(PAPER, np.random.default_rng(0))
    for field in (model.coarse, model.fine):
        assert sum(parameter.numel() for parameter in field.parameters()) == 595_844
    assert sum(parameter.numel() for parameter in model.parameters()) == 2 * 595_844
    shapes = [tuple(layer.weight.shape) for layer in linear_layers(model.fine)]
    assert shapes == [
        (256, 63), (256, 256), (256, 256), (256, 256), (256, 256), (256, 319), (256, 256), (256, 256),
        (1, 256), (256, 256), (128, 283), (3, 128),
    ]  # fmt: skip


@pytest.mark.parametrize("depth", [2, 5, 8])
def test_a_point_is_evaluated_as_the_figure_says(depth: int) -> None:
    field = make(depth=depth, initialization="torch", position_frequencies=3, direction_frequencies=2)
    with torch.no_grad():
        field.density.bias.sub_(field(*points(40, 1), None)[0].median())  # as many points above 0 as below
    positions, directions = points(40, 40)
    density, color = field(positions, directions, torch.arange(40))
    expected = np.stack([reference(field, positions[i].numpy(), directions[i].numpy(), (3, 2)) for i in range(40)])
    assert (expected[:, 0] > 0).any()
    assert (expected[:, 0] < 0).any()
    np.testing.assert_allclose(density.detach(), np.maximum(expected[:, 0], 0), rtol=0, atol=1e-12)
    np.testing.assert_allclose(color.detach(), expected[:, 1:], rtol=0, atol=1e-12)


def test_the_skip_connection_is_after_the_fifth_layer() -> None:
    """A layer that is cut loses the position for good, unless the skip comes later."""
    positions, directions = points(50, 1)
    sees_position = []
    for cut in range(8):
        field = make(depth=8, density_activation="softplus")
        with torch.no_grad():
            field.layers[cut].weight.zero_()  # pyright: ignore[reportCallIssue]
        density, _ = field(positions, directions, None)
        sees_position.append(float(density.detach().std()) > 1e-9)
    assert sees_position == [True] * 5 + [False] * 3


def test_five_layers_have_no_skip() -> None:
    assert [layer.in_features for layer in linear_layers(make(depth=5).layers)] == [15, 8, 8, 8, 8]
    assert [layer.in_features for layer in linear_layers(make(depth=6).layers)] == [15, 8, 8, 8, 8, 23]


def test_density_does_not_depend_on_the_direction_and_colour_does() -> None:
    field = make()
    positions, directions = points(40, 40)
    density, color = field(positions, directions, torch.arange(40))
    other_density, other_color = field(positions, -directions, torch.arange(40))
    assert torch.equal(density, other_density)
    assert float((color - other_color).detach().abs().max()) > 1e-3


def test_samples_in_rows_are_those_of_their_rays() -> None:
    """None for the rays means: all samples of ray 0, then all of ray 1."""
    field = make()
    positions, directions = points(7 * 5, 7)
    dense = field(positions, directions, None)
    packed = field(positions, directions, torch.arange(7).repeat_interleave(5))
    for one, other in zip(dense, packed, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-14)
    wrong = field(positions, directions, torch.arange(7).repeat(5))
    assert not torch.allclose(dense[1], wrong[1])


def test_a_subset_of_the_points_gives_that_subset_of_the_result() -> None:
    field = make()
    positions, directions = points(40, 8)
    noise = torch.from_numpy(np.random.default_rng(1).normal(size=40))
    kept = torch.tensor([0, 3, 4, 17, 39])
    density, color = field(positions, directions, None, noise)
    some_density, some_color = field(positions[kept], directions, kept // 5, noise[kept])
    torch.testing.assert_close(some_density, density[kept], rtol=0, atol=1e-14)
    torch.testing.assert_close(some_color, color[kept], rtol=0, atol=1e-14)


def test_no_points_give_empty_results() -> None:
    _, directions = points(1, 4)
    density, color = make()(torch.zeros(0, 3).double(), directions, torch.zeros(0, dtype=torch.int64))
    assert (density.shape, color.shape) == ((0,), (0, 3))


@pytest.mark.parametrize("raw", [-3.0, 0.0, 0.4, 5.0])
@pytest.mark.parametrize("noise", [None, 0.7])
def test_raw_density_becomes_density(raw: float, noise: float | None) -> None:
    """ReLU, or softplus of one less: log(1 + exp(raw - 1)); noise is added to the raw density."""
    positions, directions = points(3, 1)
    added = None if noise is None else torch.full((3,), noise, dtype=torch.float64)
    total = raw + (noise or 0)
    for activation, expected in (("relu", max(total, 0)), ("softplus", math.log1p(math.exp(total - 1)))):
        field = make(density_activation=activation)
        with torch.no_grad():
            field.density.weight.zero_()
            field.density.bias.fill_(raw)
        density, _ = field(positions, directions, None, added)
        np.testing.assert_allclose(density.detach(), expected, rtol=1e-12)


def test_xavier_bounds_and_zero_biases() -> None:
    """Uniform in +-sqrt(6 / (in + out)): within, filling it, with the variance of a uniform law."""
    for layer in linear_layers(NeRFField(PAPER, np.random.default_rng(0))):
        out_size, in_size = layer.weight.shape
        check_uniform(layer.weight, math.sqrt(6 / (in_size + out_size)))
        assert not layer.bias.any()


def test_torchs_default_bounds() -> None:
    """Weight and bias uniform in +-1 / sqrt(in), as nn.Linear's own."""
    config = apply_preset(NeRFModelConfig("paper", initialization="torch"), 1024)
    for layer in linear_layers(NeRFField(config, np.random.default_rng(0))):
        bound = 1 / math.sqrt(layer.in_features)
        check_uniform(layer.weight, bound)
        if layer.out_features >= 100:
            check_uniform(layer.bias, bound)
        assert float(layer.bias.detach().abs().max()) <= bound * (1 + 1e-6)
        assert layer.bias.all()


def check_uniform(values: Tensor, bound: float) -> None:
    """Kolmogorov-Smirnov at 1e-6 against the uniform law on [-bound, bound], which they must not leave."""
    ordered = np.sort(values.detach().double().numpy().ravel())
    assert np.abs(ordered).max() <= bound * (1 + 1e-6)
    steps = np.arange(len(ordered) + 1) / len(ordered)
    analytic = (ordered / bound + 1) / 2
    gap = max((steps[1:] - analytic).max(), (analytic - steps[:-1]).max())
    assert gap < math.sqrt(math.log(2e6) / (2 * len(ordered)))


def test_weights_follow_the_seed_alone() -> None:
    torch.manual_seed(1)
    first = NeRFModel(tiny_config(), np.random.default_rng(7))
    torch.manual_seed(2)
    state = torch.get_rng_state()
    same = NeRFModel(tiny_config(), np.random.default_rng(7))
    other = NeRFModel(tiny_config(), np.random.default_rng(8))
    assert torch.equal(torch.get_rng_state(), state)
    for one, equal, different in zip(linear_layers(first), linear_layers(same), linear_layers(other), strict=True):
        assert torch.equal(one.weight, equal.weight)
        assert not torch.equal(one.weight, different.weight)


def test_coarse_and_fine_begin_differently() -> None:
    model = NeRFModel(tiny_config(), np.random.default_rng(7))
    for coarse, fine in zip(linear_layers(model.coarse), linear_layers(model.fine), strict=True):
        assert not torch.equal(coarse.weight, fine.weight)


# -- the encoding of positions and directions


@pytest.mark.parametrize(("frequencies", "size"), [(10, 63), (4, 27), (0, 3)])
def test_sizes_of_the_paper(frequencies: int, size: int) -> None:
    assert encoded_size(3, frequencies) == size
    assert positional_encoding(torch.zeros(7, 3), frequencies).shape == (7, size)


def test_every_sine_and_cosine_is_there_once() -> None:
    point = (0.3, -1.1, 2.7)
    expected = [*point]
    for x in point:
        for octave in range(10):
            expected += [math.sin(2**octave * x), math.cos(2**octave * x)]
    encoded = positional_encoding(torch.tensor(point, dtype=torch.float64), 10)
    torch.testing.assert_close(encoded.sort().values, torch.tensor(sorted(expected), dtype=torch.float64))


def test_the_point_itself_comes_first() -> None:
    points = torch.randn(5, 4, 3, generator=torch.Generator().manual_seed(0))
    encoded = positional_encoding(points, 2)
    assert encoded.shape == (5, 4, 15)
    assert torch.equal(encoded[..., :3], points)
    assert torch.equal(positional_encoding(points, 0), points)


def test_the_lowest_wavelength_is_two_pi() -> None:
    """NeRF's code has no factor pi: a shift by a period of the lowest frequency leaves all but the point alone."""
    points = torch.tensor([[0.1, 0.2, 0.3]], dtype=torch.float64)
    here, shifted = positional_encoding(points, 4)[:, 3:], positional_encoding(points + 2 * math.pi, 4)[:, 3:]
    torch.testing.assert_close(here, shifted)
    assert not torch.allclose(here, positional_encoding(points + math.pi, 4)[:, 3:])
    one_octave = positional_encoding(points, 1)[:, 3:]
    assert not torch.allclose(one_octave, positional_encoding(points + math.pi, 1)[:, 3:])
