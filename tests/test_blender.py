"""Blender folders as they should be: what read_blender makes of them."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from blender_folder import (
    ANGLE,
    HEIGHT,
    WIDTH,
    chunk,
    focal_lengths,
    pixels,
    png,
    pose,
    principal_points,
    write_json,
    write_scene,
)

from edge_se_sampler.data.blender import has_split, read_blender
from edge_se_sampler.data.dataset import list_frames, read_split
from edge_se_sampler.errors import InputError


@pytest.fixture
def doc(tmp_path: Path) -> dict[str, Any]:
    return write_scene(tmp_path)


def test_pixels_names_and_poses_are_those_on_disk(tmp_path: Path, doc: dict[str, Any]) -> None:
    views = read_blender(tmp_path, "train")
    assert views.names == ("./train/r_0", "./train/r_1", "./train/r_2")
    assert views.masks is None
    for i, image in enumerate(views.images):
        assert image.dtype == np.uint8
        np.testing.assert_array_equal(image, pixels(i))  # alpha straight: colors under alpha 0 too
    assert views.cameras.camera_to_worlds.dtype == torch.float64
    expected = [frame["transform_matrix"][:3] for frame in doc["frames"]]
    np.testing.assert_array_equal(views.cameras.camera_to_worlds, expected)  # every bit of the doubles


def test_focal_length_from_the_angle_of_view(tmp_path: Path, doc: dict[str, Any]) -> None:
    views = read_blender(tmp_path, "train")
    assert focal_lengths(views).shape == principal_points(views).shape == (3, 2)
    assert focal_lengths(views).dtype == principal_points(views).dtype == np.float64
    np.testing.assert_allclose(focal_lengths(views), 0.5 * WIDTH / math.tan(0.5 * ANGLE), rtol=1e-15)
    np.testing.assert_array_equal(principal_points(views), [[WIDTH / 2, HEIGHT / 2]] * 3)


def test_the_known_focal_of_nerf_synthetic(tmp_path: Path, doc: dict[str, Any]) -> None:
    for i in range(3):
        iio.imwrite(tmp_path / f"train/r_{i}.png", np.zeros((2, 800, 3), np.uint8))
    np.testing.assert_allclose(focal_lengths(read_blender(tmp_path, "train")), 1111.1110311937682, rtol=1e-12)


def test_focal_lengths_in_pixels_override_the_angle_and_a_frame_overrides_the_file(
    tmp_path: Path, doc: dict[str, Any]
) -> None:
    doc |= {"fl_x": 10, "fl_y": 11.5, "cx": 2.5, "cy": -1}
    doc["frames"][1] |= {"fl_x": 20.25, "cy": 1.75}
    write_json(tmp_path, doc)
    views = read_blender(tmp_path, "train")
    np.testing.assert_array_equal(focal_lengths(views), [[10, 11.5], [20.25, 11.5], [10, 11.5]])
    np.testing.assert_array_equal(principal_points(views), [[2.5, -1], [2.5, 1.75], [2.5, -1]])


def test_the_angle_is_optional_if_every_frame_has_fl_x(tmp_path: Path, doc: dict[str, Any]) -> None:
    del doc["camera_angle_x"]
    for i, frame in enumerate(doc["frames"]):
        frame["fl_x"] = i + 1
    write_json(tmp_path, doc)
    np.testing.assert_array_equal(focal_lengths(read_blender(tmp_path, "train")), [[1, 1], [2, 2], [3, 3]])


def test_sizes_may_differ_where_frames_state_them(tmp_path: Path, doc: dict[str, Any]) -> None:
    iio.imwrite(tmp_path / "train/r_1.png", pixels(7, 3, 5, 3))
    doc |= {"w": WIDTH, "h": float(HEIGHT)}  # instant-ngp's tools write 4.0
    doc["frames"][1] |= {"w": 3, "h": 5}
    write_json(tmp_path, doc)
    views = read_blender(tmp_path, "train")
    np.testing.assert_array_equal(views.images[1], pixels(7, 3, 5, 3))
    np.testing.assert_allclose(focal_lengths(views)[:, 0] / [WIDTH, 3, WIDTH], 0.5 / math.tan(0.5 * ANGLE))
    np.testing.assert_array_equal(principal_points(views)[1], [1.5, 2.5])


def test_masks_are_true_where_not_black_and_whole_where_missing(tmp_path: Path, doc: dict[str, Any]) -> None:
    gray = np.zeros((HEIGHT, WIDTH), np.uint8)
    gray[1, 2], gray[0, 0] = 255, 1
    opaque = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    opaque[..., 3] = 255  # black all over
    iio.imwrite(tmp_path / "m_0.png", gray)
    iio.imwrite(tmp_path / "m_1.png", opaque)
    for i in range(2):
        doc["frames"][i]["mask_path"] = f"m_{i}.png"
    write_json(tmp_path, doc)
    masks = read_blender(tmp_path, "train").masks
    assert masks is not None
    assert all(mask.dtype == bool for mask in masks)
    np.testing.assert_array_equal(masks[0], gray != 0)
    assert not masks[1].any()
    assert masks[2].shape == (HEIGHT, WIDTH)
    assert masks[2].all()


def one_view(folder: Path, data: bytes) -> np.ndarray:
    """The pixels that a file of these bytes is read as."""
    write_scene(folder, n=1)
    (folder / "train/r_0.png").write_bytes(data)
    return read_blender(folder, "train").images[0]


PALETTE = chunk(b"PLTE", bytes([10, 20, 30, 40, 50, 60]))  # colors 0 and 1
RGB_ROW = b"\0\1\2\3\4\5\6"  # the filter, then two pixels
TWO_COLORS = [[[10, 20, 30], [40, 50, 60]]]


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        pytest.param(png(2, 1, 8, 0, b"\0\x07\xff"), [[[7] * 3, [255] * 3]], id="gray"),
        pytest.param(png(2, 1, 1, 0, b"\0\x40"), [[[0] * 3, [255] * 3]], id="one bit"),
        pytest.param(png(2, 1, 8, 4, b"\0\x07\x08\x09\x0a"), [[[7, 7, 7, 8], [9, 9, 9, 10]]], id="gray and alpha"),
        pytest.param(png(2, 1, 8, 3, b"\0\0\1", PALETTE), TWO_COLORS, id="palette"),
        pytest.param(png(2, 1, 1, 3, b"\0\x40", PALETTE), TWO_COLORS, id="palette of one bit"),
        pytest.param(
            png(2, 1, 8, 3, b"\0\0\1", PALETTE + chunk(b"tRNS", b"\x80")),
            [[[10, 20, 30, 128], [40, 50, 60, 255]]],
            id="palette with alpha",
        ),
        pytest.param(
            png(2, 1, 8, 2, RGB_ROW, chunk(b"tRNS", b"\0\1\0\2\0\3")),
            [[[1, 2, 3, 0], [4, 5, 6, 255]]],
            id="one transparent color",
        ),
        pytest.param(png(2, 1, 8, 2, RGB_ROW, chunk(b"gAMA", b"\0\0\0\x64")), [[[1, 2, 3], [4, 5, 6]]], id="gamma"),
        pytest.param(png(2, 1, 8, 2, RGB_ROW) + b"more", [[[1, 2, 3], [4, 5, 6]]], id="bytes after the end"),
    ],
)
def test_pixels_of_every_kind_of_png(tmp_path: Path, data: bytes, expected: list[list[list[int]]]) -> None:
    image = one_view(tmp_path, data)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, expected)


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg", ".JPG", ".png"])
def test_a_path_may_have_its_suffix(tmp_path: Path, suffix: str) -> None:
    doc = write_scene(tmp_path, n=1)
    path = tmp_path / f"train/photo.v2{suffix}"
    iio.imwrite(path, pixels(0, channels=3))
    doc["frames"][0]["file_path"] = f"train/photo.v2{suffix}"
    write_json(tmp_path, doc)
    np.testing.assert_array_equal(read_blender(tmp_path, "train").images[0], iio.imread(path))


def test_a_dot_in_the_name_is_no_suffix(tmp_path: Path) -> None:
    doc = write_scene(tmp_path, n=1)
    (tmp_path / "train/r_0.png").rename(tmp_path / "train/r_0.5.png")
    doc["frames"][0]["file_path"] = "train/r_0.5"
    write_json(tmp_path, doc)
    np.testing.assert_array_equal(read_blender(tmp_path, "train").images[0], pixels(0))


def test_a_hundred_views_keep_the_order_of_the_json(tmp_path: Path) -> None:
    doc = write_scene(tmp_path, n=100)
    order = np.random.default_rng(0).permutation(100)
    doc["frames"] = [doc["frames"][i] for i in order]
    write_json(tmp_path, doc)
    views = read_blender(tmp_path, "train")
    assert views.names == tuple(f"./train/r_{i}" for i in order)
    for i, image, matrix in zip(order, views.images, views.cameras.camera_to_worlds, strict=True):
        np.testing.assert_array_equal(image, pixels(i))
        np.testing.assert_array_equal(matrix, pose(i)[:3])


def test_files_that_no_frame_lists_are_ignored(tmp_path: Path) -> None:
    doc = write_scene(tmp_path, split="test")
    (tmp_path / "test/r_0_depth_0001.png").write_bytes(b"no image")
    (tmp_path / "test/r_0_normal_0001.png").mkdir()
    doc |= {"aabb_scale": [4, None], "offset": "?"}
    doc["frames"][0]["time"] = {"unknown": True}
    write_json(tmp_path, doc, "test")
    assert len(read_blender(tmp_path, "test").images) == 3


@pytest.mark.parametrize("level", ["file", "frame"])
def test_lens_distortion_is_undone_unless_it_is_zero(level: str, tmp_path: Path) -> None:
    doc = write_scene(tmp_path, split="test")
    parent = doc if level == "file" else doc["frames"][1]
    parent |= {"k1": 0, "p2": 0.0}
    write_json(tmp_path, doc, "test")
    np.testing.assert_array_equal(read_blender(tmp_path, "test").images[1], pixels(1))
    parent["k1"] = 0.3
    write_json(tmp_path, doc, "test")
    assert (read_blender(tmp_path, "test").images[1] != pixels(1)).any()


def test_rounded_poses_are_kept_as_written(tmp_path: Path, doc: dict[str, Any]) -> None:
    for frame in doc["frames"]:
        frame["transform_matrix"] = np.round(frame["transform_matrix"], 4).tolist()
    write_json(tmp_path, doc)
    expected = [frame["transform_matrix"][:3] for frame in doc["frames"]]
    np.testing.assert_array_equal(read_blender(tmp_path, "train").cameras.camera_to_worlds, expected)


def test_links_inside_the_folder_and_to_the_folder_are_followed(tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    doc = write_scene(scene)
    os.symlink("r_0.png", scene / "train/link.png")
    doc["frames"][0]["file_path"] = "train/../train/link"
    write_json(scene, doc)
    os.symlink("scene", tmp_path / "by_link")
    np.testing.assert_array_equal(read_blender(tmp_path / "by_link", "train").images[0], pixels(0))


def test_a_byte_order_mark_is_skipped(tmp_path: Path, doc: dict[str, Any]) -> None:
    (tmp_path / "transforms_train.json").write_text(json.dumps(doc), encoding="utf-8-sig")
    assert len(read_blender(tmp_path, "train").names) == 3


@pytest.mark.parametrize("frames", ["of images", "none"])
def test_a_held_out_split_that_nobody_rendered_is_left_out(
    frames: str, tmp_path: Path, doc: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    """As Blender's add-ons write one: cameras without images, or an empty list."""
    listed = [frame | {"file_path": f"test/{i:04}.png"} for i, frame in enumerate(doc["frames"])]
    write_json(tmp_path, doc | {"frames": listed if frames == "of images" else []}, "test")
    assert read_split(tmp_path, "test") is None
    assert "transforms_test.json: none of its images exists: left out" in capsys.readouterr().err
    assert list_frames(tmp_path, "test") == []
    (tmp_path / "test").mkdir()
    iio.imwrite(tmp_path / "test/0001.png", pixels(1))
    if frames == "of images":  # then the others are missing
        with pytest.raises(InputError, match="frames: 2 of the 3 listed images do not exist"):
            read_split(tmp_path, "test")
        iio.imwrite(tmp_path / "test/0002.png", pixels(2))
        views = read_split(tmp_path, "test")
        assert views is not None
        assert views.names == ("test/0001.png", "test/0002.png")
        assert "1 of the 3 listed images do not exist, 'test/0000.png' for one: left out" in capsys.readouterr().err


def test_held_out_images_that_are_trained_on_are_said(
    tmp_path: Path, doc: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    write_json(tmp_path, doc | {"frames": doc["frames"][:1]}, "test")
    assert read_split(tmp_path, "test") is not None
    assert "1 of 1 images are in transforms_train.json, too, './train/r_0.png' for one" in capsys.readouterr().err
    read_split(tmp_path, "train")
    assert not capsys.readouterr().err


def test_a_training_split_without_images_is_an_error(tmp_path: Path, doc: dict[str, Any]) -> None:
    write_json(tmp_path, doc | {"frames": []})
    with pytest.raises(InputError, match="frames: is empty"):
        read_split(tmp_path, "train")


def test_has_split(tmp_path: Path, doc: dict[str, Any]) -> None:
    assert has_split(tmp_path, "train")
    assert not has_split(tmp_path, "val")
    assert not has_split(tmp_path / "nowhere", "train")
