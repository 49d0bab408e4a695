"""Evaluation: views are rendered pixel by pixel, and their metrics averaged."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from lean_models import full_model
from tiny import tiny_config, tiny_views, with_constant_density
from torch import Tensor

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.evaluation import evaluate
from edge_se_sampler.engine.metrics import composite_on
from edge_se_sampler.engine.rendering import (
    Picture,
    measure_psnr,
    render_opaque,
    render_rays,
    render_view,
    to_pictures,
)
from edge_se_sampler.models import nerf as model_module
from edge_se_sampler.models.ensemble import Ensemble
from edge_se_sampler.models.nerf import NeRFModel

HEIGHT, WIDTH = 20, 24


def views_of(*images: np.ndarray) -> Views:
    views = tiny_views(len(images), *images[0].shape)
    return replace(views, images=images)


def model_of(**changes: Any) -> NeRFModel:
    return NeRFModel(tiny_config(**changes), np.random.default_rng(0))


def empty_model(**changes: Any) -> NeRFModel:
    """A model without density: it renders its background alone."""
    return with_constant_density(model_of(**changes), -1)


def test_the_mean_over_images_is_not_the_pooled_psnr() -> None:
    """Gray pictures against a white rendering: errors 0.01 and 0.25, 20 and 6.02 dB."""
    levels = (np.uint8(round(0.9 * 255)), np.uint8(round(0.5 * 255)))
    views = views_of(*(np.full((HEIGHT, WIDTH, 3), level, dtype=np.uint8) for level in levels))
    errors = [(1 - int(level) / 255) ** 2 for level in levels]
    each = [-10 * math.log10(error) for error in errors]
    result = evaluate(empty_model(), to_pictures(views))
    assert result["psnr"] == pytest.approx(sum(each) / 2, abs=1e-4)
    assert result["psnr_std"] == pytest.approx(abs(each[0] - each[1]) / 2, abs=1e-4)
    assert result["psnr_pooled"] == pytest.approx(-10 * math.log10(sum(errors) / 2), abs=1e-4)
    assert result["num_images"] == 2
    assert [row["psnr"] for row in result["images"]] == pytest.approx(each, abs=1e-4)
    assert [row["mse"] for row in result["images"]] == pytest.approx(errors, abs=1e-6)
    assert result["psnr"] - result["psnr_pooled"] > 2  # or the two could be swapped unseen


@pytest.mark.parametrize(("name", "level"), [("white", 1.0), ("black", 0.0), ("random", 1.0)])
def test_an_empty_model_has_the_psnr_of_the_background_alone(name: Any, level: float) -> None:
    views = tiny_views(2, HEIGHT, WIDTH)
    expected = []
    for image in views.images:
        pixels = image.astype(np.float64) / 255
        shown = pixels[..., :3] * pixels[..., 3:] + level * (1 - pixels[..., 3:])
        expected.append(-10 * math.log10(((shown - level) ** 2).mean()))
    result = evaluate(empty_model(background_color=name), to_pictures(views))
    assert [row["psnr"] for row in result["images"]] == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("channels", [3, 4])
def test_results_are_valid_json_even_of_a_perfect_match(channels: int) -> None:
    """White on white: no error, no edge, and without alpha no foreground; nan and inf are not json."""
    views = views_of(*(np.full((HEIGHT, WIDTH, channels), 255, dtype=np.uint8) for _ in range(2)))
    result = evaluate(empty_model(), to_pictures(views))
    json.dumps(result, allow_nan=False)
    assert result["psnr"] == result["psnr_pooled"] == 100
    assert result["lpips"] is None
    assert result["edge_band_psnr"] is None
    assert result["foreground_psnr"] == (None if channels == 3 else 100)


def test_a_mean_is_over_the_views_that_have_the_metric() -> None:
    """One of two views has no foreground: the other's is the mean."""
    seen = np.full((HEIGHT, WIDTH, 4), 255, dtype=np.uint8)
    seen[..., :3] = 102
    unseen = np.zeros((HEIGHT, WIDTH, 4), dtype=np.uint8)
    result = evaluate(empty_model(), to_pictures(views_of(seen, unseen)))
    assert result["foreground_psnr"] == pytest.approx(-10 * math.log10(0.36), abs=1e-4)
    assert result["background_mse"] == 0
    assert [row["name"] for row in result["images"]] == ["view 0", "view 1"]


def test_a_view_is_rendered_pixel_by_pixel_and_clipped() -> None:
    """Row-major, and each pixel from its own ray."""
    views = tiny_views(2, 5, 7)
    model = model_of(density_activation="softplus").eval()
    picture = to_pictures(views)[1]
    rendered = render_view(model, picture)
    assert rendered.shape == (5, 7, 3)
    for row, column in ((0, 0), (0, 6), (4, 0), (2, 3)):
        ray = views.cameras.to(dtype=torch.float32).pixel_rays(torch.tensor([[1, row, column]]))
        with torch.no_grad():
            expected = model(ray)["rgb_fine"][0]
        np.testing.assert_allclose(rendered[row, column], expected, atol=1e-6)
    assert len(np.unique(rendered.reshape(-1, 3).round(5), axis=0)) > 20
    error = (rendered.astype(np.float64) - composite_on(picture.image)) ** 2
    assert measure_psnr(rendered, picture, 1.0) == pytest.approx(-10 * math.log10(error.mean()))


@pytest.mark.parametrize("training", [True, False])
def test_rendering_in_chunks_changes_neither_values_nor_the_models_mode(
    training: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = model_of(density_noise=1.0, background_color="random").train(training)
    picture = to_pictures(tiny_views(1, 5, 7))[0]
    rays = picture.rays(torch.device("cpu"))
    whole = {key: render_rays(model, rays, key) for key in ("rgb_fine", "depth_fine")}
    monkeypatch.setattr(model_module, "POINTS_PER_CHUNK", {"cpu": 100})
    for key, value in whole.items():
        chunked = render_rays(model, rays, key)
        torch.testing.assert_close(chunked, value, rtol=1e-5, atol=1e-6)
        assert len(chunked) == 35
        assert not chunked.requires_grad
    assert model.training is training


def test_no_more_rays_of_a_view_are_made_than_are_rendered_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    model, picture = model_of(), to_pictures(tiny_views(1, 5, 7))[0]
    monkeypatch.setattr(model_module, "POINTS_PER_CHUNK", {"cpu": 100})
    expected, counts = render_rays(model, picture.rays(torch.device("cpu"))), []
    generate = Cameras.generate_rays
    monkeypatch.setattr(Cameras, "generate_rays", lambda *args: counts.append(len(args[2])) or generate(*args))
    rendered = render_view(model, picture)
    assert sum(counts) == 35
    assert max(counts) == model.rays_per_chunk < 35
    np.testing.assert_array_equal(rendered.reshape(-1, 3), expected.clamp(0, 1))


def test_masked_pixels_do_not_count_and_views_without_others_are_left_out() -> None:
    """White renderings of views that are white where they are known."""
    image = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    image[:, 3:] = 255
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    mask[:, 3:] = True
    pictures = to_pictures(views_of(image, image).with_masks([mask, mask & False]))
    assert [picture.name for picture in pictures] == ["view 0"]
    rendered = render_view(empty_model(), pictures[0])
    assert evaluate(empty_model(), pictures)["psnr"] == measure_psnr(rendered, pictures[0], 1.0) == 100


def test_the_callback_gets_every_view_in_order() -> None:
    views = tiny_views(3, 4, 5)
    seen: list[tuple[int, str, np.ndarray]] = []

    def each(i: int, picture: Picture, image: np.ndarray) -> None:
        seen.append((i, picture.name, image))

    result = evaluate(empty_model(), to_pictures(views), each)
    assert [(i, name) for i, name, _ in seen] == [(0, "view 0"), (1, "view 1"), (2, "view 2")]
    assert all(image.shape == (4, 5, 3) and (image == 1).all() for _, _, image in seen)
    assert len(result["images"]) == 3


def test_colors_above_one_are_clipped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounding can leave a weight sum, and so a color, a little above 1."""
    model = empty_model()

    def too_bright(rays: Any) -> dict[str, Tensor]:
        return {"rgb_fine": torch.full((len(rays), 3), 1.5)}

    monkeypatch.setattr(model, "forward", too_bright)
    picture = to_pictures(views_of(np.full((4, 4, 3), 255, dtype=np.uint8)))[0]
    rendered = render_view(model, picture)
    assert (rendered == 1).all()
    assert measure_psnr(rendered, picture, 1.0) == 100


def test_a_diverged_model_raises_instead_of_returning_nan() -> None:
    """Clipping leaves nan as it is, and nan is not json."""
    model = empty_model()
    with torch.no_grad():
        model.fine.color.bias[1] = math.nan
        model.fine.density.bias.fill_(1)
    with pytest.raises(FloatingPointError, match="not finite"):
        evaluate(model, to_pictures(tiny_views(1, 4, 4)))


def test_an_ensemble_renders_the_mean_of_its_members() -> None:
    members = [with_constant_density(model_of(), raw) for raw in (0.5, 2.0, -1.0)]
    ensemble, picture = Ensemble(members), to_pictures(tiny_views(1, HEIGHT, WIDTH))[0]
    rays = picture.rays(ensemble.device)
    for key in ("rgb_fine", "accumulation_fine", "depth_fine", "background"):
        each = torch.stack([render_rays(member, rays, key) for member in members])
        torch.testing.assert_close(render_rays(ensemble, rays, key), each.mean(dim=0))
        assert (each.std(dim=0).min() > 0.01) == (key != "background")


def test_depths_of_an_ensemble_are_before_the_background_of_its_first_member() -> None:
    """What is behind a ray is removed from it, wherever each member has it."""
    first, second = full_model(), full_model()
    second.config = replace(second.config, far=9.0)
    rays = to_pictures(tiny_views(1, HEIGHT, WIDTH))[0].rays(first.device)
    each = [render_opaque(member, rays) for member in (first, second)]
    seen = [distance * opacity for _, distance, opacity in each]
    assert 0.1 < float(each[1][2].max()) < 0.9
    _, distance, opacity = render_opaque(Ensemble([first, second]), rays)
    torch.testing.assert_close(distance * opacity, (seen[0] + seen[1]) / 2, rtol=1e-4, atol=1e-4)
