"""Image metrics, each on images whose answer is known."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from skimage.metrics import structural_similarity

from edge_se_sampler.engine.metrics import composite_on, compute_metrics, psnr, ssim

HEIGHT, WIDTH = 20, 24


def gray(level: float, channels: int = 3) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, channels), level, dtype=np.float32)


@pytest.mark.parametrize(("mse", "decibel"), [(1, 0), (0.01, 20), (0.25, 6.020599913279624), (1e-6, 60), (4, -6.0206)])
def test_psnr_is_ten_times_the_logarithm(mse: float, decibel: float) -> None:
    assert psnr(mse) == pytest.approx(decibel, rel=1e-6)


def test_an_exact_match_is_a_finite_psnr() -> None:
    assert psnr(0) == psnr(1e-10) == 100
    assert psnr(2e-10) < 100


def reference_ssim(first: np.ndarray, second: np.ndarray) -> float:
    """scikit-image's, with the settings that its documentation gives for Wang et al. 2004."""
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1}
    score: Any = structural_similarity(first, second, channel_axis=2, **settings)
    return score


def blurred_noise(seed: int, height: int, width: int) -> np.ndarray:
    blurred = cv2.GaussianBlur(np.random.default_rng(seed).random((height, width, 3)), (5, 5), 1.0)
    return (blurred - blurred.min()) / np.ptp(blurred)


@pytest.mark.parametrize(("height", "width"), [(11, 11), (11, 30), (24, 20), (100, 100)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_ssim_equals_scikit_image(height: int, width: int, dtype: type) -> None:
    first = blurred_noise(0, height, width).astype(dtype)
    second = (0.7 * first + 0.3 * blurred_noise(1, height, width)).astype(dtype)
    expected = reference_ssim(first, second)
    assert 0.2 < expected < 0.95
    assert ssim(first, second) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(("first", "second"), [(1.0, 0.999), (0.8, 0.79), (1.0, 1.0)])
def test_ssim_of_flat_images_is_as_exact(first: float, second: float) -> None:
    assert ssim(gray(first), gray(second)) == pytest.approx(reference_ssim(gray(first), gray(second)), abs=1e-6)


def test_ssim_leaves_the_border_out() -> None:
    """Images that differ in row 0 alone: only the windows around row 5 reach it. Counting the border answers lower."""
    first = blurred_noise(0, 40, 40)
    second = first.copy()
    second[0] = 0
    score = ssim(first, second)
    assert score == pytest.approx(reference_ssim(first, second), abs=1e-4)
    assert score is not None
    mirrored = reference_ssim(*(np.pad(image, ((5, 5), (5, 5), (0, 0)), mode="reflect") for image in (first, second)))
    assert abs(mirrored - score) > 0.01


def test_ssim_of_equal_and_of_unlike_images() -> None:
    image = blurred_noise(0, HEIGHT, WIDTH)
    assert ssim(image, image) == pytest.approx(1)
    assert ssim(gray(0), gray(1)) == pytest.approx(1e-4 / (1 + 1e-4), abs=1e-6)  # flat: C1 / (1 + C1)


def test_an_image_smaller_than_the_window_has_no_ssim() -> None:
    assert ssim(np.zeros((10, 40, 3)), np.zeros((10, 40, 3))) is None
    assert ssim(np.zeros((40, 10, 3)), np.zeros((40, 10, 3))) is None
    assert compute_metrics(np.zeros((10, 10, 3)), np.zeros((10, 10, 3)), 1.0)["ssim"] is None


def test_foreground_and_background_are_separated_by_alpha() -> None:
    """A gray square, one of whose pixels hardly covers anything; the rendering is off by 0.1 inside, 0.2 outside."""
    image = gray(0.5, 4)
    image[..., 3] = 0
    image[5:15, 4:12, 3] = 1
    image[5, 4, 3] = 1 / 255
    image[0, 0, :3] = 0.123  # under alpha 0 the color is arbitrary
    inside = image[..., 3] > 0
    target = composite_on(image)
    np.testing.assert_allclose(target[~inside], 1)
    np.testing.assert_allclose(target[10, 8], 0.5)
    np.testing.assert_allclose(target[5, 4], 0.5 / 255 + 254 / 255, rtol=1e-6)
    rendered = np.where(inside[..., None], target - 0.1, target - 0.2)
    result = compute_metrics(rendered, image, 1.0)
    assert result["foreground_psnr"] == pytest.approx(20, abs=1e-4)
    assert result["background_mse"] == pytest.approx(0.04, rel=1e-5)
    share = 80 / (HEIGHT * WIDTH)
    assert result["mse"] == pytest.approx(share * 0.01 + (1 - share) * 0.04, rel=1e-5)


def test_the_edge_band_is_the_strongest_tenth_and_its_neighbors() -> None:
    """Black left of column 12, white from it on: Sobel answers in columns 11 and 12, the band is 10 to 13."""
    image = gray(0)
    image[:, 12:] = 1
    for columns, share in (((10, 11, 12, 13), 1), ((9, 14), 0), ((10,), 1 / 4), ((12, 13, 14), 1 / 2)):
        rendered = image.copy()
        rendered[:, columns] += 0.1 * (1 - 2 * image[:, columns])
        expected = 100 if share == 0 else -10 * math.log10(share * 0.01)
        assert compute_metrics(rendered, image, 1.0)["edge_band_psnr"] == pytest.approx(expected, abs=1e-3)


def test_the_edge_band_leaves_weaker_edges_out() -> None:
    """Two edges, one of a tenth the contrast, that fill a fifth of the picture: only the strong one counts."""
    image = np.zeros((HEIGHT, 20, 3), dtype=np.float32)
    image[:, 5:] = 0.8
    image[:, 14:] = 0.88
    rendered = image.copy()
    rendered[:, 10:] = 0
    assert compute_metrics(rendered, image, 1.0)["edge_band_psnr"] == 100
    rendered[:, 5] -= 0.1
    assert compute_metrics(rendered, image, 1.0)["edge_band_psnr"] == pytest.approx(
        -10 * math.log10(0.01 / 4), abs=1e-3
    )


def test_pixels_outside_a_mask_count_in_no_metric() -> None:
    """Half of a picture is rendered well, the other half badly, and unknown."""
    image = np.random.default_rng(0).random((HEIGHT, WIDTH, 4)).astype(np.float32)
    image[:4, :, 3] = 0
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    mask[:, : WIDTH // 2] = True
    rendered = composite_on(image) + np.float32(0.1)
    known = compute_metrics(rendered, image, 1.0, mask)
    rendered[~mask] = 0
    assert compute_metrics(rendered, image, 1.0, mask) == known
    assert known["psnr"] == pytest.approx(20, abs=1e-3)
    assert known["background_mse"] == pytest.approx(0.01, rel=1e-3)
    assert known["foreground_psnr"] == pytest.approx(20, abs=1e-3)
    nothing = compute_metrics(rendered, image, 1.0, np.zeros_like(mask))
    assert set(nothing.values()) == {None}


def test_metrics_without_pixels_are_none() -> None:
    no_alpha = compute_metrics(gray(0.4), gray(0.5), 1.0)
    assert no_alpha["foreground_psnr"] is no_alpha["background_mse"] is None
    assert no_alpha["edge_band_psnr"] is None  # a flat picture has no edge
    assert no_alpha["psnr"] == pytest.approx(20, abs=1e-4)
    opaque = compute_metrics(gray(0.4), np.concatenate((gray(0.5), gray(1)[..., :1]), axis=2), 1.0)
    assert opaque["background_mse"] is None
    assert opaque["foreground_psnr"] == pytest.approx(20, abs=1e-4)
    nothing = compute_metrics(gray(0.9), np.concatenate((gray(0.5), gray(0)[..., :1]), axis=2), 1.0)
    assert nothing["foreground_psnr"] is None
    assert nothing["background_mse"] == pytest.approx(0.01, rel=1e-5)
