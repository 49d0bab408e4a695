"""PixelTable: are pixels drawn in proportion to their strength, image first, and never where it is 0?"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
import torch
from goodness import ALPHA, p_value, pixel_counts
from torch import Tensor

from edge_se_sampler.sampling.distribution import CDF_SCALE, B, PixelTable
from edge_se_sampler.sampling.edges import edge_strength

QUANTUM = 2 / CDF_SCALE
"""Probabilities are exact to twice 1 / CDF_SCALE: a share of the block, a share of the superblock."""


def table_of(*strengths: np.ndarray) -> PixelTable:
    table = PixelTable()
    table.add([torch.from_numpy(strength) for strength in strengths])
    return table


def draws(images: list[np.ndarray], n: int, seed: int = 0) -> Tensor:
    return table_of(*images).draw(torch.arange(len(images)), n, np.random.default_rng(seed))


def corner_scene(side: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Edges + eps of an off-centre box on white, with no symmetry; and a mask that covers a part of its outline."""
    image = np.full((side, side, 3), 255, dtype=np.uint8)
    image[3:17, 9:30] = (180, 60, 20)
    image[11:14, 12:20] = 40
    mask = np.ones((side, side), dtype=np.float32)
    mask[:9, 20:] = 0
    return edge_strength(image) + np.float32(0.01), mask


# ---- within one image

STRENGTH, MASK = corner_scene()
TRUE = (STRENGTH * MASK).astype(np.float64) / (STRENGTH * MASK).astype(np.float64).sum()


def fits(strength: np.ndarray) -> bool:
    """Whether draws from this strength pass for draws from STRENGTH under MASK."""
    drawn = draws([strength], 300_000)
    assert (drawn[:, 0] == 0).all()
    return p_value(pixel_counts(drawn[:, 1:], STRENGTH.shape), TRUE) > ALPHA


def test_draws_in_proportion_to_strength() -> None:
    assert fits(STRENGTH * MASK)


WRONG: dict[str, Callable[[], np.ndarray]] = {
    "rows and columns swapped": lambda: (STRENGTH * MASK).T.copy(),
    "off by one column": lambda: np.roll(STRENGTH * MASK, 1, axis=1),
    "off by one row": lambda: np.roll(STRENGTH * MASK, -1, axis=0),
    "off by one in the flat index": lambda: np.roll((STRENGTH * MASK).ravel(), 1).reshape(STRENGTH.shape),
    "reversed": lambda: (STRENGTH * MASK)[::-1, ::-1].copy(),
    "mirrored": lambda: (STRENGTH * MASK)[:, ::-1].copy(),
    "softmax": lambda: np.exp(STRENGTH) * MASK,
    "squared": lambda: STRENGTH**2 * MASK,
    "uniform": lambda: MASK,
    "epsilon forgotten": lambda: np.maximum(STRENGTH - np.float32(0.01), 0) * MASK,
    "epsilon twice": lambda: (STRENGTH + np.float32(0.01)) * MASK,
    "mask ignored": lambda: STRENGTH,
    "mask the other way round": lambda: STRENGTH * (1 - MASK),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_strength_would_be_seen(wrong: str) -> None:
    assert not fits(WRONG[wrong]())


@pytest.mark.parametrize("shape", [(1, 1), (1, 70), (70, 1), (33, 31), (1, 1024), (1, 1025), (45, 46), (3, 700)])
def test_any_shape(shape: tuple[int, int]) -> None:
    strength = np.random.default_rng(5).uniform(0.2, 1, shape).astype(np.float32)
    strength.ravel()[1::7] = 0
    p = strength.astype(np.float64) / strength.sum(dtype=np.float64)
    drawn = draws([strength], 150_000)
    assert p_value(pixel_counts(drawn[:, 1:], shape), p) > ALPHA


# ---- across images: image first, pixel second

IMAGES = [
    np.full((6, 9), 0.01, dtype=np.float32),  # smooth
    np.zeros((4, 5), dtype=np.float32),  # fully masked
    STRENGTH * MASK,
    np.array([[5.0]], dtype=np.float32),  # one pixel, as strong as many
    np.zeros((50, 50), dtype=np.float32),  # fully masked, more than a superblock
    np.pad(np.full((3, 40), 2, dtype=np.float32), ((37, 0), (0, 0))),  # its first superblocks empty
]
DRAWABLE = [0, 2, 3, 5]


def fits_images(drawn: Tensor) -> bool:
    """Whether draws (image, row, column) choose every drawable image alike, and within it by strength."""
    per_image = np.bincount(drawn[:, 0].numpy(), minlength=len(IMAGES))
    expected = np.isin(np.arange(len(IMAGES)), DRAWABLE) / len(DRAWABLE)
    if p_value(per_image, expected) < ALPHA:
        return False
    for image in DRAWABLE:
        strength = IMAGES[image].astype(np.float64)
        counted = pixel_counts(drawn[drawn[:, 0] == image][:, 1:], strength.shape)
        if p_value(counted, strength / strength.sum()) < ALPHA:
            return False
    return True


def test_every_drawable_image_alike_whatever_its_size_or_sum() -> None:
    table = table_of(*IMAGES)
    assert table.drawable(torch.arange(len(IMAGES))).tolist() == [True, False, True, True, False, True]
    chosen = torch.tensor(DRAWABLE)
    drawn = table.draw(chosen, 600_000, np.random.default_rng(0))
    drawn[:, 0] = chosen[drawn[:, 0]]
    assert fits_images(drawn)


def test_the_first_column_is_the_position_among_the_requested_images() -> None:
    table = table_of(*IMAGES)
    chosen = torch.tensor([5, 3, 0, 2])  # any order, any subset
    drawn = table.draw(chosen, 600_000, np.random.default_rng(1))
    drawn[:, 0] = chosen[drawn[:, 0]]
    assert fits_images(drawn)


@pytest.mark.parametrize("image", DRAWABLE)
def test_one_image_of_many(image: int) -> None:
    strength = IMAGES[image].astype(np.float64)
    drawn = table_of(*IMAGES).draw(torch.tensor([image]), 200_000, np.random.default_rng(2))
    assert (drawn[:, 0] == 0).all()
    assert p_value(pixel_counts(drawn[:, 1:], strength.shape), strength / strength.sum()) > ALPHA


def flat_draws(mass: np.ndarray, n: int) -> Tensor:
    """Draws over all images from one flat distribution, as (image, row, column)."""
    where = np.concatenate([[(k, *at) for at in np.ndindex(*image.shape)] for k, image in enumerate(IMAGES)])
    flat = np.random.default_rng(0).choice(len(mass), size=n, p=mass / mass.sum())
    return torch.from_numpy(where[flat])


FLAT = np.concatenate([image.ravel() for image in IMAGES]).astype(np.float64)
SIZE = np.concatenate([np.full(image.size, image.size, dtype=np.float64) for image in IMAGES])
SUM = np.concatenate([np.full(image.size, image.sum(dtype=np.float64)) for image in IMAGES])
SHARE = np.divide(FLAT, SUM, out=np.zeros_like(FLAT), where=SUM > 0)


def test_the_same_check_passes_a_plain_reference_sampler() -> None:
    assert fits_images(flat_draws(SHARE, 600_000))


@pytest.mark.parametrize(
    ("wrong", "mass"),
    [
        ("globally normalised", FLAT),
        ("images in proportion to their size", SHARE * SIZE),
        ("every image uniform", (FLAT > 0) / SIZE),
        ("a masked image drawn uniformly", np.where(SUM > 0, SHARE, 1 / SIZE)),
    ],
)
def test_a_wrong_choice_of_images_would_be_seen(wrong: str, mass: np.ndarray) -> None:
    assert not fits_images(flat_draws(mass, 600_000)), wrong


# ---- long images

LONG = (5000, 4096)
"""More than 2^24 pixels, where float32 sums stand still and torch.multinomial gives up."""


def band_shares_are_right(rows: np.ndarray) -> bool:
    """Rows of a LONG image whose lower half is three times as strong as the upper, in 100 bands."""
    share = np.repeat([1.0, 3.0], 50) / 200
    return p_value(np.bincount(rows // 50, minlength=100), share) > ALPHA


def long_strength() -> np.ndarray:
    strength = np.ones(LONG, dtype=np.float32)
    strength[LONG[0] // 2 :] = 3
    return strength


def test_one_image_of_more_than_two_to_the_24_pixels() -> None:
    table = table_of(long_strength())
    drawn = table.draw(torch.tensor([0]), 100_000, np.random.default_rng(0)).numpy()
    assert drawn.shape == (100_000, 3)
    assert band_shares_are_right(drawn[:, 1])
    assert p_value(np.bincount(drawn[:, 2] // 64, minlength=64), np.full(64, 1 / 64)) > ALPHA
    assert table.density_ratio(torch.tensor([0]), torch.tensor([[0, 0, 0], [0, 4999, 4095]])).numpy() == pytest.approx(
        [0.5, 1.5], rel=1e-5
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_float32_sums_would_be_seen(dtype: type) -> None:
    cumulative = np.cumsum(long_strength(), dtype=dtype)
    target = np.random.default_rng(0).random(100_000) * cumulative[-1]
    rows = np.searchsorted(cumulative, target.astype(dtype), side="right") // LONG[1]
    assert band_shares_are_right(np.minimum(rows, LONG[0] - 1)) == (dtype == np.float64)


# ---- support is exact

ENDS = [0.0, 2.0**-60, 1 / 3, 0.5, np.nextafter(0.5, 0), 0.75, 1 - 2.0**-36, np.nextafter(1, 0)]


class Given:
    """A generator whose bits say given numbers: u[0] in 53 bits among images, u[1] and u[2] in 30 within nodes."""

    def __init__(self, u: np.ndarray) -> None:
        among, block, pixel = ((u[row] * 2.0**bits).astype(np.uint64) for row, bits in enumerate((53, 30, 30)))
        self.words = np.concatenate((among << 11, (block << 34) | (pixel << 4)))
        self.bit_generator = self

    def random_raw(self, size: int) -> np.ndarray:
        assert size == len(self.words)
        return self.words.copy()


def sparse(shape: tuple[int, int], *at: int) -> np.ndarray:
    strength = np.zeros(shape, dtype=np.float32)
    strength.ravel()[list(at)] = np.linspace(0.1, 3, len(at))
    return strength


@pytest.mark.parametrize(
    "images",
    [
        [sparse((1, 1), 0)],
        [sparse((3, 3), 0)],
        [sparse((3, 3), 8)],
        [sparse((3, 3), 4)],
        [sparse((1, 3000), 0)],
        [sparse((1, 3000), 2999)],
        [sparse((1, 3000), B - 1)],
        [sparse((1, 3000), B)],
        [sparse((1, 3000), B * B - 1)],
        [sparse((1, 3000), B * B)],
        [sparse((1, 3000), B - 1, B, B * B - 1, B * B, 2 * B * B - 1, 2 * B * B, 2 * B * B + 1)],
        [sparse((64, 64), *range(1, 4096, 2))],
        [sparse((64, 64), *range(1000, 1100))],
        [sparse((3, 3), 8), sparse((50, 50)), sparse((3, 3), 0), sparse((50, 50), 2499), sparse((40, 40), 0)],
        [sparse((2, 2)), sparse((60, 60), 3599), sparse((2, 2)), sparse((60, 60), 0), sparse((2, 2))],
    ],
)
def test_no_random_number_reaches_a_pixel_of_strength_zero(images: list[np.ndarray]) -> None:
    table = table_of(*images)
    chosen = torch.tensor([k for k, image in enumerate(images) if image.any()])
    edges = sorted({number for k in range(len(chosen)) for end in ENDS for number in [(k + end) / len(chosen)]})
    numbers = np.array(list(itertools.product([number for number in edges if number < 1], ENDS, ENDS))).T
    drawn = table.draw(chosen, numbers.shape[1], Given(numbers))  # pyright: ignore[reportArgumentType]
    for position, row, column in drawn.unique(dim=0).tolist():
        image = images[chosen[position]]
        assert row < image.shape[0]
        assert column < image.shape[1]
        assert image[row, column] > 0


@pytest.mark.parametrize("images", [1, 2, 3, 7, 100, 1000])
@pytest.mark.parametrize("order", ["ascending", "descending", "the last alone", "the last but one alone"])
def test_the_ends_of_an_image_stay_in_it(images: int, order: str) -> None:
    # the last number of one image is a hair under the first of the next, and rounds up to it if added carelessly
    table = table_of(*[np.ones((1, 2), dtype=np.float32)] * images)
    chosen = {
        "ascending": torch.arange(images),
        "descending": torch.arange(images).flip(0),
        "the last alone": torch.tensor([images - 1]),
        "the last but one alone": torch.tensor([max(images - 2, 0)]),
    }[order]
    first = np.arange(len(chosen)) / len(chosen)
    last = np.append(np.nextafter(first[1:], 0), np.nextafter(1, 0))
    numbers = np.sort(np.concatenate((first, last, np.nextafter(first, 1))))
    numbers = np.floor(numbers * 2**53) / 2**53  # what 53 bits can say
    given = Given(np.stack((numbers, np.full_like(numbers, 0.9), np.full_like(numbers, 0.9))))
    drawn = table.draw(chosen, len(numbers), given)  # pyright: ignore[reportArgumentType]
    assert drawn[:, 0].tolist() == (numbers * len(chosen)).astype(int).tolist()
    assert (drawn[:, 1:] == torch.tensor([0, 1])).all()


def test_probability_is_zero_exactly_where_strength_is() -> None:
    strength = STRENGTH * MASK
    p = table_of(strength).probability(0).numpy()
    assert ((p == 0) == (strength == 0)).all()


def test_a_fully_masked_image_has_probability_zero_everywhere() -> None:
    p = table_of(*IMAGES).probability(4)
    assert p.shape == (50, 50)
    assert not p.any()


def test_more_draws_than_pixels() -> None:
    strength = sparse((5, 7), 17)
    drawn = draws([strength], 1000)
    assert drawn.unique(dim=0).tolist() == [[0, 17 // 7, 17 % 7]]
    assert len(drawn) == 1000


# ---- probabilities


@pytest.mark.parametrize("shape", [(40, 40), (1, 1), (1, 5000), (129, 67)])
def test_probability_is_strength_over_sum(shape: tuple[int, int]) -> None:
    strength = np.random.default_rng(3).exponential(size=shape).astype(np.float32)
    p = table_of(np.ones((3, 3), dtype=np.float32), strength).probability(1).numpy()
    assert p.dtype == np.float64
    assert p.sum() == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(p, strength / strength.sum(dtype=np.float64), rtol=0, atol=QUANTUM)


def test_density_ratio_is_probability_times_drawable_pixels() -> None:
    table = table_of(*IMAGES)
    chosen = torch.tensor([5, 2, 0, 3])
    drawn = table.draw(chosen, 500, np.random.default_rng(0))
    scaled = [table.probability(image) * int(np.count_nonzero(IMAGES[image])) for image in chosen.tolist()]
    expected = [scaled[position][row, column] for position, row, column in drawn.tolist()]
    np.testing.assert_allclose(table.density_ratio(chosen, drawn).numpy(), expected, rtol=1e-12)


def test_density_ratio_of_pixels_that_cannot_be_drawn_is_zero() -> None:
    table = table_of(*IMAGES)
    assert (
        table.density_ratio(torch.tensor([1, 5, 4]), torch.tensor([[0, 0, 0], [1, 0, 0], [2, 49, 49]])).tolist()
        == [0] * 3
    )


def test_the_quantum_is_where_documented() -> None:
    # a share under 2^-31 of its block rounds to nothing, one above 2^-30 never does
    strength = np.ones((1, 3))
    strength[0, 1] = 2.0**-34
    strength[0, 2] = 2.0**-29
    p = table_of(strength).probability(0)[0].tolist()
    assert p[1] == 0
    assert p[2] * CDF_SCALE == pytest.approx(2, abs=1e-6)


# ---- the table


def test_adding_one_by_one_is_adding_at_once() -> None:
    at_once, one_by_one = table_of(*IMAGES), PixelTable()
    one_by_one.add([])
    for k, image in enumerate(IMAGES):
        assert len(one_by_one) == k
        one_by_one.add([torch.from_numpy(image)])
    assert len(one_by_one) == len(at_once) == len(IMAGES)
    assert one_by_one.nbytes == at_once.nbytes
    chosen = torch.tensor(DRAWABLE)
    both = [table.draw(chosen, 5000, np.random.default_rng(9)) for table in (at_once, one_by_one)]
    assert torch.equal(*both)
    for k in range(len(IMAGES)):
        assert torch.equal(at_once.probability(k), one_by_one.probability(k))


def test_images_are_read_one_at_a_time() -> None:
    alive: list[int] = []

    class Counted(torch.Tensor):
        def __del__(self) -> None:
            alive.append(-1)

    def stream():
        for _ in range(5):
            alive.append(1)
            yield torch.ones(40, 40).as_subclass(Counted)

    PixelTable().add(stream())
    assert np.cumsum(alive).max() <= 2


def test_bytes_a_pixel() -> None:
    table = PixelTable()
    table.add(torch.ones(800, 800) for _ in range(3))
    assert table.nbytes / (3 * 800 * 800) == pytest.approx(4 + 4 / B + 8 / B**2, rel=1e-3)


@pytest.mark.parametrize(
    "bad",
    [
        [[0.5, -1e-9]],
        [[0.5, float("nan")]],
        [[float("nan"), 0.5]],
        [[0.5, float("inf")]],
        [[0.5, float("-inf")]],
        [[]],
        [0.5, 0.5],
        [[[0.5]]],
    ],
)
def test_bad_strengths_are_refused_and_leave_the_table_as_it_was(bad: list) -> None:
    table = table_of(IMAGES[0])
    before = table.draw(torch.tensor([0]), 100, np.random.default_rng(0))
    with pytest.raises(ValueError, match="strengths must be"):
        table.add([torch.ones(2, 2), torch.tensor(bad)])
    assert len(table) == 1
    assert torch.equal(table.draw(torch.tensor([0]), 100, np.random.default_rng(0)), before)
    table.add([torch.ones(2, 2)])
    np.testing.assert_allclose(table.probability(1).numpy(), np.full((2, 2), 0.25), atol=QUANTUM)


@pytest.mark.parametrize("scale", [1e-310, 1e-304, 1e308])
def test_float64_strengths_of_any_scale(scale: float) -> None:
    p = table_of(np.full((40, 40), scale)).probability(0)
    np.testing.assert_allclose(p.numpy(), 1 / 1600, rtol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64, torch.uint8, torch.bool])
def test_any_number_type(dtype: torch.dtype) -> None:
    table = PixelTable()
    table.add([torch.tensor([[0, 1, 1], [1, 0, 1]]).to(dtype)])
    np.testing.assert_allclose(table.probability(0).numpy(), [[0, 0.25, 0.25], [0.25, 0, 0.25]], atol=QUANTUM)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_strengths_are_not_touched(dtype: torch.dtype) -> None:
    strength = torch.from_numpy(IMAGES[2]).to(dtype).reshape(STRENGTH.shape)
    whole = torch.ones(32, 32, dtype=dtype)  # no padding needed: a view could leak
    kept = strength.clone()
    table = PixelTable()
    table.add([strength, whole])
    before = table.draw(torch.tensor([0, 1]), 100, np.random.default_rng(0))
    assert torch.equal(strength, kept)
    assert torch.equal(whole, torch.ones(32, 32, dtype=dtype))
    strength.zero_()
    whole.zero_()
    assert torch.equal(table.draw(torch.tensor([0, 1]), 100, np.random.default_rng(0)), before)


def test_a_draw_leaves_its_arguments_alone() -> None:
    chosen = torch.tensor([5, 0, 2])
    table_of(*IMAGES).draw(chosen, 50, np.random.default_rng(0))
    assert chosen.tolist() == [5, 0, 2]


def test_an_image_of_more_than_two_to_the_24_pixels() -> None:
    """Its lower half is twice as strong; torch.multinomial drew nothing there at 2^24 categories."""
    side, count = 4200, 100_000
    strength = np.ones((side, side), dtype=np.float32)
    strength[side // 2 :] = 2
    in_lower_half = int((draws([strength], count)[:, 1] >= side // 2).sum())
    assert p_value(np.array([count - in_lower_half, in_lower_half]), np.array([1 / 3, 2 / 3])) > ALPHA
