"""Off-center copies of a folder: nothing but the position differs, and the json says so."""

from __future__ import annotations

import json
import math
import os
import re
from copy import deepcopy
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from blender_folder import ANGLE, HEIGHT, WIDTH, focal_lengths, pixels, principal_points, write_json, write_scene
from test_cli_bad_input import refused

from edge_se_sampler.data.blender import SPLITS, Split, read_blender
from edge_se_sampler.data.offcenter import offcenter
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.rendering import Picture, to_pictures
from edge_se_sampler.errors import InputError

COPIES = ("centered", "shifted")
SHIFT = (0.4, -0.3)  # 2 pixels right, 1 up, of 6 x 4; padded as much, the canvas is 10 x 6
WHITE = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)


def read_json(folder: Path, split: str = "train") -> dict[str, Any]:
    return json.loads((folder / f"transforms_{split}.json").read_text())


def on_canvas(picture: np.ndarray, columns: int, rows: int, x: int, y: int, around: int = 0) -> np.ndarray:
    """What a copy should show: (H', W', ...) with the picture's corner at (x, y)."""
    canvas = np.full((rows, columns, *picture.shape[2:]), around, np.uint8)
    canvas[y : y + len(picture), x : x + picture.shape[1]] = picture
    return canvas


def copies_of(data: Path) -> list[tuple[Path, tuple[int, int]]]:
    """Both copies of a 6 x 4 scene under SHIFT, and the corner of the pictures in each."""
    return list(zip(offcenter(data, data.with_name("out"), SHIFT), ((2, 1), (4, 0)), strict=True))


def refusal(data: Path, out: Path, **arguments: Any) -> str:
    """The one line of a refusal that leaves everything beside `data` as it was."""
    before = sorted(data.parent.rglob("*"))
    with pytest.raises(InputError) as caught:
        offcenter(data, out, **arguments)
    assert sorted(data.parent.rglob("*")) == before
    assert str(caught.value).isprintable()
    return str(caught.value)


class TestPixels:
    @pytest.mark.parametrize(
        ("shift", "pad", "size", "corners"),
        [
            pytest.param(SHIFT, None, (10, 6), ((2, 1), (4, 0)), id="as much padding as shift"),
            pytest.param((-0.4, 0.3), None, (10, 6), ((2, 1), (0, 2)), id="left and down"),
            pytest.param(SHIFT, (0.5, 0.25), (12, 6), ((3, 1), (5, 0)), id="more padding"),
            pytest.param((0.1, 0.1), None, (8, 4), ((1, 0), (2, 0)), id="rounded to whole pixels"),
            pytest.param((0, 0), (0, 0), (6, 4), ((0, 0), (0, 0)), id="no shift, no padding"),
        ],
    )
    def test_every_pixel_is_kept_and_all_else_is_padding(self, shift, pad, size, corners, tmp_path: Path) -> None:
        for split in SPLITS:
            write_scene(tmp_path / "scene", split=split)
        folders = offcenter(tmp_path / "scene", tmp_path / "out", shift, pad)
        assert folders == [tmp_path / "out" / copy for copy in COPIES]
        for folder, corner in zip(folders, corners, strict=True):
            for split in SPLITS:
                for i in range(3):
                    found = iio.imread(folder / split / f"r_{i}.png")
                    np.testing.assert_array_equal(found, on_canvas(pixels(i), *size, *corner), strict=True)

    def test_copies_of_nerfs_scenes_keep_its_depths(self, tmp_path: Path) -> None:
        write_scene(tmp_path / "scene")
        copies = [copy for copy, _ in copies_of(tmp_path / "scene")]
        assert [read_blender(copy, "train").depths for copy in copies] == [(2.0, 6.0)] * 2

    def test_the_default_shift_is_the_synthetic_scenes_offset(self, tmp_path: Path) -> None:
        write_scene(tmp_path / "scene", n=1)
        iio.imwrite(tmp_path / "scene/train/r_0.png", pixels(0, 20, 20))
        _, shifted = offcenter(tmp_path / "scene", tmp_path / "out")
        found = iio.imread(shifted / "train/r_0.png")
        np.testing.assert_array_equal(found, on_canvas(pixels(0, 20, 20), 28, 26, 8, 6), strict=True)

    def test_rgb_is_padded_with_the_color_of_its_border(self, tmp_path: Path) -> None:
        write_scene(tmp_path / "scene", n=1)
        picture = WHITE.copy()
        picture[1:3, 2:5] = pixels(0)[1:3, 2:5, :3]
        iio.imwrite(tmp_path / "scene/train/r_0.png", picture)
        for folder, corner in copies_of(tmp_path / "scene"):
            expected = on_canvas(picture, 10, 6, *corner, around=255)
            np.testing.assert_array_equal(iio.imread(folder / "train/r_0.png"), expected, strict=True)

    @pytest.mark.parametrize("pixel", [(0, 0), (0, 3), (HEIGHT - 1, 2), (2, 0), (1, WIDTH - 1)])
    def test_rgb_without_a_plain_border_is_refused(self, pixel: tuple[int, int], tmp_path: Path) -> None:
        write_scene(tmp_path / "scene")
        for i in range(3):
            iio.imwrite(tmp_path / f"scene/train/r_{i}.png", WHITE)
        spoilt = WHITE.copy()
        spoilt[pixel] = 255, 254, 255
        iio.imwrite(tmp_path / "scene/train/r_1.png", spoilt)
        line = refusal(tmp_path / "scene", tmp_path / "out")
        assert "transforms_train.json: frames[1].file_path: './train/r_1.png' has no plain background" in line
        assert "RGBA" in line

    @pytest.mark.parametrize("split", ["train", "test"])
    def test_an_image_that_is_missing_is_refused(
        self, split: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        doc = write_scene(tmp_path / "scene")
        for i, frame in enumerate(doc["frames"]):
            frame["file_path"] = f"test/{i}.png"
            (tmp_path / "scene/test").mkdir(exist_ok=True)
            iio.imwrite(tmp_path / f"scene/test/{i}.png", WHITE)
        write_json(tmp_path / "scene", doc, "test")
        (tmp_path / "scene" / ("train/r_1.png" if split == "train" else "test/1.png")).unlink()
        line = refusal(tmp_path / "scene", tmp_path / "out")
        assert re.search(rf"transforms_{split}.json: frames\[1\].file_path: '.*1.png' does not exist", line)
        assert not capsys.readouterr().err

    def test_a_training_split_without_any_image_is_refused_and_another_is_said(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        doc = write_scene(tmp_path / "scene")
        write_json(tmp_path / "scene", doc, "test")
        elsewhere = deepcopy(doc)
        for frame in elsewhere["frames"]:
            frame["file_path"] = f"elsewhere/{frame['file_path']}"
        write_json(tmp_path / "scene", elsewhere)
        assert re.search(r"train.json: frames\[0\].* does not exist", refusal(tmp_path / "scene", tmp_path / "out"))
        write_json(tmp_path / "scene", doc)
        write_json(tmp_path / "scene", elsewhere, "val")
        offcenter(tmp_path / "scene", tmp_path / "out", SHIFT)
        assert not (tmp_path / "out" / "shifted" / "transforms_val.json").exists()
        assert "transforms_val.json: none of its images exists: left out" in capsys.readouterr().err

    def test_paths_written_on_windows(self, tmp_path: Path) -> None:
        doc = write_scene(tmp_path / "scene")
        for frame in doc["frames"]:
            frame["file_path"] = frame["file_path"].removeprefix("./").replace("/", "\\")
        write_json(tmp_path / "scene", doc)
        for copy, _ in copies_of(tmp_path / "scene"):
            assert sorted(path.name for path in copy.iterdir()) == ["train", "transforms_train.json"]
            assert len(read_blender(copy, "train").images) == len(doc["frames"])

    def test_masks_hide_the_padding(self, tmp_path: Path) -> None:
        doc = write_scene(tmp_path / "scene")
        mask = pixels(9, channels=3)[..., 0] & 1
        iio.imwrite(tmp_path / "scene/m.png", mask)  # 0 and 1: what is not black may be trained on
        for i in range(2):
            doc["frames"][i]["mask_path"] = "m"  # shared
        write_json(tmp_path / "scene", doc)
        for folder, corner in copies_of(tmp_path / "scene"):
            masks = read_blender(folder, "train").masks
            assert masks is not None
            for i in range(2):
                np.testing.assert_array_equal(masks[i], on_canvas(mask, 10, 6, *corner) > 0)
            assert masks[2].all()  # of a frame that has none all counts, as before
            assert iio.imread(folder / "m.png").shape == (6, 10)  # gray, as other hosts want it

    def test_masks_that_are_soft_stay_so(self, tmp_path: Path) -> None:
        doc = write_scene(tmp_path / "scene")
        mask = pixels(9, channels=3)[..., 0]
        assert len(set(mask.flatten().tolist()) - {0, 255}) > 2
        iio.imwrite(tmp_path / "scene/m.png", mask)
        for frame in doc["frames"]:
            frame["mask_path"] = "m"
        write_json(tmp_path / "scene", doc)
        for folder, corner in copies_of(tmp_path / "scene"):
            np.testing.assert_array_equal(iio.imread(folder / "m.png"), on_canvas(mask, 10, 6, *corner))

    def test_instant_ngps_masks_mean_the_same_in_the_copies(self, tmp_path: Path) -> None:
        doc = write_scene(tmp_path / "scene")
        mask = pixels(9, channels=3)[..., 0] & 1
        iio.imwrite(tmp_path / "scene/train/dynamic_mask_0.png", mask * np.uint8(255))
        doc["frames"][0]["mask_path"] = "train/dynamic_mask_0.png"
        write_json(tmp_path / "scene", doc)
        for folder, corner in copies_of(tmp_path / "scene"):
            masks = read_blender(folder, "train").masks
            assert masks is not None
            np.testing.assert_array_equal(masks[0], on_canvas(1 - mask, 10, 6, *corner) > 0)

    def test_masks_that_no_json_lists_hide_it_too(self, tmp_path: Path) -> None:
        write_scene(tmp_path / "scene")
        mask = pixels(9, channels=3)[..., 0] & 1
        (tmp_path / "scene/masks/train").mkdir(parents=True)
        iio.imwrite(tmp_path / "scene/masks/train/r_0.png.png", mask * np.uint8(255))
        for folder, corner in copies_of(tmp_path / "scene"):
            masks = read_blender(folder, "train").masks
            assert masks is not None
            np.testing.assert_array_equal(masks[0], on_canvas(mask, 10, 6, *corner) > 0)
            assert masks[1].all()


class TestCameras:
    @pytest.fixture
    def folders(self, tmp_path: Path) -> list[Path]:
        """A synthetic scene, its centered and its shifted copy."""
        scenes = make_scenes(tmp_path, ["mic"], size=20, num_train=2, num_val=1, num_test=1, placement="centered")
        return [*scenes, *offcenter(scenes[0], tmp_path / "out")]

    @staticmethod
    def seen(picture: Picture, corner: tuple[int, int]) -> dict[str, np.ndarray]:
        """Origins, directions and colors of the 20 x 20 pixels at a corner."""
        rays = picture.rays(torch.device("cpu"))
        x, y = corner
        height, width = picture.image.shape[:2]
        flat = {"origins": rays.origins.numpy(), "directions": rays.directions.numpy(), "colors": picture.image}
        return {k: v.reshape(height, width, -1)[y : y + 20, x : x + 20] for k, v in flat.items()}

    @pytest.mark.parametrize("split", SPLITS)
    def test_every_pixel_keeps_its_ray_and_its_color(self, split: Split, folders: list[Path]) -> None:
        source, *copies = [to_pictures(read_blender(folder, split)) for folder in folders]
        for pictures, corner in zip(copies, ((4, 3), (8, 6)), strict=True):
            for before, after in zip(source, pictures, strict=True):
                assert after.image.shape == (26, 28, 4)
                expected, found = self.seen(before, (0, 0)), self.seen(after, corner)
                for key in expected:
                    np.testing.assert_allclose(found[key], expected[key], rtol=0, atol=1e-6, err_msg=key)

    def test_without_cx_and_cy_the_rays_differ(self, folders: list[Path]) -> None:
        doc = read_json(folders[2])
        del doc["cx"], doc["cy"]
        write_json(folders[2], doc)
        before, after = (to_pictures(read_blender(folders[i], "train"))[0] for i in (0, 2))
        apart = self.seen(after, (8, 6))["directions"] - self.seen(before, (0, 0))["directions"]
        assert np.abs(apart).max(axis=2).min() > 0.05

    def test_focal_lengths_are_the_same_bits(self, folders: list[Path]) -> None:
        focal = focal_lengths(read_blender(folders[0], "train"))
        for folder in folders[1:]:
            np.testing.assert_array_equal(focal_lengths(read_blender(folder, "train")), focal)
            doc = read_json(folder)
            assert (doc["w"], doc["h"]) == (28, 26)
            by_angle = 0.5 * 28 / math.tan(0.5 * doc["camera_angle_x"])  # all that some loaders read
            np.testing.assert_allclose(by_angle, focal[:, 0], rtol=1e-14)

    def test_focal_lengths_and_principal_points_of_the_source(self, tmp_path: Path) -> None:
        doc = write_scene(tmp_path / "scene")
        doc |= {"fl_x": 10.1, "fl_y": 11.5, "cx": 2.5, "w": WIDTH, "h": float(HEIGHT)}
        doc["frames"][1] |= {"fl_x": 20.25, "cy": 1.75}
        doc["frames"][2] |= {"fl_y": 11.5, "cx": 2.5, "w": WIDTH}  # no other than the file's
        write_json(tmp_path / "scene", doc)
        for folder, corner in copies_of(tmp_path / "scene"):
            views = read_blender(folder, "train")
            np.testing.assert_array_equal(focal_lengths(views), [[10.1, 11.5], [20.25, 11.5], [10.1, 11.5]])
            np.testing.assert_array_equal(principal_points(views) - corner, [[2.5, 2], [2.5, 1.75], [2.5, 2]])

    @pytest.mark.parametrize("angle", ["camera_angle_x", "camera_angle_y"])
    def test_angles_of_frames_are_of_the_source_alone(self, angle: str, tmp_path: Path) -> None:
        doc = write_scene(tmp_path / "scene")
        for i in range(3):
            doc["frames"][i][angle] = 0.7
        write_json(tmp_path / "scene", doc)
        before = read_blender(tmp_path / "scene", "train")
        for folder, _ in copies_of(tmp_path / "scene"):
            np.testing.assert_allclose(focal_lengths(read_blender(folder, "train")), focal_lengths(before), rtol=1e-14)

    def test_views_of_different_sizes_get_no_common_angle(self, tmp_path: Path) -> None:
        doc = write_scene(tmp_path / "scene")
        iio.imwrite(tmp_path / "scene/train/r_1.png", pixels(7, 10, 8))
        doc["frames"][1] |= {"w": 10, "h": 8}
        write_json(tmp_path / "scene", doc)
        before = read_blender(tmp_path / "scene", "train")
        _, shifted = offcenter(tmp_path / "scene", tmp_path / "out", SHIFT)
        after = read_blender(shifted, "train")
        assert [image.shape[:2] for image in after.images] == [(6, 10), (12, 18), (6, 10)]
        np.testing.assert_array_equal(focal_lengths(after), focal_lengths(before))
        np.testing.assert_array_equal(principal_points(after) - principal_points(before), [[4, 0], [8, 0], [4, 0]])
        assert "camera_angle_x" not in read_json(shifted)


class TestJson:
    def test_order_names_poses_and_unknown_keys_are_kept(self, tmp_path: Path) -> None:
        doc = write_scene(tmp_path / "scene")
        doc |= {"aabb_scale": [4, None], "offset": "?", "frames": doc["frames"][::-1]}
        doc["frames"][0] |= {"time": {"unknown": True}, "file_path": "train/../train/r_2"}
        write_json(tmp_path / "scene", doc)
        for folder in offcenter(tmp_path / "scene", tmp_path / "out"):
            found = read_json(folder)
            new = {"w", "h", "fl_x", "fl_y", "cx", "cy"}
            assert set(found) == set(doc) | new
            assert all(found[key] == doc[key] for key in doc if key != "camera_angle_x")  # frames bit for bit
            views = read_blender(folder, "train")
            assert views.names == ("train/../train/r_2", "./train/r_1", "./train/r_0")
            assert len(views.images) == 3

    def test_a_jpeg_becomes_a_png_that_has_its_pixels(self, tmp_path: Path) -> None:
        doc = write_scene(tmp_path / "scene", n=1)
        picture = np.full((48, 48, 3), 255, np.uint8)
        picture[16:32, 16:32] = pixels(0, 16, 16, 3)  # whole blocks of the JPEG away from its border
        iio.imwrite(tmp_path / "scene/train/photo.JPG", picture, extension=".jpg")
        doc["frames"][0]["file_path"] = "train/photo.JPG"
        write_json(tmp_path / "scene", doc)
        before = read_blender(tmp_path / "scene", "train").images[0]
        centered, _ = offcenter(tmp_path / "scene", tmp_path / "out", (0.25, 0))
        assert read_json(centered)["frames"][0]["file_path"] == "train/photo.png"
        np.testing.assert_array_equal(read_blender(centered, "train").images[0][:, 12:60], before)

    def test_splits_may_share_their_images(self, tmp_path: Path) -> None:
        doc = write_scene(tmp_path / "scene")
        write_json(tmp_path / "scene", doc, "test")
        centered, _ = offcenter(tmp_path / "scene", tmp_path / "out", SHIFT)
        np.testing.assert_array_equal(
            read_blender(centered, "test").images[1], on_canvas(pixels(1), 10, 6, 2, 1), strict=True
        )

    @pytest.mark.parametrize(
        ("key", "path", "says"),
        [
            pytest.param("mask_path", "train/r_1", "over another picture, 'train/r_1.png'", id="an image as mask"),
            pytest.param("file_path", "train/r_1.jpg", "over another picture, 'train/r_1.png'", id="two to one"),
            pytest.param("file_path", "../scene/train/r_0", "leads out of the folder", id="out and in again"),
            pytest.param("file_path", "../r_0", "leads out of the folder", id="out"),
        ],
    )
    def test_paths_that_overwrite_another_picture_or_leave_the_folder_are_refused(
        self, key: str, path: str, says: str, tmp_path: Path
    ) -> None:
        doc = write_scene(tmp_path / "scene")
        os.rename(tmp_path / "scene/train/r_2.png", tmp_path / "scene/train/r_1.jpg")  # a PNG whatever its name
        doc["frames"][2]["file_path"] = "train/r_1.jpg"
        if key == "mask_path" or path.startswith(".."):
            doc["frames"].pop()
        doc["frames"][-1 if path.endswith("jpg") else 0][key] = path
        write_json(tmp_path / "scene", doc)
        assert says in refusal(tmp_path / "scene", tmp_path / "out")


class TestClipping:
    """6 x 4 pixels, shifted by 2 and -1: without padding, columns 4 and 5 and row 0 go."""

    @staticmethod
    def scene(folder: Path, *objects: tuple[slice, slice], split: Split = "train", channels: int = 4) -> None:
        """A view for each object, the rest background."""
        write_scene(folder, n=len(objects), split=split)
        for i, window in enumerate(objects):
            picture = np.full((HEIGHT, WIDTH, channels), 0 if channels == 4 else 255, np.uint8)
            picture[window] = 7
            iio.imwrite(folder / split / f"r_{i}.png", picture)

    @pytest.mark.parametrize("channels", [3, 4])
    def test_background_may_be_cut_off(self, channels: int, tmp_path: Path) -> None:
        self.scene(tmp_path / "scene", np.s_[1:3, 1:4], channels=channels)
        _, shifted = offcenter(tmp_path / "scene", tmp_path / "out", SHIFT, (0, 0))
        around = 0 if channels == 4 else 255
        expected = on_canvas(np.full((2, 3, channels), 7, np.uint8), 6, 4, 3, 0, around)
        np.testing.assert_array_equal(iio.imread(shifted / "train/r_0.png"), expected, strict=True)
        np.testing.assert_array_equal(
            principal_points(read_blender(shifted, "train")), [[WIDTH / 2 + 2, HEIGHT / 2 - 1]]
        )

    def test_an_object_that_would_be_cut_off_is_refused(self, tmp_path: Path) -> None:
        self.scene(tmp_path / "scene", np.s_[1:3, 1:4], np.s_[0:3, 1:5])
        self.scene(tmp_path / "scene", np.s_[1:3, 2:6], split="test")
        line = refusal(tmp_path / "scene", tmp_path / "out", shift=SHIFT, pad=(0, 0))
        assert "transforms_train.json: frames[1].file_path: './train/r_1.png' would lose 6 pixels" in line
        assert "(2 views would lose some)" in line
        assert "--pad 0.333333 0.25" in line  # 2 pixels for the test view, 1 for this one
        for less in ((0.16, 0.25), (0.333333, 0.1)):
            assert "would lose" in refusal(tmp_path / "scene", tmp_path / "out", shift=SHIFT, pad=less)
        offcenter(tmp_path / "scene", tmp_path / "out", SHIFT, (0.333333, 0.25))

    def test_in_rgb_other_colors_than_the_borders_are_the_object(self, tmp_path: Path) -> None:
        self.scene(tmp_path / "scene", np.s_[1:3, 1:5], channels=3)
        line = refusal(tmp_path / "scene", tmp_path / "out", shift=SHIFT, pad=(0, 0))
        assert "would lose 2 pixels" in line
        assert "--pad 0.166667 0, or" in line

    def test_faint_pixels_count_and_colors_without_alpha_do_not(self, tmp_path: Path) -> None:
        self.scene(tmp_path / "scene", np.s_[1:3, 1:4])
        picture = iio.imread(tmp_path / "scene/train/r_0.png")
        picture[0, 0] = 9, 9, 9, 0
        iio.imwrite(tmp_path / "scene/train/r_0.png", picture)
        offcenter(tmp_path / "scene", tmp_path / "out", SHIFT, (0, 0))
        picture[0, 0, 3] = 1
        iio.imwrite(tmp_path / "scene/train/r_0.png", picture)
        assert "would lose 1 pixel of" in refusal(tmp_path / "scene", tmp_path / "out2", shift=SHIFT, pad=(0, 0))


class TestOut:
    def test_existing_files_are_never_touched(self, tmp_path: Path) -> None:
        write_scene(tmp_path / "scene")
        (tmp_path / "out").mkdir()
        (tmp_path / "out/notes.txt").write_text("keep")
        (tmp_path / "file").write_text("keep")
        assert "out is there already" in refusal(tmp_path / "scene", tmp_path / "out")
        assert "scene is there already" in refusal(tmp_path / "scene", tmp_path / "scene")
        assert "file is there already" in refusal(tmp_path / "scene", tmp_path / "file")
        assert "not a folder" in refusal(tmp_path / "scene", tmp_path / "file/below")
        assert (tmp_path / "out/notes.txt").read_text() == (tmp_path / "file").read_text() == "keep"

    def test_an_empty_folder_is_filled(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        write_scene(tmp_path / "scene")
        (tmp_path / "out").mkdir()
        monkeypatch.chdir(tmp_path)
        offcenter(Path("scene"), Path("out/below/../"))
        assert sorted(path.name for path in (tmp_path / "out").iterdir()) == list(COPIES)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "scene"]

    @pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
    def test_a_failure_leaves_nothing_behind(self, error: type[BaseException], tmp_path: Path) -> None:
        write_scene(tmp_path / "scene")
        calls = []

        def fail(done: int, total: int) -> None:
            calls.append((done, total))
            if done == 2:
                assert list((tmp_path / "deep").glob(".partial-*/out/shifted/train/*.png"))  # work was under way
                assert not (tmp_path / "deep/out").exists()
                raise error

        with pytest.raises(error):
            offcenter(tmp_path / "scene", tmp_path / "deep/out", progress=fail)
        assert calls == [(1, 3), (2, 3)]
        assert [path.name for path in tmp_path.iterdir()] == ["scene"]

    def test_a_bad_split_is_found_before_anything_is_written(self, tmp_path: Path) -> None:
        write_scene(tmp_path / "scene")
        doc = write_scene(tmp_path / "scene", split="test")
        write_json(tmp_path / "scene", doc | {"camera_angle_x": -ANGLE}, "test")
        calls = []
        line = refusal(tmp_path / "scene", tmp_path / "out", progress=lambda done, total: calls.append(done))
        assert "transforms_test.json: camera_angle_x" in line
        assert not calls


class TestCommand:
    def test_both_copies_are_written_and_their_paths_printed(self, scene: Path, tmp_path: Path, edge_se) -> None:
        out = tmp_path / "out"
        answer = edge_se("offcenter", "--data", scene, "--out", out, "--shift", -0.25, 0.125, "--pad", 0.3, 0.125)
        assert (answer.code, answer.err) == (0, "")
        assert answer.out.split() == [str(out / copy) for copy in COPIES]
        pictures = {copy: iio.imread(out / copy / "val/r_0.png") for copy in COPIES}
        source = iio.imread(scene / "val/r_0.png")
        np.testing.assert_array_equal(pictures["centered"], on_canvas(source, 38, 30, 7, 3), strict=True)
        np.testing.assert_array_equal(pictures["shifted"], on_canvas(source, 38, 30, 1, 6), strict=True)

    @pytest.mark.parametrize(
        ("flags", "says"),
        [
            (("--shift", "nan", 0), "shift is (nan, 0.0)"),
            (("--shift", 0, 1), "between -1 and 1"),
            (("--shift", -1.5, 0), "between -1 and 1"),
            (("--shift", "inf", 0), "between -1 and 1"),
            (("--pad", -0.1, 0), "from 0 to 1"),
            (("--pad", "nan", 0), "from 0 to 1"),
            (("--pad", 0, 1e9), "from 0 to 1"),
            (("--pad", 0, 0, "--shift", 0.5, 0), "would lose"),
            (("--out", "scene"), "is there already"),
            (("--data", "nowhere"), "no such folder"),
            (("--data", "."), "has no transforms_train.json"),
        ],
    )
    def test_bad_input(self, flags, says: str, scene: Path, tmp_path: Path, edge_se, monkeypatch) -> None:
        monkeypatch.chdir(tmp_path)
        before = sorted(tmp_path.rglob("*"))
        assert says in refused(edge_se, tmp_path, "offcenter", "--data", scene, "--out", "out", *flags)
        assert sorted(tmp_path.rglob("*")) == before
