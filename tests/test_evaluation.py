"""How good a model is: each measure on pictures whose answer is known."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from tiny import tiny_config, tiny_views, with_constant_density
from torch import Tensor

from edge_se_sampler.data.blender import Views
from edge_se_sampler.data.cameras import RayGenerator
from edge_se_sampler.data.datamanager import cameras_of
from edge_se_sampler.engine.evaluation import (
    Picture,
    evaluate,
    measures,
    pictures_of,
    psnr,
    render_rays,
    render_view,
    ssim,
    target_image,
)
from edge_se_sampler.models import nerf as model_module
from edge_se_sampler.models.nerf import NeRFModel

HEIGHT, WIDTH = 20, 24


def views_of(*images: np.ndarray) -> Views:
    views = tiny_views(len(images), *images[0].shape)
    return replace(views, images=images)


def picture_of(image: np.ndarray) -> Picture:
    """A picture of float pixels, without meaning for its rays."""
    views = views_of((image * 255).astype(np.uint8))
    return Picture("view", image.astype(np.float32), RayGenerator(cameras_of(views)), 0)


def gray(level: float, channels: int = 3) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, channels), level, dtype=np.float32)


def model_of(**changes: Any) -> NeRFModel:
    return NeRFModel(tiny_config(**changes), np.random.default_rng(0))


def empty_model(**changes: Any) -> NeRFModel:
    """One that died: it shows nothing but its background."""
    return with_constant_density(model_of(**changes), -1)


# --- PSNR ---


@pytest.mark.parametrize(("mse", "decibel"), [(1, 0), (0.01, 20), (0.25, 6.020599913279624), (1e-6, 60), (4, -6.0206)])
def test_psnr_is_ten_times_the_logarithm(mse: float, decibel: float) -> None:
    assert psnr(mse) == pytest.approx(decibel, rel=1e-6)


def test_an_exact_match_is_a_finite_psnr() -> None:
    assert psnr(0) == psnr(1e-10) == 100
    assert psnr(2e-10) < 100


def test_the_mean_over_images_is_not_the_pooled_psnr() -> None:
    """Gray pictures against a white rendering: errors 0.01 and 0.25, 20 and 6.02 dB."""
    levels = (np.uint8(round(0.9 * 255)), np.uint8(round(0.5 * 255)))
    views = views_of(*(np.full((HEIGHT, WIDTH, 3), level, dtype=np.uint8) for level in levels))
    errors = [(1 - int(level) / 255) ** 2 for level in levels]
    each = [-10 * math.log10(error) for error in errors]
    result = evaluate(empty_model(), pictures_of(views))
    assert result["psnr"] == pytest.approx(sum(each) / 2, abs=1e-4)
    assert result["psnr_std"] == pytest.approx(abs(each[0] - each[1]) / 2, abs=1e-4)
    assert result["psnr_pooled"] == pytest.approx(-10 * math.log10(sum(errors) / 2), abs=1e-4)
    assert result["num_images"] == 2
    assert [row["psnr"] for row in result["images"]] == pytest.approx(each, abs=1e-4)
    assert [row["mse"] for row in result["images"]] == pytest.approx(errors, abs=1e-6)
    assert result["psnr"] - result["psnr_pooled"] > 2  # or the two could be swapped unseen


@pytest.mark.parametrize(("name", "shade"), [("white", 1.0), ("black", 0.0), ("random", 1.0)])
def test_a_dead_model_has_the_backgrounds_psnr(name: Any, shade: float) -> None:
    views = tiny_views(2, HEIGHT, WIDTH)
    expected = []
    for image in views.images:
        pixels = image.astype(np.float64) / 255
        shown = pixels[..., :3] * pixels[..., 3:] + shade * (1 - pixels[..., 3:])
        expected.append(-10 * math.log10(((shown - shade) ** 2).mean()))
    result = evaluate(empty_model(background_color=name), pictures_of(views))
    assert [row["psnr"] for row in result["images"]] == pytest.approx(expected, abs=1e-4)


# --- SSIM ---


def wang_ssim(first: np.ndarray, second: np.ndarray, border: bool) -> float:
    """Wang et al. 2004 by plain loops over a 11 x 11 Gaussian window, sigma 1.5, K = (0.01, 0.03), a mean over
    channels; with or without the border pixels (mirrored without repeating the edge) that their code leaves out."""
    bell = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    window = np.outer(bell, bell) / bell.sum() ** 2
    scores = []
    for channel in range(3):
        x, y = (picture[..., channel].astype(np.float64) for picture in (first, second))
        if border:
            x, y = (np.pad(values, 5, mode="reflect") for values in (x, y))
        for i in range(x.shape[0] - 10):
            for j in range(x.shape[1] - 10):
                a, b = x[i : i + 11, j : j + 11], y[i : i + 11, j : j + 11]
                mean_a, mean_b = (window * a).sum(), (window * b).sum()
                var_a, var_b = (window * a**2).sum() - mean_a**2, (window * b**2).sum() - mean_b**2
                covariance = (window * a * b).sum() - mean_a * mean_b
                scores.append(
                    (2 * mean_a * mean_b + 1e-4) * (2 * covariance + 9e-4)
                    / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4))
                )  # fmt: skip
    return float(np.mean(scores))


def blurred_noise(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).random((HEIGHT, WIDTH, 3))
    blurred = cv2.GaussianBlur(noise, (5, 5), 1.0)
    return np.rint((blurred - blurred.min()) / np.ptp(blurred) * 255) / 255


@pytest.mark.skipif(not hasattr(cv2, "quality"), reason="this OpenCV has no quality module; ssim is then None")
@pytest.mark.parametrize("seed", [0, 1])
def test_ssim_against_a_second_implementation(seed: int) -> None:
    """OpenCV's also counts the border, whose windows it mirrors; 8-bit pictures, so that its rounding is none."""
    first, other = blurred_noise(seed), blurred_noise(seed + 10)
    second = np.rint((0.7 * first + 0.3 * other) * 255) / 255
    score = ssim(first, second)
    assert score == pytest.approx(wang_ssim(first, second, border=True), abs=1e-5)
    assert score == pytest.approx(wang_ssim(first, second, border=False), abs=0.03)
    assert 0.2 < wang_ssim(first, second, border=True) < 0.95


@pytest.mark.skipif(not hasattr(cv2, "quality"), reason="this OpenCV has no quality module; ssim is then None")
def test_ssim_of_equal_and_of_unlike_pictures() -> None:
    assert ssim(blurred_noise(0), blurred_noise(0)) == pytest.approx(1)
    assert ssim(gray(0), gray(1)) == pytest.approx(1e-4 / (1 + 1e-4), abs=1e-6)  # flat: C1 / (1 + C1)


def test_no_quality_module_is_no_ssim(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(cv2, "quality", raising=False)
    assert ssim(gray(0), gray(1)) is None
    assert measures(gray(0.5), picture_of(gray(0.5)), 1.0)["ssim"] is None


# --- foreground, edge band, background ---


def test_foreground_and_background_are_told_apart_by_alpha() -> None:
    """A gray square, one of whose pixels hardly covers anything; the rendering is off by 0.1 inside, 0.2 outside."""
    image = gray(0.5, 4)
    image[..., 3] = 0
    image[5:15, 4:12, 3] = 1
    image[5, 4, 3] = 1 / 255
    image[0, 0, :3] = 0.123  # under alpha 0 a colour means nothing
    inside = image[..., 3] > 0
    target = target_image(picture_of(image), 1.0)
    np.testing.assert_allclose(target[~inside], 1)
    np.testing.assert_allclose(target[10, 8], 0.5)
    np.testing.assert_allclose(target[5, 4], 0.5 / 255 + 254 / 255, rtol=1e-6)
    rendered = np.where(inside[..., None], target - 0.1, target - 0.2)
    result = measures(rendered, picture_of(image), 1.0)
    assert result["foreground_psnr"] == pytest.approx(20, abs=1e-4)
    assert result["background_mse"] == pytest.approx(0.04, rel=1e-5)
    share = 80 / (HEIGHT * WIDTH)
    assert result["mse"] == pytest.approx(share * 0.01 + (1 - share) * 0.04, rel=1e-5)


def test_the_edge_band_is_the_strongest_tenth_and_its_neighbours() -> None:
    """Black left of column 12, white from it on: Sobel answers in columns 11 and 12, the band is 10 to 13."""
    image = gray(0)
    image[:, 12:] = 1
    for columns, share in (((10, 11, 12, 13), 1), ((9, 14), 0), ((10,), 1 / 4), ((12, 13, 14), 1 / 2)):
        rendered = image.copy()
        rendered[:, columns] += 0.1 * (1 - 2 * image[:, columns])
        expected = 100 if share == 0 else -10 * math.log10(share * 0.01)
        assert measures(rendered, picture_of(image), 1.0)["edge_band_psnr"] == pytest.approx(expected, abs=1e-3)


def test_the_band_takes_the_strongest_tenth_only() -> None:
    """Two edges, one of a tenth the contrast, that fill a fifth of the picture: only the strong one counts."""
    image = np.zeros((HEIGHT, 20, 3), dtype=np.float32)
    image[:, 5:] = 0.8
    image[:, 14:] = 0.88
    rendered = image.copy()
    rendered[:, 10:] = 0
    assert measures(rendered, picture_of(image), 1.0)["edge_band_psnr"] == 100
    rendered[:, 5] -= 0.1
    assert measures(rendered, picture_of(image), 1.0)["edge_band_psnr"] == pytest.approx(
        -10 * math.log10(0.01 / 4), abs=1e-3
    )


def test_what_cannot_be_measured_is_none() -> None:
    no_alpha = measures(gray(0.4), picture_of(gray(0.5)), 1.0)
    assert no_alpha["foreground_psnr"] is no_alpha["background_mse"] is None
    assert no_alpha["edge_band_psnr"] is None  # a flat picture has no edge
    assert no_alpha["psnr"] == pytest.approx(20, abs=1e-4)
    opaque = measures(gray(0.4), picture_of(np.concatenate((gray(0.5), gray(1)[..., :1]), axis=2)), 1.0)
    assert opaque["background_mse"] is None
    assert opaque["foreground_psnr"] == pytest.approx(20, abs=1e-4)
    nothing = measures(gray(0.9), picture_of(np.concatenate((gray(0.5), gray(0)[..., :1]), axis=2)), 1.0)
    assert nothing["foreground_psnr"] is None
    assert nothing["background_mse"] == pytest.approx(0.01, rel=1e-5)


@pytest.mark.parametrize("channels", [3, 4])
def test_results_are_valid_json_even_of_a_perfect_match(channels: int) -> None:
    """White on white: no error, no edge, and without alpha no foreground; nan and inf are not json."""
    views = views_of(*(np.full((HEIGHT, WIDTH, channels), 255, dtype=np.uint8) for _ in range(2)))
    result = evaluate(empty_model(), pictures_of(views))
    json.dumps(result, allow_nan=False)
    assert result["psnr"] == result["psnr_pooled"] == 100
    assert result["lpips"] is None
    assert result["edge_band_psnr"] is None
    assert result["foreground_psnr"] == (None if channels == 3 else 100)


def test_a_mean_is_over_the_views_that_have_the_measure() -> None:
    """One of two views has no foreground: the other's is the mean."""
    seen = np.full((HEIGHT, WIDTH, 4), 255, dtype=np.uint8)
    seen[..., :3] = 102
    unseen = np.zeros((HEIGHT, WIDTH, 4), dtype=np.uint8)
    result = evaluate(empty_model(), pictures_of(views_of(seen, unseen)))
    assert result["foreground_psnr"] == pytest.approx(-10 * math.log10(0.36), abs=1e-4)
    assert result["background_mse"] == 0
    assert [row["name"] for row in result["images"]] == ["view 0", "view 1"]


# --- rendering ---


def test_a_view_is_rendered_pixel_by_pixel_and_clipped() -> None:
    """Row-major, and each pixel from its own ray."""
    views = tiny_views(2, 5, 7)
    model = model_of(density_activation="softplus").eval()
    picture = pictures_of(views)[1]
    rendered, decibel = render_view(model, picture)
    assert rendered.shape == (5, 7, 3)
    for row, column in ((0, 0), (0, 6), (4, 0), (2, 3)):
        ray = RayGenerator(cameras_of(views))(torch.tensor([[1, row, column]]))
        with torch.no_grad():
            expected = model(ray)["rgb_fine"][0]
        np.testing.assert_allclose(rendered[row, column], expected, atol=1e-6)
    assert len(np.unique(rendered.reshape(-1, 3).round(5), axis=0)) > 20
    error = (rendered.astype(np.float64) - target_image(picture, 1.0)) ** 2
    assert decibel == pytest.approx(-10 * math.log10(error.mean()))


@pytest.mark.parametrize("training", [True, False])
def test_chunks_leave_no_seam_and_the_mode_as_it_was(training: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    model = model_of(density_noise=1.0, background_color="random").train(training)
    picture = pictures_of(tiny_views(1, 5, 7))[0]
    rays = picture.rays(torch.device("cpu"))
    whole = {key: render_rays(model, rays, key) for key in ("rgb_fine", "depth_fine")}
    monkeypatch.setattr(model_module, "POINTS_PER_CHUNK", {"cpu": 100})
    for key, value in whole.items():
        chunked = render_rays(model, rays, key)
        torch.testing.assert_close(chunked, value, rtol=1e-5, atol=1e-6)
        assert len(chunked) == 35
        assert not chunked.requires_grad
    assert model.training is training


def test_every_view_is_handed_on_in_order() -> None:
    views = tiny_views(3, 4, 5)
    handed: list[tuple[int, str, np.ndarray]] = []

    def each(i: int, picture: Picture, image: np.ndarray) -> None:
        handed.append((i, picture.name, image))

    result = evaluate(empty_model(), pictures_of(views), each)
    assert [(i, name) for i, name, _ in handed] == [(0, "view 0"), (1, "view 1"), (2, "view 2")]
    assert all(image.shape == (4, 5, 3) and (image == 1).all() for _, _, image in handed)
    assert len(result["images"]) == 3


def test_colours_beyond_one_are_clipped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounding can leave a weight sum, and so a colour, a little above 1."""
    model = empty_model()

    def too_bright(rays: Any) -> dict[str, Tensor]:
        return {"rgb_fine": torch.full((len(rays), 3), 1.5)}

    monkeypatch.setattr(model, "forward", too_bright)
    rendered, decibel = render_view(model, pictures_of(views_of(np.full((4, 4, 3), 255, dtype=np.uint8)))[0])
    assert (rendered == 1).all()
    assert decibel == 100


def test_a_diverged_model_is_no_result() -> None:
    """Clipping leaves nan as it is, and nan is not json."""
    model = empty_model()
    with torch.no_grad():
        model.fine.color.bias[1] = math.nan
        model.fine.density.bias.fill_(1)
    with pytest.raises(FloatingPointError, match="not finite"):
        evaluate(model, pictures_of(tiny_views(1, 4, 4)))
