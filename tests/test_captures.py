"""Captures as they should be: every format, the same rays; lenses against OpenCV; lists, and what is held out."""

from __future__ import annotations

import json
import shutil
from itertools import product
from pathlib import Path
from typing import Any

import capture_folder
import cv2
import imageio.v3 as iio
import numpy as np
import pytest
import torch
from capture_folder import (
    COLUMN_STEP,
    COUNT,
    CX,
    CY,
    FISHEYE,
    FX,
    FY,
    HEIGHT,
    NAMES,
    OPENCV,
    PINHOLE,
    ROW_STEP,
    SQUARE_PIXELS,
    WIDTH,
    Distortion,
    bounds,
    colmap_files,
    picture,
    points,
    poses,
    read,
    write_blender,
    write_colmap,
    write_images,
    write_llff,
    write_transforms,
)
from tiny import SMALL

from edge_se_sampler.data.capture import Capture
from edge_se_sampler.data.colmap import is_scaled, read_colmap
from edge_se_sampler.data.dataset import find_format, read_split
from edge_se_sampler.data.image_file import ImageHeader
from edge_se_sampler.data.lens import find_sources
from edge_se_sampler.data.transforms import read_transforms
from edge_se_sampler.errors import InputError

HELD_OUT = [0, 8]


def project_by_opencv(distortion: Distortion, view: int, world: np.ndarray) -> np.ndarray:
    """(m, 2) x, y where OpenCV sees points (m, 3), its pixels' centers being whole numbers."""
    pose = poses()[view]
    rotation = (pose[:3, :3] * (1, -1, -1)).T
    turn, shift = cv2.Rodrigues(rotation)[0], -rotation @ pose[:3, 3]
    matrix = np.array([[FX, 0, CX - 0.5], [0, FX if distortion.model in SQUARE_PIXELS else FY, CY - 0.5], [0, 0, 1]])
    terms = np.array(list(distortion.terms.values()))
    if distortion.model == "OPENCV_FISHEYE":
        return cv2.fisheye.projectPoints(world[:, None], turn, shift, matrix, terms)[0][:, 0]
    terms = np.concatenate((terms, np.zeros(4)))[:4] if distortion.model in SQUARE_PIXELS else terms
    return cv2.projectPoints(world, turn, shift, matrix, terms)[0][:, 0]


def write_and_list(folder: Path, kind: str, distortion: Distortion) -> Capture:
    if kind == "transforms":
        write_transforms(folder, distortion)
        return read_transforms(folder)
    write_colmap(folder, distortion, text=kind == "text")
    return read_colmap(folder)


RADIAL = [  # of COLMAP: a transforms.json states both focal lengths
    Distortion("SIMPLE_RADIAL", {"k1": 0.1}),
    Distortion("RADIAL", {"k1": 0.1, "k2": -0.05}),
]


@pytest.mark.parametrize(
    ("kind", "distortion"),
    [*product(("transforms", "binary", "text"), (OPENCV, FISHEYE)), *product(("binary", "text"), RADIAL)],
)
def test_lenses_are_opencvs(kind: str, distortion: Distortion, tmp_path: Path) -> None:
    """Where an undistorted pixel's ray goes, OpenCV sees the source of that pixel, to 1e-4 of one."""
    frames = write_and_list(tmp_path, kind, distortion).frames
    views = {split: read(tmp_path, split) for split in ("train", "test")}
    for split, rows in (("test", HELD_OUT), ("train", [i for i in range(COUNT) if i not in HELD_OUT])):
        for place, row in enumerate(rows):
            rays = views[split].cameras.image_rays(place)
            expected = project_by_opencv(distortion, row, (rays.origins + 3 * rays.directions).numpy())
            sources, inside = find_sources(frames[row].camera, frames[row].pinhole, WIDTH, HEIGHT)
            assert inside.all()  # the zoom has seen to it
            np.testing.assert_allclose(sources.reshape(2, -1).T, expected, atol=1e-4)
            shown = views[split].images[place].reshape(-1, 3)[:, :2] / (COLUMN_STEP, ROW_STEP)
            middle = ((expected > 0) & (expected < (WIDTH - 1, HEIGHT - 1))).all(axis=1)
            np.testing.assert_allclose(shown[middle], expected[middle], atol=0.13)  # 8 bits, and OpenCV's 1/32 pixel
    assert views["train"].masks is None


def test_every_format_gives_the_same_rays(tmp_path: Path) -> None:
    write_blender(tmp_path / "blender")
    write_transforms(tmp_path / "transforms")
    write_colmap(tmp_path / "binary")
    write_colmap(tmp_path / "text", text=True, sparse="sparse")
    blender = read(tmp_path / "blender")
    expected = [blender.subset(HELD_OUT), blender.subset([i for i in range(COUNT) if i not in HELD_OUT])]
    for kind in ("transforms", "binary", "text"):
        for split, views in zip(("val", "train"), expected, strict=True):
            found = read(tmp_path / kind, split)
            for image, other in zip(found.images, views.images, strict=True):
                np.testing.assert_array_equal(image, other)
            assert found.masks is None
            for i in range(len(views.names)):
                there, here = found.cameras.image_rays(i), views.cameras.image_rays(i)
                torch.testing.assert_close(there.origins, here.origins, atol=1e-9, rtol=0)
                torch.testing.assert_close(there.directions, here.directions, atol=1e-9, rtol=0)
    seen = read(tmp_path / "binary").points
    assert seen is not None
    for points_of_view in seen:  # the first view, which is held out, sees none
        np.testing.assert_array_equal(points_of_view, points())
    text = read(tmp_path / "text", "test").points
    assert text is not None
    assert [len(own) for own in text] == [0, 30]


def test_formats_are_told_by_what_the_folder_has(tmp_path: Path) -> None:
    write_colmap(tmp_path, sparse="colmap/sparse/0")
    assert find_format(tmp_path) == "colmap"
    write_transforms(tmp_path)
    assert find_format(tmp_path) == "transforms"
    assert find_format(tmp_path, "colmap") == "colmap"
    with pytest.raises(InputError, match="no scene in the format blender; give a folder with"):
        find_format(tmp_path, "blender")
    write_blender(tmp_path)
    assert find_format(tmp_path) == "blender"


def test_a_folder_around_a_scene_names_it(tmp_path: Path) -> None:
    write_transforms(tmp_path / "around" / "scene")
    with pytest.raises(InputError, match="its folder 'scene' has such"):
        find_format(tmp_path / "around")


def test_an_only_image_is_held_out_and_that_is_said(tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    (tmp_path / "transforms.json").write_text(json.dumps(document | {"frames": document["frames"][:1]}))
    with pytest.raises(InputError, match="its only image is held out"):
        read(tmp_path)


def test_a_list_of_test_frames_is_left_out_and_that_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = write_transforms(tmp_path)
    changed = {"frames": document["frames"][2:], "test_frames": document["frames"][:2]}
    (tmp_path / "transforms.json").write_text(json.dumps(document | changed))
    read(tmp_path)
    assert "test_frames: 2 held-out images are left out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("size", "camera", "fits"),
    [
        ((135, 241), (1087, 1928), True),  # an eighth, its width cut, its height rounded
        ((241, 135), (1928, 1087), True),
        ((135, 240), (1080, 1920), True),
        ((135, 245), (1087, 1928), False),
        ((240, 135), (1080, 1920), False),
    ],
)
def test_a_scaled_image_has_its_cameras_shape_but_for_rounding(
    size: tuple[int, int], camera: tuple[int, int], fits: bool
) -> None:
    assert is_scaled(ImageHeader(*size, 3), *camera) == fits


@pytest.mark.parametrize("kind", ["colmap", "llff"])
def test_what_macos_puts_beside_images_is_no_image(kind: str, tmp_path: Path) -> None:
    if kind == "colmap":
        write_colmap(tmp_path)
    else:
        write_llff(tmp_path, bounds())
    (tmp_path / "images").rename(tmp_path / "images_2")
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / ".DS_Store").touch()
    (tmp_path / "images_2" / "._view 00.png").touch()
    assert len(read(tmp_path).names) == 7


def test_every_eighth_image_is_held_out_or_every_nth(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    held_out = [f"images/{name}" for name in (NAMES[0], NAMES[8])]
    assert list(read(tmp_path, "test").names) == list(read(tmp_path, "val").names) == held_out
    assert len(read(tmp_path).names) == 7
    assert read(tmp_path).eval_every == 8
    assert list(read(tmp_path, "test", eval_every=3).names) == [f"images/{NAMES[i]}" for i in (0, 3, 6)]


def test_a_split_of_the_data(tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    document |= {"train_filenames": [f"./images/{name}" for name in NAMES[:5]], "val_filenames": ["images/view 07"]}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert len(read(tmp_path).names) == 5
    assert read(tmp_path, "val").names == ("images/view 07.png",)
    assert read_split(tmp_path, "test") is None
    assert read(tmp_path).eval_every is None
    with pytest.raises(InputError, match="--eval-every has no effect"):
        read(tmp_path, eval_every=4)
    document["train_filenames"].append("images/view 07.png")
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"val_filenames\[0\]: .*in train_filenames, too"):
        read(tmp_path)


def test_an_ending_tells_listed_files_apart(tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    first, second = document["frames"][:2]
    kept = tmp_path / first["file_path"]
    (tmp_path / second["file_path"]).rename(kept.with_suffix(".jpg"))
    second["file_path"] = str(Path(first["file_path"]).with_suffix(".jpg"))
    document |= {"train_filenames": [first["file_path"]], "test_filenames": [second["file_path"]]}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert read(tmp_path).names == (first["file_path"],)
    assert read(tmp_path, "test").names == (second["file_path"],)


def test_a_text_model_may_have_no_points_and_odd_names(tmp_path: Path) -> None:
    write_colmap(tmp_path, text=True)
    (tmp_path / "sparse/0/points3D.txt").write_bytes(b"")
    (tmp_path / "images").rename(tmp_path / "images_2")
    (tmp_path / "images").mkdir()
    (tmp_path / "images_2" / NAMES[1]).rename(tmp_path / "images_2" / "view 01\u2028.png")
    listed = tmp_path / "sparse/0/images.txt"
    listed.write_text(listed.read_text().replace(NAMES[1], "view 01\u2028.png").replace("\n", "\r\n"), newline="")
    views = read(tmp_path)
    assert "view 01\u2028.png" in views.names
    assert len(views.names) == 7
    assert views.points is None


def test_images_that_do_not_exist_are_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_colmap(tmp_path)
    for name in NAMES[:4]:
        (tmp_path / "images" / name).unlink()
    assert len(read(tmp_path).names) == 4  # of 5, of which the first is held out
    assert capsys.readouterr().err.count("4 of the 9 listed images do not exist") == 1
    (tmp_path / "images" / NAMES[4]).unlink()
    with pytest.raises(InputError, match="5 of the 9 listed images do not exist"):
        read(tmp_path)


@pytest.mark.parametrize("folder", ["images_2", "images_4"])
def test_scaled_images_scale_the_intrinsics(folder: str, tmp_path: Path) -> None:
    write_colmap(tmp_path)
    factor = int(folder[-1])
    (tmp_path / folder).mkdir()
    for i, name in enumerate(NAMES):
        iio.imwrite(tmp_path / folder / name, picture(i)[::factor, ::factor])
        (tmp_path / "images" / name).unlink()
    (tmp_path / "images").rmdir()
    cameras = read(tmp_path).cameras
    values = [cameras.fx[0], cameras.fy[0], cameras.cx[0], cameras.cy[0]]
    assert [float(value) * factor for value in values] == pytest.approx([FX, FY, CX, CY])
    assert (int(cameras.width[0]), int(cameras.height[0])) == (WIDTH // factor, HEIGHT // factor)


def test_blanks_in_a_name_of_a_text_model_are_kept(tmp_path: Path) -> None:
    name, old = "view  01.png", "view 01.png"
    model = write_colmap(tmp_path, text=True)
    (tmp_path / "images" / old).rename(tmp_path / "images" / name)
    (tmp_path / "sparse/0/images.txt").write_bytes(model["images.txt"].replace(old.encode(), name.encode() + b" "))
    assert read(tmp_path, "test").names[0] == name  # blanks come first


@pytest.mark.parametrize("suffix", ["", ".png"])
def test_names_without_suffix(suffix: str, tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    for frame in document["frames"]:
        frame["file_path"] = frame["file_path"].removesuffix(".png") + suffix
    (tmp_path / "images" / NAMES[1]).rename(tmp_path / "images" / "view 01.JPG")  # by content it stays a PNG
    document["frames"][1]["file_path"] = "images/view 01"
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert len(read(tmp_path).names) == 7


def test_a_run_records_what_is_held_out_and_eval_uses_the_same(tmp_path: Path, edge_se: Any) -> None:
    write_colmap(tmp_path / "a mug", OPENCV)
    flags = ("--data", tmp_path / "a mug", "--eval-every", 3, "--output-dir", tmp_path / "outputs", *SMALL)
    answer = edge_se("train", "vanilla-nerf", *flags)
    assert answer.code == 0, answer.err
    assert "data     colmap: 6 views of 48 x 36, every 3rd image held out; no masks" in answer.out
    (run,) = (tmp_path / "outputs/a mug/vanilla-nerf").iterdir()
    config = json.loads((run / "config.json").read_text())
    near, far = config["pipeline"]["model"]["near"], config["pipeline"]["model"]["far"]
    assert (config["data_format"], config["eval_every"]) == ("colmap", 3)
    assert f"depths   {near:g} to {far:g}" in answer.out
    assert f"measure it: edge-se eval '{run}'" in answer.out
    assert edge_se("eval", run, "--output-path", tmp_path / "eval.json").code == 0
    images = json.loads((tmp_path / "eval.json").read_text())["results"]["images"]
    assert [image["name"] for image in images] == [NAMES[0], NAMES[3], NAMES[6]]


def test_the_writer_of_models_is_right() -> None:
    """Quaternions against OpenCV's own rotation."""
    for motion, pose in zip(capture_folder.motions(), poses(), strict=True):
        w, axis = motion[0], np.array(motion[1:4])
        angle = 2 * np.arctan2(np.linalg.norm(axis), w)
        rotation = cv2.Rodrigues(axis / np.linalg.norm(axis) * angle)[0]
        np.testing.assert_allclose(rotation, (pose[:3, :3] * (1, -1, -1)).T, atol=1e-9)


def test_images_may_lie_anywhere_in_the_folder(tmp_path: Path) -> None:
    write_images(tmp_path / "a" / "b")
    document = write_transforms(tmp_path)
    document["frames"][0]["file_path"] = f"a/b/{NAMES[0]}"
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert read(tmp_path, "test").names[0] == f"a/b/{NAMES[0]}"


def test_the_largest_of_several_models_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """COLMAP makes several where it cannot connect all images, the first not always the largest."""
    write_colmap(tmp_path, sparse="sparse/1")
    (tmp_path / "sparse/0").mkdir()
    for name in ("cameras", "points3D"):
        shutil.copy(tmp_path / f"sparse/1/{name}.bin", tmp_path / "sparse/0")
    two = colmap_files(PINHOLE, text=True)["images.txt"].split(b"\n")[:6]
    (tmp_path / "sparse/0/images.txt").write_bytes(b"\n".join(two))
    assert len(read(tmp_path).names) == COUNT - 2
    assert "sparse/1: the largest of 2 models" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "sparse/1")
    assert len(read(tmp_path, eval_every=2).names) < 3
    assert not capsys.readouterr().err


def test_paths_written_on_windows(tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    for frame in document["frames"]:
        frame["file_path"] = frame["file_path"].replace("/", "\\")
    document["train_filenames"] = [frame["file_path"] for frame in document["frames"][1:]]
    document["test_filenames"] = [document["frames"][0]["file_path"]]
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert read(tmp_path).names == tuple(f"images/{name}" for name in NAMES[1:])
    assert read(tmp_path, "test").names == (f"images/{NAMES[0]}",)
    odd = "images\\odd.png"  # is a name here, too
    shutil.copy(tmp_path / "images" / NAMES[3], tmp_path / odd)
    document["frames"][0]["file_path"] = document["test_filenames"][0] = odd
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    np.testing.assert_array_equal(read(tmp_path, "test").images[0], picture(3))


def test_coefficients_in_quotes(tmp_path: Path) -> None:
    """As nerfstudio writes those of RealityCapture."""
    document = write_transforms(tmp_path, OPENCV)
    expected = read(tmp_path).images[2]
    for frame in document["frames"]:
        frame |= {key: str(document[key]) for key in OPENCV.terms}
    for key in OPENCV.terms:
        del document[key]
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    np.testing.assert_array_equal(read(tmp_path).images[2], expected)


def test_coefficients_in_one_list(tmp_path: Path) -> None:
    """As nerfstudio reads them, too, and before those by name."""
    document = write_transforms(tmp_path, OPENCV)
    expected = read(tmp_path).images[2]
    document |= {"distortion_params": [document["k1"], document["k2"], 0, 0, document["p1"], document["p2"]], "k1": 0.3}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    np.testing.assert_array_equal(read(tmp_path).images[2], expected)


def test_a_fisheyes_crop_radius_is_refused_and_others_have_none(tmp_path: Path) -> None:
    document = write_transforms(tmp_path, PINHOLE) | {"fisheye_crop_radius": 20.0}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert read(tmp_path).masks is None
    document["camera_model"] = "OPENCV_FISHEYE"
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"fisheye_crop_radius: is not supported; .*masks"):
        read(tmp_path)


def test_a_blender_scenes_cameras_must_be_perspective_ones_too(tmp_path: Path) -> None:
    document = write_blender(tmp_path) | {"equirectangular": True}
    (tmp_path / "transforms_train.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="equirectangular: is of a camera that is not supported"):
        read(tmp_path)
