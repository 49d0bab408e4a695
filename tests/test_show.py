"""edge-se show: the probabilities that it draws, and the figure."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from capture_folder import NAMES, bounds, write_llff
from tiny import tiny_views

from edge_se_sampler.data.datamanager import image_batch
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.show import probability_map, show
from edge_se_sampler.errors import InputError
from edge_se_sampler.sampling.edges import edge_strength
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.registry import PIXEL_STRATEGIES
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig

HEIGHT, WIDTH = 16, 12
MASKS = tuple(np.random.default_rng(i).random((HEIGHT, WIDTH)) < share for i, share in enumerate((0.5, 0.1, 0.0)))
STRATEGIES = ("uniform", "precrop", "edge")


def probability(views: Views, strategy: str, k: int) -> np.ndarray:
    distribution = PIXEL_STRATEGIES[strategy].load()(EdgeSEPixelSamplerConfig())
    return probability_map(distribution, ImageBatch.of(image_batch(views), use_mask=True), k)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_probabilities_sum_to_one(strategy: str) -> None:
    p = probability(tiny_views(3, HEIGHT, WIDTH), strategy, 1)
    assert p.shape == (HEIGHT, WIDTH)
    assert p.min() >= 0
    assert p.sum() == pytest.approx(1, abs=1e-9)


def test_probabilities_of_each_strategy() -> None:
    views = tiny_views(3, HEIGHT, WIDTH)
    np.testing.assert_allclose(probability(views, "uniform", 0), 1 / (HEIGHT * WIDTH), rtol=1e-6)
    box = np.zeros((HEIGHT, WIDTH))
    box[4:12, 3:9] = 1 / 48
    np.testing.assert_allclose(probability(views, "precrop", 0), box, rtol=1e-6)
    strength = edge_strength(views.images[2]) + 0.01
    np.testing.assert_allclose(probability(views, "edge", 2), strength / strength.sum(), rtol=1e-4)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_masked_pixels_have_none(strategy: str) -> None:
    views = tiny_views(3, HEIGHT, WIDTH, masks=MASKS)
    free = [probability(replace(views, masks=None), strategy, k) for k in range(3)]
    for k, mask in enumerate(MASKS[:2]):
        p = probability(views, strategy, k)
        np.testing.assert_array_equal(p > 0, mask & (free[k] > 0))
        np.testing.assert_allclose(p[mask], free[k][mask] / free[k][mask].sum(), rtol=1e-6)
    assert not probability(views, strategy, 2).any()


def draw(path: Path, views: Views, strategy: str = "edge", num_views: int = 2, **settings: Any) -> np.ndarray:
    show(views, EdgeSEPixelSamplerConfig(num_rays_per_batch=40, **settings), strategy, path, num_views, seed=0)
    return iio.imread(path)


def test_the_png_has_a_row_for_each_view(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    views = tiny_views(5, HEIGHT, WIDTH, masks=(*MASKS, MASKS[0], MASKS[1]))
    one, three = (draw(tmp_path / f"{n}.png", views, num_views=n) for n in (1, 3))
    assert one.shape[1] == three.shape[1] == 9.6 * 120
    assert three.shape[0] == pytest.approx(3 * one.shape[0], abs=3)
    assert (tmp_path / "1.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    rows = np.array_split(three[..., :3], 3)
    for left in range(3):  # a picture in each of the columns of each row
        for row in rows[:2] if left == 2 else rows:
            assert row[:, left * 384 : (left + 1) * 384].std() > 20
    assert sorted(file.name for file in tmp_path.iterdir()) == ["1.png", "3.png"]


def red_dots(picture: np.ndarray) -> np.ndarray:
    """(H, W) bool: where the figure has the red of drawn pixels, in the right third."""
    red, green, blue = np.moveaxis(picture[..., :3].astype(int), -1, 0)
    dots = (red - green > 100) & (red - blue > 100)
    dots[:, : picture.shape[1] * 2 // 3] = False
    return dots


def test_drawn_pixels_lie_where_the_probability_is(tmp_path: Path) -> None:
    """One valid corner: dots in the top left of the third column; all masked: no dot at all, and no failure."""
    pytest.importorskip("matplotlib")
    corner = np.zeros((HEIGHT, WIDTH), bool)
    corner[:2, :2] = True
    views = tiny_views(1, HEIGHT, WIDTH, masks=(corner,))
    rows, columns = np.nonzero(red_dots(draw(tmp_path / "corner.png", views)))
    everywhere = np.nonzero(red_dots(draw(tmp_path / "all.png", replace(views, masks=None))))
    assert rows.max() - rows.min() < np.ptp(everywhere[0]) / 3
    assert columns.max() - columns.min() < np.ptp(everywhere[1]) / 3
    assert rows.min() <= everywhere[0].min() + 5
    assert columns.min() <= everywhere[1].min() + 5
    masked = replace(views, masks=(np.zeros((HEIGHT, WIDTH), bool),))
    assert not red_dots(draw(tmp_path / "masked.png", masked)).any()


def test_the_same_seed_draws_the_same_picture_and_no_global_generator_is_touched(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    state = torch.get_rng_state()
    views = tiny_views(2, HEIGHT, WIDTH)
    first, second = (draw(tmp_path / f"{i}.png", views) for i in range(2))
    np.testing.assert_array_equal(first, second)
    assert torch.equal(torch.get_rng_state(), state)
    show(views, EdgeSEPixelSamplerConfig(num_rays_per_batch=40), "edge", tmp_path / "other.png", 2, seed=1)
    assert (iio.imread(tmp_path / "other.png") != first).any()


def test_alpha_edges_without_alpha_are_refused_with_the_views_name(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    with pytest.raises(InputError, match=r"view 0': .*alpha"):
        draw(tmp_path / "x.png", tiny_views(1, HEIGHT, WIDTH, channels=3), edge_source="alpha")
    assert not list(tmp_path.iterdir())


def test_a_name_that_is_no_utf_8_is_shown(tmp_path: Path, edge_se: Any) -> None:
    write_llff(tmp_path / "scene", bounds())
    first = tmp_path / "scene" / "images" / NAMES[1]
    first.rename(Path(os.fsdecode(os.fsencode(first.with_suffix("")) + b"\xe9.png")))
    for command in ("show", "inspect"):
        answer = edge_se(command, "--data", tmp_path / "scene", "--output-path", tmp_path / f"{command}.png")
        assert answer.code == 0, answer
        assert (tmp_path / f"{command}.png").exists()


def test_without_matplotlib_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(InputError, match=r"edge-se-sampler\[plots\]"):
        draw(tmp_path / "x.png", tiny_views(1, HEIGHT, WIDTH))
