"""edge-se masks: an object in front of an uneven, noisy wall, seen from all around."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.dataset import DataSettings, read_split
from edge_se_sampler.data.lens import Intrinsics, Lens
from edge_se_sampler.data.mask_files import place_of_mask
from edge_se_sampler.masks.segmentation import segment
from edge_se_sampler.masks.votes import count_votes, find_pixels

SIZE, COUNT, FOCAL, DISTANCE = 120, 12, 150.0, 4.0
LENS = Intrinsics(FOCAL, FOCAL, SIZE / 2, SIZE / 2)
OUTER, INNER, TUBE = 1.0, 0.5, 0.25


def poses() -> list[np.ndarray]:
    """Cameras on a circle above the scene that look at its center."""
    found = []
    for angle in np.arange(COUNT) / COUNT * 2 * np.pi:
        back = np.array((np.cos(angle), np.sin(angle), 0.9))
        back /= np.linalg.norm(back)
        right = np.cross((0, 0, 1), back)
        right /= np.linalg.norm(right)
        found.append(np.column_stack((right, np.cross(back, right), back, DISTANCE * back)))
    return found


def silhouette(pose: np.ndarray) -> np.ndarray:
    """(SIZE, SIZE) bool: where a flat ring with a hole is seen, found by points along each ray."""
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    local = np.stack(((x - SIZE / 2) / FOCAL, -(y - SIZE / 2) / FOCAL, -np.ones_like(x)), axis=2)
    directions = local @ pose[:, :3].T
    t = np.linspace(DISTANCE - 1.5, DISTANCE + 1.5, 75)
    points = pose[:, 3] + t[:, None, None, None] * directions
    radius = np.hypot(points[..., 0], points[..., 1])
    return ((radius > INNER) & (radius < OUTER) & (abs(points[..., 2]) < TUBE / 2)).any(axis=0)


def photograph(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(SIZE, SIZE, 3) uint8: a textured object in front of a wall that light falls on from a side, with noise."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    wall = (190 + 30 * x - 20 * y)[..., None] * np.array((1.0, 0.98, 0.94))
    texture = 90 + 50 * np.sin(40 * x)[..., None] * np.array((1.0, 0.3, -0.5)) + np.array((60, 0, -30))
    return (np.where(mask[..., None], texture, wall) + rng.normal(0, 3, (SIZE, SIZE, 3))).clip(0, 255).astype(np.uint8)


def iou(found: np.ndarray, true: np.ndarray) -> float:
    return (found & true).sum() / (found | true).sum()


@pytest.fixture(scope="module")
def truth() -> list[np.ndarray]:
    return [silhouette(pose) for pose in poses()]


@pytest.fixture(scope="module")
def images(truth: list[np.ndarray]) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [photograph(mask, rng) for mask in truth]


STAINED, CROWDED = 3, 4


def unplain(rng: np.random.Generator) -> np.ndarray:
    """(SIZE, SIZE, 3) uint8: patches of all colors."""
    return rng.integers(0, 256, (SIZE // 10, SIZE // 10, 3), dtype=np.uint8).repeat(10, axis=0).repeat(10, axis=1)


@pytest.fixture(scope="module")
def found(images: list[np.ndarray]) -> list[np.ndarray]:
    """The masks where one view has a stain on the wall, far from the object, and another no plain background."""
    some = [image.copy() for image in images]
    some[STAINED][12:24, 12:24] = (200, 30, 30)
    some[CROWDED] = unplain(np.random.default_rng(2))
    return segment(some, [LENS] * COUNT, poses())


@pytest.mark.slow
def test_an_object_is_found_and_the_hole_through_it_stays_open(
    found: list[np.ndarray], truth: list[np.ndarray]
) -> None:
    assert min(iou(found[i], truth[i]) for i in range(COUNT) if i != CROWDED) > 0.95
    middle = SIZE // 2
    assert not any(mask[middle, middle] for mask in truth)
    assert not any(mask[middle, middle] for mask in found)


@pytest.mark.slow
def test_views_outvote_what_one_of_them_alone_takes_for_the_object(found: list[np.ndarray]) -> None:
    assert not found[STAINED][12:24, 12:24].any()


def test_the_other_views_make_the_mask_of_one_without_a_plain_background(
    found: list[np.ndarray], truth: list[np.ndarray]
) -> None:
    assert iou(found[CROWDED], truth[CROWDED]) > 0.8


@pytest.mark.slow
def test_a_hole_stays_open_where_compression_smears_colors(images: list[np.ndarray], truth: list[np.ndarray]) -> None:
    """JPEG halves the resolution of colors: at its edges the wall takes on those of the object."""
    encoded = [iio.imwrite("<bytes>", image, extension=".jpg", quality=95, subsampling=2) for image in images]
    found = segment([iio.imread(image) for image in encoded], [LENS] * COUNT, poses())
    assert not any(mask[SIZE // 2, SIZE // 2] for mask in found)
    assert min(map(iou, found, truth)) > 0.95


@pytest.mark.slow
def test_a_wall_and_a_table_are_background(images: list[np.ndarray], truth: list[np.ndarray]) -> None:
    rng = np.random.default_rng(3)
    some = [image.copy() for image in images]
    for image, mask in zip(some, truth, strict=True):
        table = (110 + rng.normal(0, 3, (SIZE // 3, SIZE, 3))).astype(np.uint8)
        image[-len(table) :] = np.where(mask[-len(table) :, :, None], image[-len(table) :], table)
    assert min(map(iou, segment(some, [LENS] * COUNT, poses()), truth)) > 0.95


def test_a_lens_that_distorts_is_heeded(truth: list[np.ndarray]) -> None:
    """A view's rays pass where its lens shows them: at the border, far from where a pinhole would."""
    lens = replace(LENS, lens=Lens(fisheye=False, coefficients=(-0.3, 0, 0, 0, 0)))
    radius = 0.37  # of the ring's outermost point in a pinhole's image, in units of depth
    coords = torch.tensor([SIZE / 2, SIZE / 2 + FOCAL * radius * (1 - 0.3 * radius**2)])
    pose = poses()[0]
    point = pose[:, 3] + DISTANCE * (radius * pose[:, 0] - pose[:, 2])
    cameras = Cameras.of(pose[None], fx=FOCAL, fy=FOCAL, cx=SIZE / 2, cy=SIZE / 2, width=SIZE, height=SIZE).to(
        dtype=torch.float32
    )
    rows, pixels = find_pixels(cameras, 0, lens, torch.from_numpy(point[None]).float())
    assert rows.tolist() == [0]
    assert [int(axis[0]) for axis in pixels] == coords.long().tolist()
    assert find_pixels(cameras, 0, LENS, torch.from_numpy(point[None]).float())[1][1][0] > pixels[1][0]
    behind = pose[:, 3] + pose[:, 2]
    assert not len(find_pixels(cameras, 0, lens, torch.from_numpy(behind[None]).float())[0])


def test_a_fisheye_sees_to_its_borders() -> None:
    """170 degrees across the image's width: a pinhole would show the outermost points far outside of it."""
    focal = SIZE / np.radians(170)
    lens = Intrinsics(focal, focal, SIZE / 2, SIZE / 2, Lens(fisheye=True, coefficients=(0, 0, 0, 0, 0)))
    cameras = Cameras.of(np.eye(4)[None, :3], fx=focal, fy=focal, cx=SIZE / 2, cy=SIZE / 2, width=SIZE, height=SIZE).to(
        dtype=torch.float32
    )
    angle = np.radians(np.linspace(-84, 84, 75))
    points = torch.from_numpy(np.stack((np.sin(angle), 0 * angle, -np.cos(angle)), axis=1)).float()
    rows, pixels = find_pixels(cameras, 0, lens, points)
    assert rows.tolist() == list(range(75))
    np.testing.assert_allclose(pixels[1] + 0.5, SIZE / 2 + focal * angle, atol=0.6)


def test_votes_are_the_share_of_the_other_views(truth: list[np.ndarray]) -> None:
    masks = list(truth)
    masks[0] = np.zeros_like(masks[0])
    votes = count_votes([LENS] * COUNT, poses(), masks)
    assert np.median(votes[0][truth[0]]) == 1  # all others show it, whatever the view itself does
    assert np.median(votes[1][truth[1]]) == pytest.approx((COUNT - 2) / (COUNT - 1))
    assert votes[1][:6, :6].max() < 0.5


def write_capture(folder: Path, images: list[np.ndarray]) -> None:
    (folder / "images").mkdir(parents=True)
    frames = []
    for i, (image, pose) in enumerate(zip(images, poses(), strict=False)):  # images may be few
        iio.imwrite(folder / "images" / f"{i:02d}.png", np.repeat(np.repeat(image, 4, axis=0), 4, axis=1))
        matrix = np.vstack((pose, (0, 0, 0, 1))).tolist()
        frames.append({"file_path": f"images/{i:02d}.png", "transform_matrix": matrix})
    lens = {"fl_x": 4 * FOCAL, "fl_y": 4 * FOCAL, "cx": 2 * SIZE, "cy": 2 * SIZE, "w": 4 * SIZE, "h": 4 * SIZE}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))


def test_the_command_writes_what_readers_find(
    tmp_path: Path, images: list[np.ndarray], truth: list[np.ndarray], monkeypatch: pytest.MonkeyPatch, edge_se: Any
) -> None:
    monkeypatch.setattr("edge_se_sampler.masks.command.MAX_SIDE", 160)  # of 480, in less time
    folder, count = tmp_path / "ring", 9
    write_capture(folder, images[:count])
    command = ["masks", "--data", folder, "--data-format", "transforms", "--output-path", tmp_path / "masks.png"]
    answer = edge_se(*command)
    assert answer.code == 0
    assert f"{count} masks in {folder / 'masks'}" in answer.out
    assert answer.out.rstrip().endswith("--masks object --data-format transforms")  # the same cameras
    assert sorted(path.name for path in (folder / "masks").iterdir()) == [f"{i:02d}.png.png" for i in range(count)]
    views = read_split(folder, "train", DataSettings(masks="object", downscale=4))
    assert views is not None
    for name, image in zip(views.names, views.images, strict=True):
        assert iou(image[..., 3] > 127, truth[int(name[-6:-4])]) > 0.93
    outlined = iio.imread(tmp_path / "masks.png")
    assert outlined.shape == (600, 1200, 3)
    assert (outlined == (230, 40, 40)).all(axis=2).any()

    before = {path: path.read_bytes() for path in (folder / "masks").iterdir()}
    answer = edge_se(*command)
    assert answer.code == 2
    assert "has a mask already" in answer.err
    assert before == {path: path.read_bytes() for path in (folder / "masks").iterdir()}


def test_masks_of_what_may_not_be_written_to_go_elsewhere(
    tmp_path: Path, images: list[np.ndarray], monkeypatch: pytest.MonkeyPatch, edge_se: Any
) -> None:
    found = [image[..., 0] > 127 for image in images[:4]]
    monkeypatch.setattr("edge_se_sampler.masks.command.segment", lambda *_: found)
    folder, out = tmp_path / "a ring", tmp_path / "elsewhere"
    write_capture(folder, images[:5])
    (folder / "images" / "04.png").unlink()
    answer = edge_se("masks", "--data", folder, "--out", out, "--output-path", tmp_path / "masks.png")
    assert answer.code == 0
    assert f"4 masks in {out / 'masks'}" in answer.out
    assert f"copy what is in {out} into {folder}" in answer.out
    assert f"--data '{folder}' --masks object" in answer.out
    assert "1 of the 5 listed images do not exist" in answer.err
    assert sorted(path.name for path in folder.iterdir()) == ["images", "transforms.json"]
    assert sorted(path.name for path in (out / "masks").iterdir()) == [f"{i:02d}.png.png" for i in range(4)]


def test_what_has_no_object_gets_no_masks(tmp_path: Path, images: list[np.ndarray], edge_se: Any) -> None:
    rng = np.random.default_rng(1)
    empty = [photograph(np.zeros((SIZE, SIZE), dtype=bool), rng) for _ in images[:4]]
    crowd = [unplain(rng) if i > 2 else image for i, image in enumerate(images)]
    cases = {
        "wall": (empty, "no object"),
        "few": (images[:2], "at least 3"),
        "crowd": (crowd, "only 3 of 12"),
    }
    for name, (some, problem) in cases.items():
        write_capture(tmp_path / name, some)
        answer = edge_se("masks", "--data", tmp_path / name, "--output-path", tmp_path / f"{name}.png")
        assert answer.code == 2
        assert problem in answer.err
        assert answer.err.count("\n") == 1
        assert sorted(path.name for path in (tmp_path / name).iterdir()) == ["images", "transforms.json"]
        assert not (tmp_path / f"{name}.png").exists()


def test_the_picture_does_not_take_the_masks_place(tmp_path: Path, images: list[np.ndarray], edge_se: Any) -> None:
    write_capture(tmp_path / "scene", images)
    answer = edge_se("masks", "--data", tmp_path / "scene", "--output-path", tmp_path / "scene" / "masks")
    assert answer.code == 2
    assert "must end in .png" in answer.err
    assert not (tmp_path / "scene" / "masks").exists()


def test_no_two_images_have_one_mask(tmp_path: Path, images: list[np.ndarray], edge_se: Any) -> None:
    scene = tmp_path / "ring"
    write_capture(scene, images)
    document = json.loads((scene / "transforms.json").read_text())
    first = scene / document["frames"][0]["file_path"]
    first.rename(scene / first.name)
    document["frames"][0]["file_path"] = first.name
    other = scene / document["frames"][1]["file_path"]
    other.rename(other.with_name(first.name))
    document["frames"][1]["file_path"] = f"images/{first.name}"
    (scene / "transforms.json").write_text(json.dumps(document))
    answer = edge_se("masks", "--data", scene, "--output-path", tmp_path / "masks.png")
    assert answer.code == 2, answer
    assert f"2 images would have the mask masks/{first.name}.png" in answer.err
    assert not (scene / "masks").exists()


def test_masks_lie_where_colmap_has_them(tmp_path: Path) -> None:
    folder = tmp_path.resolve()
    for image, mask in (
        ("images/a b/1.jpg", "masks/a b/1.jpg.png"),
        ("images_4/1.jpg", "masks_4/1.jpg.png"),
        ("train/r_0.png", "masks/train/r_0.png.png"),
        ("1.jpg", "masks/1.jpg.png"),
    ):
        assert place_of_mask(folder, folder / image) == folder / mask
    with pytest.raises(ValueError):
        place_of_mask(folder, folder.parent / "1.jpg")


@pytest.mark.slow
def test_an_object_that_moved_is_not_agreed_on(images: list[np.ndarray]) -> None:
    """Votes of wrong poses: nothing is left, rather than anything made up."""
    turned = [torch.from_numpy(image).roll(45, 1).numpy() if i % 2 else image for i, image in enumerate(images)]
    agreed = [mask.mean() for mask in segment(images, [LENS] * COUNT, poses())]
    moved = [mask.mean() for mask in segment(turned, [LENS] * COUNT, poses())]
    assert np.median(moved) < np.median(agreed)
