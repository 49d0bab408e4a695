"""The positional encoding holds the sines and cosines that it should, whatever their order."""

from __future__ import annotations

import math

import pytest
import torch

from edge_se_sampler.models.encoding import encoded_size, positional_encoding


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
