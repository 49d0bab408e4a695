"""Cameras as nerfstudio's transforms.json: read back by our own reader, they are the data's."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from blender_folder import write_json, write_scene
from capture_folder import (
    COUNT,
    FISHEYE,
    HEIGHT,
    NAMES,
    OPENCV,
    PINHOLE,
    Distortion,
    picture,
    read,
    transforms,
    turned_jpeg,
    write_colmap,
    write_transforms,
)
from exported import ball_run

from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.errors import InputError
from edge_se_sampler.export.cameras import export_cameras
from edge_se_sampler.methods import method_configs


def config_of(data: Path, data_format: Any, **changes: Any) -> TrainerConfig:
    return replace(method_configs()["lean-nerf"], data=data, data_format=data_format, **changes)


def assert_same(views: Views, expected: Views) -> None:
    """The same images, seen along the same rays, in any order."""
    order = [sorted(range(len(v.names)), key=lambda i: v.images[i].tobytes()) for v in (views, expected)]
    assert len(order[0]) == len(order[1])
    for i, j in zip(*order, strict=True):
        np.testing.assert_array_equal(views.images[i], expected.images[j])
        rays, wanted = views.cameras.image_rays(i), expected.cameras.image_rays(j)
        np.testing.assert_allclose(rays.origins, wanted.origins, rtol=0, atol=1e-12)
        np.testing.assert_allclose(rays.directions, wanted.directions, rtol=0, atol=1e-12)


@pytest.mark.parametrize("distortion", [PINHOLE, OPENCV, FISHEYE], ids=lambda each: each.model)
@pytest.mark.parametrize("downscale", [1, 2])
def test_what_is_read_back_has_the_rays_of_the_data(distortion: Distortion, downscale: int, tmp_path: Path) -> None:
    write_colmap(tmp_path, distortion)
    config = config_of(tmp_path, "colmap", eval_every=4, downscale=downscale)
    export_cameras(config, tmp_path / "transforms.json")
    for split in ("train", "test"):
        expected = read(tmp_path, split, data_format="colmap", eval_every=4, downscale=downscale)
        assert_same(read(tmp_path, split, data_format="transforms", downscale=downscale), expected)
    document = json.loads((tmp_path / "transforms.json").read_text())
    assert len(document["frames"]) == COUNT
    assert document["train_filenames"] == [f"images/{NAMES[i]}" for i in (1, 2, 3, 5, 6, 7)]
    assert document["val_filenames"] == document["test_filenames"] == [f"images/{NAMES[i]}" for i in (0, 4, 8)]
    assert document["camera_model"] == ("OPENCV_FISHEYE" if distortion is FISHEYE else "OPENCV")
    assert document["h"] == HEIGHT  # of the file, which is not downscaled
    assert set(document["frames"][0]) == {"file_path", "transform_matrix"}


def test_a_blender_scene_becomes_one_file(tmp_path: Path) -> None:
    for split in ("train", "val", "test"):
        write_scene(tmp_path, 3, split)
        for i in range(3):  # images of their own
            iio.imwrite(tmp_path / split / f"r_{i}.png", np.full((4, 6, 4), 20 * i + len(split), np.uint8))
    export_cameras(config_of(tmp_path, "blender"), tmp_path / "transforms.json")
    for split in ("train", "val", "test"):
        expected = read(tmp_path, split, data_format="blender")
        assert_same(read(tmp_path, split, data_format="transforms"), expected)


@pytest.mark.parametrize("held_out", ["val", "test"])
def test_the_one_list_of_held_out_views_is_both(held_out: str, tmp_path: Path) -> None:
    """nerfstudio measures on val while it trains and on test afterwards, and stops where a list is missing."""
    for split in ("train", held_out):
        write_scene(tmp_path, 2, split)
    export_cameras(config_of(tmp_path, "blender"), tmp_path / "transforms.json")
    document = json.loads((tmp_path / "transforms.json").read_text())
    expected = [f"{held_out}/r_0.png", f"{held_out}/r_1.png"]
    assert document["val_filenames"] == document["test_filenames"] == expected


def test_cameras_that_differ_are_with_their_frames_and_masks_too(tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    for i, frame in enumerate(document["frames"]):
        frame["fl_x"] = 40 + i
    iio.imwrite(tmp_path / "mask.png", np.eye(HEIGHT, document["w"], dtype=np.uint8))
    document["frames"][2]["mask_path"] = "mask.png"
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    export_cameras(config_of(tmp_path, "transforms", eval_every=3), tmp_path / "cameras.json")
    (written := tmp_path / "cameras.json").rename(tmp_path / "transforms.json")
    assert not written.exists()
    exported = json.loads((tmp_path / "transforms.json").read_text())
    masks = [iio.imread(tmp_path / frame["mask_path"]) for frame in exported["frames"]]  # nerfstudio wants all or none
    assert [mask.shape == (HEIGHT, document["w"]) and mask.min() == 255 for mask in masks].count(False) == 1
    assert exported["camera_model"] == "OPENCV"
    assert "fl_x" not in exported
    assert "h" in exported["frames"][0]  # all or none: nerfstudio takes what is at the top for all
    views = read(tmp_path, "train")
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    expected = read(tmp_path, "train", eval_every=3)
    assert_same(views, expected)
    assert views.masks is not None
    assert expected.masks is not None
    assert sorted(mask.sum() for mask in views.masks) == sorted(mask.sum() for mask in expected.masks)


def test_files_are_relative_to_the_json_and_points_beside_it_are_named(tmp_path: Path, edge_se: Callable) -> None:
    pytest.importorskip("manifold3d", reason="points need the [export] extra")
    run, out = ball_run(tmp_path), tmp_path / "elsewhere" / "deep"
    out.mkdir(parents=True)
    cameras = ("export", run, "cameras", "--output-path", out / "transforms.json")
    answer = edge_se(*cameras)
    assert answer.code == 0, answer.err
    assert "6 cameras" in answer.out
    document = json.loads((out / "transforms.json").read_text())
    assert "ply_file_path" not in document
    assert document["frames"][0]["file_path"] == "../../scene/0.png"
    assert all(
        (out / frame["file_path"]).samefile(tmp_path / "scene" / f"{i}.png")
        for i, frame in enumerate(document["frames"])
    )
    assert edge_se("export", run, "points", "--output-path", out / "points.ply", "--num-points", 99).code == 0
    assert "points.ply" in edge_se(*cameras).out
    assert json.loads((out / "transforms.json").read_text())["ply_file_path"] == "points.ply"


def test_the_views_that_were_trained_on_are_listed(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    export_cameras(config_of(tmp_path, "transforms", eval_every=3, views=(4, 1)), tmp_path / "cameras.json")
    document = json.loads((tmp_path / "cameras.json").read_text())
    train = [i for i in range(COUNT) if i % 3]
    assert document["train_filenames"] == [f"images/{NAMES[train[i]]}" for i in (4, 1)]
    assert len(document["frames"]) == 2 + 3


def test_the_datas_own_json_is_not_overwritten(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    for data_format in ("transforms", "auto"):
        with pytest.raises(InputError, match="not overwritten"):
            export_cameras(config_of(tmp_path, data_format), tmp_path / "images" / ".." / "transforms.json")
    assert json.loads((tmp_path / "transforms.json").read_text()) == transforms()


def test_a_json_of_something_else_is_not_replaced(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    other, again = tmp_path / "config.json", tmp_path / "cameras.json"
    other.write_text('{"camera_model": "OPENCV", "frames": []}')
    with pytest.raises(InputError, match="none that was exported here"):
        export_cameras(config_of(tmp_path, "transforms"), other)
    assert json.loads(other.read_text())["frames"] == []
    for _ in range(2):  # what was exported is
        export_cameras(config_of(tmp_path, "transforms"), again)


def test_a_mask_that_is_a_bomb_is_said_in_a_line(tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    (tmp_path / "masks").mkdir()
    header = b"IHDR" + struct.pack(">IIBBBBB", 20_000, 20_000, 8, 0, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    (tmp_path / "masks" / NAMES[0]).write_bytes(png)
    assert document["frames"]
    with pytest.raises(InputError, match=NAMES[0]):
        export_cameras(config_of(tmp_path, "transforms"), tmp_path / "cameras.json")


def test_blender_lists_are_not_overwritten(tmp_path: Path) -> None:
    write_scene(tmp_path)
    before = (tmp_path / "transforms_train.json").read_bytes()
    for name in ("transforms_train.json", "transforms_val.json"):
        with pytest.raises(InputError, match="not overwritten"):
            export_cameras(config_of(tmp_path, "auto"), tmp_path / name)
    assert (tmp_path / "transforms_train.json").read_bytes() == before


def test_lists_of_a_format_that_was_not_chosen_are_not_overwritten_either(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    write_scene(tmp_path)
    before = (tmp_path / "transforms.json").read_bytes()
    with pytest.raises(InputError, match="not overwritten"):
        export_cameras(config_of(tmp_path, "blender"), tmp_path / "transforms.json")
    assert (tmp_path / "transforms.json").read_bytes() == before


def test_without_held_out_views_nothing_is_listed(tmp_path: Path) -> None:
    """nerfstudio stops where it finds some of the lists."""
    write_scene(tmp_path, 3)
    export_cameras(config_of(tmp_path, "blender"), tmp_path / "transforms.json")
    document = json.loads((tmp_path / "transforms.json").read_text())
    assert len(document["frames"]) == 3
    assert not [key for key in document if key.endswith("_filenames")]


def test_data_that_is_gone_is_an_error(tmp_path: Path, edge_se: Callable) -> None:
    run = ball_run(tmp_path)
    write_json(tmp_path / "scene", {"fl_x": 9, "frames": []})
    answer = edge_se("export", run, "cameras", "--output-path", tmp_path / "transforms.json")
    assert answer.code == 2
    assert "frames" in answer.err
    assert not (tmp_path / "transforms.json").exists()


APPLIED = [[0.0, 0.0, 1.0, 2.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 3.0]]
OLD_COLMAP = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
"""What nerfstudio takes where a folder has a model of COLMAP's, and a json without this."""
NOTHING = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]


@pytest.mark.parametrize(
    ("kind", "expected"), [("written", APPLIED), ("old", OLD_COLMAP), ("none", NOTHING), ("colmap", NOTHING)]
)
def test_what_had_been_done_to_the_cameras_before_is_said(kind: str, expected: list, tmp_path: Path) -> None:
    """Else nerfstudio would take something for it, or nothing; a path that is drawn there returns by it."""
    if kind == "colmap":
        write_colmap(tmp_path)
        (tmp_path / "colmap").mkdir()
        (tmp_path / "sparse").rename(tmp_path / "colmap" / "sparse")
    else:
        document = write_transforms(tmp_path)
        if kind == "written":
            document |= {"applied_transform": APPLIED, "applied_scale": 2.5}
        elif kind == "old":
            (tmp_path / "colmap" / "sparse" / "0").mkdir(parents=True)
        (tmp_path / "transforms.json").write_text(json.dumps(document))
    (tmp_path / "points.ply").touch()
    config, path = config_of(tmp_path, "colmap" if kind == "colmap" else "transforms"), tmp_path / "cameras.json"
    line = export_cameras(config, path)
    written = json.loads(path.read_text())
    assert written["applied_transform"] == expected
    assert written["applied_scale"] == (2.5 if kind == "written" else 1)
    # nerfstudio would scale the points, and not the cameras
    assert written.get("ply_file_path") == (None if kind == "written" else "points.ply")
    assert ("is not named" in line) == (kind == "written")


def test_masks_that_nerfstudio_would_read_otherwise_are_written_anew(tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    shown = np.zeros((HEIGHT, document["w"]), np.uint8)
    shown[:, 7:] = 255
    colors = np.repeat(shown[..., None], 3, axis=2)
    nearly = np.where(shown > 0, np.uint8(250), np.uint8(4))
    (tmp_path / "masks").mkdir()
    for i, mask in enumerate([shown, colors, np.dstack((colors, shown))]):
        iio.imwrite(tmp_path / "masks" / NAMES[i], mask)
    (tmp_path / "masks" / f"{NAMES[3]}.jpg").write_bytes(iio.imwrite("<bytes>", nearly, extension=".jpg"))
    iio.imwrite(tmp_path / "images" / f"dynamic_mask_{Path(NAMES[4]).stem}.png", 255 - shown)
    for i in (3, 4):
        document["frames"][i]["file_path"] = f"images/{NAMES[i]}"
    document["frames"][3]["mask_path"] = f"masks/{NAMES[3]}.jpg"
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    line = export_cameras(config_of(tmp_path, "transforms"), tmp_path / "cameras.json")
    assert "4 masks written anew" in line
    frames = {frame["file_path"]: frame for frame in json.loads((tmp_path / "cameras.json").read_text())["frames"]}
    for i in range(5):
        mask = iio.imread(tmp_path / frames[f"images/{NAMES[i]}"]["mask_path"])
        np.testing.assert_array_equal(mask, shown)  # gray
    assert frames[f"images/{NAMES[0]}"]["mask_path"] == f"masks/{NAMES[0]}"


def test_masks_are_written_once_all_can_be_and_keep_the_names_of_their_images(tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    mask = np.full((HEIGHT, document["w"], 3), 255, np.uint8)
    mask[0, :3] = 0
    for i in range(4):
        iio.imwrite(tmp_path / f"mask{i}.png", mask)
        document["frames"][i]["mask_path"] = f"mask{i}.png"
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    config, path = config_of(tmp_path, "transforms"), tmp_path / "out" / "cameras.json"
    path.parent.mkdir()
    export_cameras(config, path)
    before = {file: file.read_bytes() for file in path.parent.rglob("*.*") if file.is_file()}
    masks = {frame["file_path"]: frame["mask_path"] for frame in json.loads(path.read_text())["frames"]}
    assert len(before) == 1 + 4 + 1  # and one in which all is known
    for image, name in masks.items():
        assert Path(name).name in (f"{Path(image).name}.png", f"all-known-{document['w']}x{HEIGHT}.png")
    content = (tmp_path / "mask3.png").read_bytes()
    (tmp_path / "mask3.png").write_bytes(content[:-30])
    mask[:] = 0
    iio.imwrite(tmp_path / "mask0.png", mask)
    with pytest.raises(InputError, match="mask3"):
        export_cameras(config, path)
    assert before == {file: file.read_bytes() for file in path.parent.rglob("*.*") if file.is_file()}
    (tmp_path / "mask3.png").write_bytes(content)
    document["applied_transform"] = [*NOTHING, [0, 0, 0, 1]]
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="applied_transform"):
        export_cameras(config, path)
    assert before == {file: file.read_bytes() for file in path.parent.rglob("*.*") if file.is_file()}


def test_what_nerfstudio_does_not_heed_is_said(tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    document["frames"][2]["camera_model"] = "OPENCV_FISHEYE"
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    line = export_cameras(config_of(tmp_path, "transforms"), tmp_path / "cameras.json")
    assert "nerfstudio takes all cameras for perspective ones" in line
    assert "orientation" not in line
    write_transforms(tmp_path)
    (tmp_path / "images" / NAMES[1]).write_bytes(turned_jpeg(np.rot90(picture(1)), 6))
    line = export_cameras(config_of(tmp_path, "transforms"), tmp_path / "cameras.json")
    assert "EXIF orientation says, as 1 of these have to be" in line
    assert "perspective" not in line
