"""Masks of captures: both meanings, what programs write, and where they are found."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from capture_folder import (
    HEIGHT,
    NAMES,
    OPENCV,
    PINHOLE,
    WIDTH,
    Distortion,
    picture,
    read,
    turned_jpeg,
    write_blender,
    write_colmap,
    write_transforms,
)

from edge_se_sampler.data.dataset import read_split
from edge_se_sampler.data.mask_files import find_mask, place_of_mask
from edge_se_sampler.data.scene_file import SourceFile, SourceLocation
from edge_se_sampler.errors import InputError


def half_mask() -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, : WIDTH // 2] = 255
    return mask


@pytest.mark.parametrize("kind", ["transforms", "colmap"])
@pytest.mark.parametrize("distortion", [PINHOLE, OPENCV])
def test_masks_of_both_meanings(kind: str, distortion: Distortion, tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    for name in NAMES:
        iio.imwrite(tmp_path / "masks" / (f"{name}.png" if kind == "colmap" else name), half_mask())
    if kind == "colmap":
        write_colmap(tmp_path, distortion)
    else:
        document = write_transforms(tmp_path, distortion)
        for frame, name in zip(document["frames"], NAMES, strict=True):
            frame["mask_path"] = f"masks/{name}"
        (tmp_path / "transforms.json").write_text(json.dumps(document))
    ignored, objects = read(tmp_path), read(tmp_path, masks="object")
    assert ignored.masks is not None
    assert objects.masks is None
    assert ignored.images[0].shape[2] == 3
    if distortion is PINHOLE:
        np.testing.assert_array_equal(ignored.masks[0], half_mask() > 0)
        np.testing.assert_array_equal(objects.images[0][..., 3], half_mask())
    left = WIDTH // 2 - 4
    for i in range(7):
        assert ignored.masks[i][:, :left].all()
        assert not ignored.masks[i][:, left + 8 :].any()
        np.testing.assert_array_equal(ignored.masks[i], objects.images[i][..., 3] == 255)
    assert "masks (outside is unknown" in ignored.describe()
    assert "alpha (transparent is background)" in objects.describe()
    small = read(tmp_path, downscale=2)
    assert small.masks is not None
    assert small.images[0].shape == (HEIGHT // 2, WIDTH // 2, 3)
    assert small.masks[0].shape == (HEIGHT // 2, WIDTH // 2)


@pytest.mark.parametrize("kind", ["transforms", "colmap"])
def test_masks_of_images_that_are_links_are_where_they_were_written(kind: str, tmp_path: Path) -> None:
    (write_colmap if kind == "colmap" else write_transforms)(tmp_path)
    (tmp_path / "images").rename(tmp_path / "photographs")
    os.symlink("photographs", tmp_path / "images")
    for image in (tmp_path.resolve() / "photographs").iterdir():
        mask = place_of_mask(tmp_path, image)
        mask.parent.mkdir(parents=True, exist_ok=True)
        iio.imwrite(mask, half_mask())
    np.testing.assert_array_equal(read(tmp_path, masks="object").images[0][..., 3], half_mask())


def with_alpha(gray: int) -> np.ndarray:
    return np.dstack((np.full((HEIGHT, WIDTH, 3), gray, np.uint8), half_mask()))


@pytest.mark.parametrize("mask", [half_mask() // 255, half_mask() // 2, with_alpha(255), with_alpha(0)])
def test_masks_as_programs_write_them(mask: np.ndarray, tmp_path: Path) -> None:
    """0 and 1, or another number, are no alpha; and some have it in their alpha alone."""
    write_transforms(tmp_path)
    (tmp_path / "masks").mkdir()
    for name in NAMES:
        iio.imwrite(tmp_path / "masks" / name, mask)
    masks = read(tmp_path).masks
    assert masks is not None
    np.testing.assert_array_equal(masks[0], half_mask() > 0)
    np.testing.assert_array_equal(read(tmp_path, masks="object").images[0][..., 3], half_mask())


def test_soft_masks_stay_soft(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    (tmp_path / "masks").mkdir()
    soft = np.broadcast_to(np.arange(WIDTH, dtype=np.uint8), (HEIGHT, WIDTH))
    for name in NAMES:
        iio.imwrite(tmp_path / "masks" / name, soft)
    np.testing.assert_array_equal(read(tmp_path, masks="object").images[0][..., 3], soft)


def test_black_and_white_of_jpegs_are_rounded(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    (tmp_path / "masks").mkdir()
    nearly = np.where(half_mask() > 0, np.uint8(251), np.uint8(3))
    for name in NAMES:
        (tmp_path / "masks" / name).write_bytes(iio.imwrite("<bytes>", nearly, extension=".jpg"))
    masks = read(tmp_path).masks
    assert masks is not None
    np.testing.assert_array_equal(masks[0], half_mask() > 0)
    np.testing.assert_array_equal(read(tmp_path, masks="object").images[0][..., 3], half_mask())


@pytest.mark.parametrize(
    ("listed", "mask"),
    [
        ("images/a.jpg", "masks/a.jpg.png"),
        ("images/a.jpg", "masks/a.png"),
        ("images/a.jpg", "masks/a.jpg"),
        ("images/a.jpg", "masks/a_mask.png"),
        ("images/a.jpg", "masks/a_mask.jpg"),
        ("./images/b/a.jpg", "masks/b/a.png"),
        ("images_4/a.jpg", "masks_4/a.png"),
        ("images_4/a.jpg", "masks/a.png"),
        ("train/a.png", "masks/train/a.png"),
        ("a.jpg", "masks/a.png"),
        ("images/b/a.jpg", "images/b/dynamic_mask_a.png"),
    ],
)
def test_where_masks_are_found(listed: str, mask: str, tmp_path: Path) -> None:
    """By the listed name, and by that of the file that it is a link to."""
    for path in (listed, mask):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).touch()
    os.symlink(tmp_path / listed, tmp_path / "link.jpg")
    for name in (listed, "link.jpg"):
        found = find_mask(tmp_path, name, SourceFile((tmp_path / listed).resolve(), SourceLocation(tmp_path)))
        assert found is not None
        assert found.path == (tmp_path / mask).resolve()
    nothing = find_mask(tmp_path, "other.jpg", SourceFile(tmp_path.resolve() / "other.jpg", SourceLocation(tmp_path)))
    assert nothing is None


def test_a_link_has_the_mask_of_its_own_name_first(tmp_path: Path) -> None:
    for name in ("masks/a.png", "masks/all/a.png", "all/a.jpg"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    image = SourceFile((tmp_path / "all/a.jpg").resolve(), SourceLocation(tmp_path))
    for listed, mask in (("images/a.jpg", "masks/a.png"), ("all/a.jpg", "masks/all/a.png")):
        found = find_mask(tmp_path, listed, image)
        assert found is not None
        assert found.path == (tmp_path / mask).resolve()


def test_views_without_a_mask_are_said_to_be_object_as_a_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_transforms(tmp_path)
    (tmp_path / "masks").mkdir()
    for name in NAMES[:6]:
        iio.imwrite(tmp_path / "masks" / name, half_mask())
    read(tmp_path, masks="object")
    assert "2 of 7 views have neither mask nor alpha, 'images/view 06.png' for one" in capsys.readouterr().err
    read(tmp_path)
    assert not capsys.readouterr().err


def test_views_without_alpha_among_others_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_transforms(tmp_path)
    for name in NAMES[:6]:
        image = iio.imread(tmp_path / "images" / name)
        iio.imwrite(tmp_path / "images" / name, np.dstack((image[..., :3], half_mask())))
    read(tmp_path)
    assert "2 of 7 views have no alpha, 'images/view 06.png' for one" in capsys.readouterr().err


def test_images_that_are_transparent_as_a_whole_are_an_error(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    for name in NAMES:
        image = iio.imread(tmp_path / "images" / name)
        iio.imwrite(tmp_path / "images" / name, np.dstack((image[..., :3], 0 * half_mask())))
    with pytest.raises(InputError, match=r"'images/view 01.png' and all other views are transparent as a whole"):
        read(tmp_path)
    assert not read(tmp_path, "test").images[0][..., 3].any()


def test_masks_that_no_image_has_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_transforms(tmp_path)
    (tmp_path / "masks").mkdir()
    read(tmp_path)
    assert not capsys.readouterr().err
    for name in NAMES:
        iio.imwrite(tmp_path / "masks" / f"silhouette of {name}", half_mask())
    read(tmp_path)
    assert f"has {len(NAMES)} files, 'silhouette of view 0" in capsys.readouterr().err
    iio.imwrite(tmp_path / "masks" / NAMES[0], half_mask())
    read(tmp_path)
    assert not capsys.readouterr().err


def test_a_blender_scenes_masks_that_no_image_has_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_blender(tmp_path)
    (tmp_path / "masks").mkdir()
    iio.imwrite(tmp_path / "masks" / "of nothing.png", half_mask())
    read(tmp_path)
    assert "has 1 files, 'of nothing.png' for one" in capsys.readouterr().err


def test_instant_ngps_masks_are_white_where_nothing_is_trained_on(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    for name in NAMES:
        iio.imwrite(tmp_path / "images" / f"dynamic_mask_{Path(name).stem}.png", half_mask())
    masks = read(tmp_path).masks
    assert masks is not None
    np.testing.assert_array_equal(masks[0], half_mask() == 0)
    np.testing.assert_array_equal(read(tmp_path, masks="object").images[0][..., 3], 255 - half_mask())


def test_masks_that_leave_no_object_are_an_error(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    (tmp_path / "masks").mkdir()
    for name in NAMES:
        iio.imwrite(tmp_path / "masks" / name, 0 * half_mask())
    with pytest.raises(InputError, match=r"'images/view 01.png' and all other views are masked as a whole"):
        read(tmp_path, masks="object")


@pytest.mark.parametrize("kind", ["transforms", "blender"])
def test_held_out_views_that_are_masked_as_a_whole_do_not_stop_a_training(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of nothing that is known there is nothing to measure; of nothing but background there is."""
    if kind == "transforms":
        write_transforms(tmp_path)
    else:
        document = write_blender(tmp_path)
        for split, frames in (("train", document["frames"][2:]), ("test", document["frames"][:2])):
            (tmp_path / f"transforms_{split}.json").write_text(json.dumps(document | {"frames": frames}))
    held_out = {Path(name) for name in read(tmp_path, "test").names}
    for image in sorted((tmp_path.resolve() / "images").iterdir()):
        mask = place_of_mask(tmp_path, image)
        mask.parent.mkdir(parents=True, exist_ok=True)
        iio.imwrite(mask, 0 * half_mask() if image.relative_to(tmp_path.resolve()) in held_out else half_mask())
    assert read(tmp_path).masks
    capsys.readouterr()
    assert read_split(tmp_path, "test") is None
    assert "test views are masked as a whole, 2 of them: left out" in capsys.readouterr().err
    assert not read(tmp_path, "test", masks="object").images[0][..., 3].any()


def test_masks_as_objects_where_there_are_none(tmp_path: Path) -> None:
    """Where only the held-out views have none, it says which those are."""
    write_transforms(tmp_path)
    held_out = read(tmp_path, "test").names
    for image in (tmp_path / "images").iterdir():
        if image.name not in {Path(name).name for name in held_out}:
            mask = place_of_mask(tmp_path, image)
            mask.parent.mkdir(parents=True, exist_ok=True)
            iio.imwrite(mask, half_mask())
    assert read(tmp_path, masks="object").images[0].shape[2] == 4
    with pytest.raises(InputError, match=f"{re.escape(held_out[0])}.*neither masks nor alpha"):
        read(tmp_path, "test", masks="object")


@pytest.mark.parametrize("turned_image", [False, True])
def test_a_masks_own_orientation_is_applied(turned_image: bool, tmp_path: Path) -> None:
    """Whether or not its image has one."""
    write_colmap(tmp_path)
    if turned_image:
        (tmp_path / "images" / NAMES[1]).write_bytes(turned_jpeg(np.rot90(picture(1)), 6))
    (tmp_path / "masks").mkdir()
    mask = tmp_path / "masks" / NAMES[1]
    mask.write_bytes(turned_jpeg(np.rot90(half_mask()), 6))
    masks = read(tmp_path).masks
    assert masks is not None
    assert masks[0][:, :20].all()  # JPEG's blocks blur the edge between
    assert not read(tmp_path, masks="object").images[0][:, 32:, 3].any()
    mask.write_bytes(turned_jpeg(half_mask(), 3))
    with pytest.raises(InputError, match=r"images\[1\]: .*EXIF orientation 3"):
        read(tmp_path)
