"""Edge strength: the operators, the gray they see, and what transparency does to it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from edge_se_sampler.sampling.edges import CANNY_THRESHOLDS, FILTERS, edge_strength, luma, unit_float

SHAPES = [(1, 1), (1, 7), (7, 1), (2, 2), (3, 3), (5, 8), (33, 17)]
SOURCES = ("color", "alpha", "both")
ROUNDING = 2e-7
"""A few units in the last place of float32 numbers near 1."""


def random_image(shape: tuple[int, int], channels: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*shape, channels), dtype=np.uint8)


def convolved(gray: np.ndarray, kernel: list[list[float]]) -> np.ndarray:
    """Correlation with replicated borders, term by term in float64."""
    padded = np.pad(gray.astype(np.float64), 1, mode="edge")
    height, width = gray.shape
    total = np.zeros((height, width))
    for i in range(3):
        for j in range(3):
            total += kernel[i][j] * padded[i : i + height, j : j + width]
    return total


# ---- the operators


@pytest.mark.parametrize("shape", SHAPES)
def test_sobel_is_the_magnitude_of_both_gradients(shape: tuple[int, int]) -> None:
    image = random_image(shape, 3)
    gray = image @ np.array([0.299, 0.587, 0.114]) / 255
    gx = convolved(gray, [[-1, 0, 1], [-2, 0, 2], [-1, 0, 1]]) / 4
    gy = convolved(gray, [[-1, -2, -1], [0, 0, 0], [1, 2, 1]]) / 4
    np.testing.assert_allclose(edge_strength(image), np.sqrt(gx**2 + gy**2), atol=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_laplacian_is_that_of_four_neighbours(shape: tuple[int, int]) -> None:
    image = random_image(shape, 3)
    gray = image @ np.array([0.299, 0.587, 0.114]) / 255
    expected = np.abs(convolved(gray, [[0, 1, 0], [1, -4, 1], [0, 1, 0]]))
    np.testing.assert_allclose(edge_strength(image, edge_filter="laplacian"), expected, atol=2e-6)


@pytest.mark.parametrize("edge_filter", FILTERS)
@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("low", [0, 255])
def test_a_full_contrast_step_answers_one(edge_filter: Any, channels: int, axis: int, low: int) -> None:
    image = np.full((9, 12, channels), 255, dtype=np.uint8)
    image[..., :3] = 255 - low
    (image if axis == 0 else image.swapaxes(0, 1))[:5, :, :3] = low
    strength = edge_strength(image, edge_filter=edge_filter)
    along = strength if axis == 0 else strength.T
    # the same all along the step, the frame included
    np.testing.assert_array_equal(along, np.broadcast_to(along[:, :1], along.shape))
    assert along[:, 0].max() == pytest.approx(1, abs=ROUNDING)
    beside = [row for row, value in enumerate(along[:, 0]) if value > 0]
    assert beside == ([4, 5] if edge_filter != "canny" else beside[:1])
    assert set(beside) <= {4, 5}


@pytest.mark.parametrize(("contrast", "edge"), [(0.05, 0), (0.15, 0), (0.25, 1), (1.0, 1)])
def test_canny_sees_steps_above_its_fixed_upper_threshold(contrast: float, edge: float) -> None:
    assert CANNY_THRESHOLDS == (100, 200)  # of 1020: a step of 200 / 1020 = 0.196 starts an edge
    image = np.full((8, 8, 3), (1 + contrast) / 2, dtype=np.float32)
    image[:, 4:] = (1 - contrast) / 2
    assert edge_strength(image, edge_filter="canny").max() == edge


@pytest.mark.parametrize("edge_filter", FILTERS)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("source", SOURCES)
def test_a_flat_image_has_no_edge_not_even_at_its_frame(edge_filter: Any, shape: tuple[int, int], source: Any) -> None:
    for color in [(255, 255, 255, 255), (0, 0, 0, 0), (200, 31, 7, 255), (200, 31, 7, 100)]:
        image = np.broadcast_to(np.array(color, dtype=np.uint8), (*shape, 4))
        strength = edge_strength(image, edge_filter=edge_filter, source=source)
        assert strength.shape == shape
        assert strength.max() == 0


def test_gray_does_not_depend_on_the_column() -> None:
    colors = np.random.default_rng(0).random((200, 1, 1, 3), dtype=np.float32)
    assert max(np.ptp(luma(np.ascontiguousarray(np.broadcast_to(color, (3, 13, 3))))) for color in colors) == 0


@pytest.mark.parametrize("edge_filter", FILTERS)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("dtype", [np.uint8, np.float16, np.float32, np.float64])
def test_one_finite_float32_a_pixel(edge_filter: Any, shape: tuple[int, int], source: Any, dtype: Any) -> None:
    image = random_image(shape, 4)
    image = image if dtype == np.uint8 else (image / 255).astype(dtype)
    strength = edge_strength(image, edge_filter=edge_filter, source=source)
    assert strength.shape == shape
    assert strength.dtype == np.float32
    assert np.isfinite(strength).all()
    assert strength.min() >= 0
    assert (strength.max() > 0) == (shape != (1, 1) and strength.any())
    if edge_filter == "canny":
        assert set(np.unique(strength)) <= {0, 1}


# ---- gray


def test_luma_is_that_of_bt_601() -> None:
    primaries = np.eye(3, dtype=np.float32)[None]
    np.testing.assert_allclose(luma(primaries), [[0.299, 0.587, 0.114]], atol=ROUNDING)
    image = unit_float(random_image((5, 6), 3))
    np.testing.assert_allclose(luma(image), image @ np.array([0.299, 0.587, 0.114]), atol=ROUNDING)


@pytest.mark.parametrize("background", [(1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.2, 0.5, 0.9)])
def test_luma_is_of_the_colour_composited_on_the_background(background: tuple[float, float, float]) -> None:
    image = unit_float(random_image((9, 6), 4))
    color, alpha = image[..., :3].astype(np.float64), image[..., 3:].astype(np.float64)
    composite = alpha * color + (1 - alpha) * np.array(background)
    np.testing.assert_allclose(luma(image, background), composite @ [0.299, 0.587, 0.114], atol=ROUNDING)


# ---- alpha


@pytest.mark.parametrize("edge_filter", FILTERS)
@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_colours_under_alpha_zero_change_no_bit(edge_filter: Any, source: Any, dtype: Any) -> None:
    image = random_image((20, 30), 4)
    image[:, :15, 3] = 0
    other = image.copy()
    other[:, :15, :3] = random_image((20, 15), 3, seed=1)
    both = [image, other] if dtype == np.uint8 else [unit_float(image), unit_float(other)]
    first, second = (edge_strength(one, edge_filter=edge_filter, source=source) for one in both)
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("edge_filter", FILTERS)
def test_full_alpha_is_no_alpha(edge_filter: Any) -> None:
    image = random_image((20, 30), 4)
    image[..., 3] = 255
    np.testing.assert_allclose(
        edge_strength(image, edge_filter=edge_filter, background=(0.3, 0.1, 0.7)),
        edge_strength(image[..., :3], edge_filter=edge_filter),
        atol=5 * ROUNDING,
    )


def square(color: int) -> np.ndarray:
    """An opaque square in the middle of nothing."""
    image = np.zeros((12, 12, 4), dtype=np.uint8)
    image[4:8, 3:9] = (color, color, color, 255)
    return image


@pytest.mark.parametrize("edge_filter", FILTERS)
@pytest.mark.parametrize(
    ("color", "background", "visible"),
    [
        (255, (1.0, 1.0, 1.0), False),
        (255, (0.0, 0.0, 0.0), True),
        (0, (1.0, 1.0, 1.0), True),
        (0, (0.0, 0.0, 0.0), False),
    ],
)
def test_white_on_white_has_only_alpha_edges(
    edge_filter: Any, color: int, background: tuple[float, float, float], visible: bool
) -> None:
    edges = {
        source: edge_strength(square(color), edge_filter=edge_filter, source=source, background=background)
        for source in ("color", "alpha", "both")
    }
    if visible:
        assert edges["color"].max() >= 1 - ROUNDING
    else:
        assert edges["color"].max() == 0
    assert edges["alpha"].max() >= 1 - ROUNDING
    np.testing.assert_array_equal(edges["both"], np.maximum(edges["color"], edges["alpha"]))


def test_the_default_background_is_white() -> None:
    image = random_image((6, 6), 4)
    on_white = edge_strength(image, background=(1.0, 1.0, 1.0))
    np.testing.assert_array_equal(edge_strength(image), on_white)
    assert np.abs(edge_strength(image) - edge_strength(image, background=(0.0, 0.0, 0.0))).max() > 0.05


def test_alpha_edges_are_those_of_alpha_alone() -> None:
    image = random_image((15, 11), 4)
    gray = np.repeat(image[..., 3:], 3, axis=2)
    np.testing.assert_allclose(edge_strength(image, source="alpha"), edge_strength(gray), atol=1e-6)


def test_both_takes_the_stronger_pixel_by_pixel() -> None:
    image = random_image((30, 30), 4)
    color, alpha, both = (edge_strength(image, source=source) for source in ("color", "alpha", "both"))
    np.testing.assert_array_equal(both, np.maximum(color, alpha))
    assert (color > alpha).any()
    assert (alpha > color).any()


# ---- what comes in


@pytest.mark.parametrize("edge_filter", ["sobel", "laplacian"])
@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_eight_bits_and_floats_agree(edge_filter: Any, channels: int, dtype: Any) -> None:
    image = random_image((25, 14), channels)
    as_float = (image / 255).astype(dtype)
    np.testing.assert_allclose(
        edge_strength(image, edge_filter=edge_filter), edge_strength(as_float, edge_filter=edge_filter), atol=2e-6
    )


def test_eight_bits_reach_both_ends_of_the_unit_interval() -> None:
    values = np.arange(256, dtype=np.uint8).reshape(16, 16, 1).repeat(3, axis=2)
    unit = unit_float(values)
    assert unit.dtype == np.float32
    assert unit[0, 0, 0] == 0
    assert unit[15, 15, 0] == 1
    np.testing.assert_allclose(unit, values / 255, rtol=2e-7)


@pytest.mark.parametrize("memory", ["transposed", "mirrored", "every second", "read-only"])
def test_any_memory_layout(memory: str) -> None:
    image = random_image((14, 10), 4)
    seen = {
        "transposed": image.transpose(1, 0, 2),
        "mirrored": image[:, ::-1],
        "every second": image[::2, ::2],
        "read-only": image.copy(),
    }[memory]
    if memory == "read-only":
        seen.setflags(write=False)
    copied = edge_strength(np.ascontiguousarray(seen), source="both")
    np.testing.assert_array_equal(edge_strength(seen, source="both"), copied)


@pytest.mark.parametrize("shape", [(15, 11), (33, 17), (800, 800)])
def test_an_image_has_one_answer_to_the_last_bit(shape: tuple[int, int]) -> None:
    image = random_image(shape, 4)
    kept = [np.empty(size, dtype=np.uint8) for size in range(0, 4000, 40)]  # shifts what is allocated next
    answers = [edge_strength(image) for _ in range(20)]
    for _ in range(20):
        kept.pop()
        answers.append(edge_strength(image))
    assert all(np.array_equal(answer, answers[0]) for answer in answers)


@pytest.mark.parametrize("edge_filter", FILTERS)
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_the_image_is_not_touched(edge_filter: Any, dtype: Any) -> None:
    image = random_image((9, 9), 4)
    image = image if dtype == np.uint8 else unit_float(image).copy()
    before = image.copy()
    edge_strength(image, edge_filter=edge_filter, source="both")[:] = 7  # nor does the answer share its memory
    np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize(
    ("image", "problem"),
    [
        (np.zeros((4, 4), np.uint8), r"must be \(H, W, 3\) or \(H, W, 4\)"),
        (np.zeros((4, 4, 1), np.uint8), r"not \(4, 4, 1\)"),
        (np.zeros((4, 4, 2), np.uint8), r"not \(4, 4, 2\)"),
        (np.zeros((1, 4, 4, 3), np.uint8), r"not \(1, 4, 4, 3\)"),
        (np.zeros((4, 4, 3), np.int64), "uint8 or float, not int64"),
        (np.zeros((4, 4, 3), np.uint16), "uint8 or float, not uint16"),
        (np.zeros((4, 4, 3), bool), "uint8 or float, not bool"),
    ],
)
def test_what_is_no_image_is_refused(image: np.ndarray, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        edge_strength(image)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("at", [(0, 0, 0), (3, 3, 2), (2, 1, 3)])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_a_value_that_is_not_finite_is_refused(bad: float, at: tuple[int, int, int], dtype: Any) -> None:
    image = np.full((4, 4, 4), 0.5, dtype=dtype)
    image[at] = bad
    with pytest.raises(ValueError, match="not finite"):
        edge_strength(image)


@pytest.mark.parametrize("source", ["alpha", "both"])
def test_alpha_edges_without_alpha_are_refused(source: Any) -> None:
    with pytest.raises(ValueError, match=rf"{source}.*no.*use 'color'"):
        edge_strength(random_image((4, 4), 3), source=source)


@pytest.mark.parametrize("value", [-0.5, 1.5, 255.0])
def test_a_float_image_beyond_the_unit_interval_is_refused(value: float) -> None:
    image = np.full((4, 5, 3), 0.5)
    image[2, 3, 1] = value
    with pytest.raises(ValueError, match=r"not in \[0, 1\]"):
        edge_strength(image)
