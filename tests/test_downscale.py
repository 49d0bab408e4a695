"""Averages over squares of pixels, and the cameras that would have taken them."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from blender_folder import write_json, write_scene
from tiny import SMALL, tiny_views

from edge_se_sampler.cli import main
from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.data.downscale import average_pixels, shrink_mask
from edge_se_sampler.engine.metrics import composite_on
from edge_se_sampler.engine.session import read_test_views, read_train_views
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs
from edge_se_sampler.sampling.edges import unit_float


def test_colors_are_averaged_by_their_alpha() -> None:
    image = np.zeros((2, 2, 4), dtype=np.uint8)
    image[0, 0] = (200, 0, 0, 255)
    image[0, 1] = (0, 100, 0, 51)
    image[1] = (255, 255, 255, 0)  # transparent: its white must not show
    # (200 * 255, 100 * 51) / (255 + 51), and 306 / 4
    np.testing.assert_array_equal(average_pixels(image, 2), [[[167, 17, 0, 76]]])
    assert not average_pixels(np.full((2, 2, 4), (9, 9, 9, 0), dtype=np.uint8), 2).any()


def test_compositing_and_averaging_may_change_places() -> None:
    image = np.random.default_rng(0).integers(0, 256, (12, 20, 4), dtype=np.uint8)
    before = composite_on(unit_float(image)).reshape(3, 4, 5, 4, 3).mean(axis=(1, 3))
    after = composite_on(unit_float(average_pixels(image, 4)))
    np.testing.assert_allclose(after, before, atol=1.5 / 255)
    straight = image.reshape(3, 4, 5, 4, 4).mean(axis=(1, 3)).round().astype(np.uint8)  # the control
    assert np.abs(composite_on(unit_float(straight)) - before).max() > 0.02


def test_opaque_images_are_averaged_and_the_rest_is_cut_off() -> None:
    image = np.random.default_rng(0).integers(0, 256, (7, 8, 3), dtype=np.uint8)
    small = average_pixels(image, 3)
    assert small.shape == (2, 2, 3)
    np.testing.assert_array_equal(small[1, 0], np.rint(image[3:6, :3].mean(axis=(0, 1))).astype(np.uint8))


@pytest.mark.parametrize("channels", [3, 4])
def test_white_stays_white_however_many_pixels_become_one(channels: int) -> None:
    white = np.full((1000, 500, channels), 255, np.uint8)
    assert (average_pixels(white, 500) == 255).all()


def test_a_small_pixel_is_trained_on_if_all_of_it_is() -> None:
    mask = np.ones((8, 6), dtype=bool)
    mask[3, 4] = False
    np.testing.assert_array_equal(np.argwhere(~shrink_mask(mask, 2)), [[1, 2]])


def test_a_small_pixels_ray_goes_through_the_middle_of_its_pixels() -> None:
    views = tiny_views(2, height=9, width=6)
    views = replace(views, cameras=replace(views.cameras, cx=views.cameras.cx + 0.7))
    small = views.cameras.downscale(3)
    assert (int(small.height[0]), int(small.width[0])) == average_pixels(views.images[0], 3).shape[:2] == (3, 2)
    ray = small.pixel_rays(torch.tensor([[1, 2, 1]]))
    middle = views.cameras.pixel_rays(torch.tensor([[1, 7, 4]]))  # of rows 6 to 8 and columns 3 to 5
    torch.testing.assert_close(ray.directions, middle.directions)
    torch.testing.assert_close(ray.origins, middle.origins)


def test_training_and_held_out_views_are_scaled_alike(tmp_path: Path) -> None:
    for split in ("train", "test"):
        write_scene(tmp_path / "scene", split=split)
    config = replace(method_configs()["vanilla-nerf"], data=tmp_path / "scene", downscale=2, views=(2, 0))
    whole = read_blender(tmp_path / "scene", "train")
    train, test = read_train_views(config), read_test_views(config)
    assert {image.shape[:2] for image in (*train.images, *test.images)} == {(2, 3)}
    np.testing.assert_array_equal(train.images[0], average_pixels(whole.images[2], 2))
    torch.testing.assert_close(train.cameras.fx, whole.cameras.fx[[2, 0]] / 2)


@pytest.mark.parametrize("factor", [0, -2, 5])
def test_a_factor_that_leaves_no_pixel_is_refused(tmp_path: Path, factor: int) -> None:
    write_scene(tmp_path)
    config = replace(method_configs()["vanilla-nerf"], data=tmp_path, downscale=factor)
    with pytest.raises(InputError, match=f"--downscale is {factor}"):
        read_train_views(config)


def test_a_run_is_evaluated_at_the_size_that_it_was_trained_at(tmp_path: Path) -> None:
    for split in ("train", "test"):
        doc = write_scene(tmp_path / "scene", split=split)
        for i, frame in enumerate(doc["frames"]):
            frame["transform_matrix"] = np.eye(4).tolist()
            frame["transform_matrix"][2][3] = 4.0 + i / 10
        write_json(tmp_path / "scene", doc, split)
    flags = ["--data", str(tmp_path / "scene"), "--output-dir", str(tmp_path / "out"), "--downscale", "2", *SMALL]
    assert main(["train", "vanilla-nerf", *flags]) in (0, None)
    (run,) = (tmp_path / "out" / "scene" / "vanilla-nerf").iterdir()
    assert json.loads((run / "config.json").read_text())["downscale"] == 2
    results, pictures = tmp_path / "eval.json", tmp_path / "pictures"
    assert main(["eval", str(run), "--output-path", str(results), "--render-output-path", str(pictures)]) in (0, None)
    import imageio.v3 as iio

    assert iio.imread(pictures / "0000.png").shape == (2, 2 * 3, 3)  # the truth beside the rendering


@pytest.mark.slow
@pytest.mark.skipif("EDGE_SE_SCENES" not in os.environ, reason="EDGE_SE_SCENES names no folder of real scenes")
def test_a_real_scene_is_scaled_down() -> None:
    scene = Path(os.environ["EDGE_SE_SCENES"]) / "lego"
    config = replace(method_configs()["lean-nerf"], data=scene, downscale=8, views=(0,))
    views, whole = read_train_views(config), replace(config, downscale=1)
    assert views.images[0].shape == (100, 100, 4)
    large = composite_on(unit_float(read_train_views(whole).images[0]))
    small = composite_on(unit_float(views.images[0]))
    np.testing.assert_allclose(small, large.reshape(100, 8, 100, 8, 3).mean(axis=(1, 3)), atol=1.5 / 255)
