"""UniformPixels: Random (equation 2) and Precrop (equation 3)."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
import torch
from goodness import ALPHA, p_value, pixel_counts
from torch import Tensor

from edge_se_sampler.sampling.distribution import UniformPixels

SIZES = [(8, 8), (8, 12), (7, 9), (10, 6), (5, 5), (1, 1), (1, 9), (9, 1), (2, 3), (3, 2), (4, 1)]


def box(height: int, width: int, fraction: Fraction) -> np.ndarray:
    """(H, W) bool: H (1 - f) / 2 <= i < H (1 + f) / 2, in exact arithmetic; f = 1/2 is equation 3."""

    def inside(side: int) -> np.ndarray:
        chosen = np.array([side * (1 - fraction) / 2 <= i < side * (1 + fraction) / 2 for i in range(side)])
        if not chosen.any():
            chosen[min(math.ceil(side * (1 - fraction) / 2), side - 1)] = True
        return chosen

    return np.outer(inside(height), inside(width))


def counts(size: tuple[int, int], fraction: float, n: int) -> np.ndarray:
    pixels = UniformPixels([size], fraction)
    return pixel_counts(pixels.draw(torch.tensor([0]), n, np.random.default_rng(1)), (1, *size))[0]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("fraction", [Fraction(1), Fraction(1, 2), Fraction(3, 4), Fraction(1, 8)])
def test_every_pixel_of_the_box_alike_and_no_other(size: tuple[int, int], fraction: Fraction) -> None:
    inside = box(*size, fraction)
    assert p_value(counts(size, float(fraction), 20_000), inside / inside.sum()) > ALPHA


def test_precrop_of_an_odd_image_by_hand() -> None:
    # 7 / 4 <= i < 21 / 4 and 9 / 4 <= j < 27 / 4
    rows, columns = np.nonzero(counts((7, 9), 0.5, 5000))
    assert sorted(set(rows)) == [2, 3, 4, 5]
    assert sorted(set(columns)) == [3, 4, 5, 6]


@pytest.mark.parametrize("fraction", ["0.1", "0.2", "0.3", "0.5", "0.6", "0.7", "0.9"])
def test_box_is_that_of_exact_arithmetic(fraction: str) -> None:
    sides = range(1, 1001)
    pixels = UniformPixels([(side, side) for side in sides], float(fraction))
    expected = []
    for side in sides:
        low = min(math.ceil(side * (1 - Fraction(fraction)) / 2), side - 1)
        expected.append((low, max(math.ceil(side * (1 + Fraction(fraction)) / 2) - low, 1)))
    got = torch.stack((pixels.low[:, 0], pixels.extent[:, 0]), dim=1).int().tolist()
    assert [(side, *g) for side, g in zip(sides, got, strict=True)] == [
        (side, *e) for side, e in zip(sides, expected, strict=True)
    ]


WRONG: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "the whole image": lambda inside: np.ones_like(inside),
    "rows and columns swapped": lambda inside: inside.T,
    "one row lower": lambda inside: np.roll(inside, 1, axis=0),
    "one column to the left": lambda inside: np.roll(inside, -1, axis=1),
    "one row more": lambda inside: inside | np.roll(inside, 1, axis=0),
    "one column less": lambda inside: inside & np.roll(inside, 1, axis=1),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_box_would_be_seen(wrong: str) -> None:
    inside = np.zeros((16, 16), dtype=bool)
    inside[:8, :14] = box(8, 14, Fraction(1, 2))
    other = WRONG[wrong](inside)
    drawn = np.random.default_rng(0).multinomial(20_000, (other / other.sum()).ravel()).reshape(other.shape)
    assert p_value(drawn, inside / inside.sum()) < ALPHA


def test_image_first_whatever_its_size() -> None:
    sizes = [(2, 3), (20, 30), (1, 1), (9, 4)]
    chosen = torch.tensor([3, 0, 1])  # positions in a draw are those in `images`, not numbers of images
    drawn = UniformPixels(sizes).draw(chosen, 60_000, np.random.default_rng(0))
    assert p_value(np.bincount(drawn[:, 0].numpy(), minlength=3), np.full(3, 1 / 3)) > ALPHA
    for position, image in enumerate(chosen.tolist()):
        within = drawn[drawn[:, 0] == position][:, 1:]
        height, width = sizes[image]
        assert p_value(pixel_counts(within, (height, width)), np.full((height, width), 1 / (height * width))) > ALPHA


class Constant:
    """A generator that always answers the same number."""

    def __init__(self, value: float) -> None:
        self.value = value

    def random(self, shape: tuple[int, ...]) -> np.ndarray:
        return np.full(shape, self.value)


@pytest.mark.parametrize("size", [*SIZES, (800, 800), (4097, 3), (2**20 - 1, 2**20 + 1)])
@pytest.mark.parametrize("fraction", [1.0, 0.5])
def test_extreme_random_numbers_stay_in_the_box(size: tuple[int, int], fraction: float) -> None:
    pixels = UniformPixels([size] * 3, fraction)
    low, high = pixels.low[0].tolist(), (pixels.low[0] + pixels.extent[0] - 1).tolist()
    images = torch.arange(3)
    first: Tensor = pixels.draw(images, 1, Constant(0.0))  # pyright: ignore[reportArgumentType]
    last: Tensor = pixels.draw(images, 1, Constant(np.nextafter(1, 0)))  # pyright: ignore[reportArgumentType]
    assert first.tolist() == [[0, *low]]
    assert last.tolist() == [[2, *high]]


def test_every_image_can_be_drawn_and_no_pixel_is_special() -> None:
    pixels = UniformPixels([(3, 4), (1, 1)], 0.5)
    assert pixels.drawable(torch.tensor([1, 0])).tolist() == [True, True]
    assert pixels.density_ratio(torch.tensor([0]), torch.tensor([[0, 1, 1], [0, 1, 2]])).tolist() == [1, 1]
