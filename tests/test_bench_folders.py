"""Copies of scenes for programs that read only folders: the views of the scene itself, whatever its format."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from blender_folder import write_scene
from capture_folder import HEIGHT, OPENCV, WIDTH, write_colmap, write_transforms

from edge_se_sampler.bench.baselines.folders import copied_scene
from edge_se_sampler.bench.baselines.run import mean_psnr, read_test_pictures
from edge_se_sampler.bench.train import offcenter_copies
from edge_se_sampler.data.capture import SPLITS
from edge_se_sampler.data.dataset import DataSettings, find_format, read_split
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.metrics import composite_on


def read(folder: Path, split: str, downscale: int = 1) -> Views:
    views = read_split(folder, split, DataSettings(downscale=downscale))  # type: ignore[arg-type]
    assert views is not None
    return views


def assert_same_views(found: Views, expected: Views) -> None:
    assert len(found.images) == len(expected.images)
    for i, image in enumerate(expected.images):
        np.testing.assert_array_equal(found.images[i], image)
        rays, own = (views.cameras.image_rays(i) for views in (found, expected))
        torch.testing.assert_close(rays.origins, own.origins)
        torch.testing.assert_close(rays.directions, own.directions)


@pytest.mark.parametrize("made", [copied_scene, lambda workplace, data, _: offcenter_copies(data, workplace)])
def test_a_copy_that_another_process_makes_meanwhile_is_taken(
    made: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_scene(tmp_path / "scene")
    expected = made(tmp_path / "workplace", tmp_path / "scene", 1)
    file = next(path for path in expected.rglob("*") if path.is_file())
    answers = iter([False])  # of the question whether it is there, before it is made
    exists = Path.exists
    monkeypatch.setattr(Path, "exists", lambda path: next(answers, True) if path == expected else exists(path))
    before = file.read_bytes()
    assert made(tmp_path / "workplace", tmp_path / "scene", 1) == expected
    assert file.read_bytes() == before


def test_a_blender_folder_stays_one(tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    for split, count in zip(SPLITS, (3, 1, 12), strict=True):
        write_scene(scene, count, split)
    copy = copied_scene(tmp_path / "work", scene, downscale=2)
    assert find_format(copy) == "blender"
    for split in SPLITS:
        found = read(copy, split)
        assert_same_views(found, read(scene, split, downscale=2))
        assert found.depths == (2, 6)
        top = json.loads((copy / f"transforms_{split}.json").read_text())
        paths = [frame["file_path"] for frame in top["frames"]]
        assert paths == sorted(paths)  # of more than ten, too
        # as NeRF's programs read it: no suffix, and an angle that says all
        assert (copy / f"{paths[0]}.png").exists()
        assert float(found.cameras.fx[0]) == pytest.approx(3 / 2 / np.tan(top["camera_angle_x"] / 2))
    marker = copy / "kept"
    marker.touch()
    assert copied_scene(tmp_path / "work", scene, downscale=2) == copy
    assert marker.exists()  # it is not written again
    assert copied_scene(tmp_path / "work", scene, downscale=1) != copy


@pytest.mark.parametrize("write", [write_transforms, write_colmap])
def test_a_capture_becomes_a_list_of_undistorted_images(write: Callable[..., Any], tmp_path: Path) -> None:
    write(tmp_path / "scene", OPENCV)
    copy = copied_scene(tmp_path / "work", tmp_path / "scene", downscale=2)
    top = json.loads((copy / "transforms.json").read_text())
    assert (len(top["train_filenames"]), len(top["test_filenames"])) == (7, 2)  # every eighth of 9
    # programs that sort files by name keep each split's order
    assert sorted(frame["file_path"] for frame in top["frames"]) == top["test_filenames"] + top["train_filenames"]
    for split in ("train", "test"):
        assert_same_views(read(copy, split), read(tmp_path / "scene", split, downscale=2))
    assert read_split(copy, "val") is None  # it would be the test views again


def test_what_is_unknown_stays_so_and_is_not_measured(tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    document = write_transforms(scene)
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    mask[:, :20] = 255
    iio.imwrite(scene / "mask.png", mask)
    document["frames"][0]["mask_path"] = "mask.png"  # of the first held-out view alone
    (scene / "transforms.json").write_text(json.dumps(document))
    copy = copied_scene(tmp_path / "work", scene, downscale=2)
    top = json.loads((copy / "transforms.json").read_text())
    assert all("mask_path" in frame for frame in top["frames"])  # nerfstudio wants one of all frames, or of none
    found, expected = read(copy, "test"), read(scene, "test", downscale=2)
    assert found.masks is not None
    assert expected.masks is not None
    np.testing.assert_array_equal(found.masks, expected.masks)
    rendered = [composite_on(picture.image) for picture in read_test_pictures(copy)]
    rendered[0][:, 10:] = 0.5
    assert mean_psnr(rendered, copy) == 100  # whatever is rendered there
    rendered[0][:, :10] *= 0.9
    assert mean_psnr(rendered, copy) < 80


def test_off_center_scenes_are_no_blender_folders(tmp_path: Path) -> None:
    """Programs that know an angle alone would train on other rays."""
    for split in ("train", "test"):
        document = write_scene(tmp_path / "scene", 2, split)
        (tmp_path / "scene" / f"transforms_{split}.json").write_text(json.dumps(document | {"cx": 2.5}))
    copy = copied_scene(tmp_path / "work", tmp_path / "scene", downscale=2)
    assert find_format(copy) == "transforms"
    assert_same_views(read(copy, "test"), read(tmp_path / "scene", "test", downscale=2))
