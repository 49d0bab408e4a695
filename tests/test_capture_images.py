"""The images of captures: sizes, orientations, what a lens does to their borders."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from capture_folder import (
    CY,
    HEIGHT,
    NAMES,
    OPENCV,
    WIDTH,
    Distortion,
    picture,
    read,
    transforms,
    turned_jpeg,
    write_colmap,
    write_transforms,
)

from edge_se_sampler import ranks
from edge_se_sampler.data import frames, memory
from edge_se_sampler.data.image_file import ImageHeader, read_header
from edge_se_sampler.data.lens import find_sources
from edge_se_sampler.data.scene_file import SourceFile, SourceLocation
from edge_se_sampler.data.transforms import read_transforms
from edge_se_sampler.engine.config import MANAGER, override
from edge_se_sampler.engine.session import _read_preview, _training_memory
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models.config import BYTES_PER_RAY, NeRFModelConfig, decide_size
from edge_se_sampler.models.nerf import NeRFModel


def test_rays_of_downscaled_images(tmp_path: Path) -> None:
    """A pixel's ray passes the middle of those that it is the average of."""
    write_colmap(tmp_path, OPENCV)
    large, small = read(tmp_path), read(tmp_path, downscale=2)
    coords = torch.tensor([[5.5, 7.5]], dtype=torch.float64)
    first = torch.zeros((1, 1), dtype=torch.int64)
    torch.testing.assert_close(
        small.cameras.generate_rays(first, coords).directions, large.cameras.generate_rays(first, 2 * coords).directions
    )
    np.testing.assert_allclose(
        small.images[0][5, 7], large.images[0][10:12, 14:16].mean(axis=(0, 1), dtype=np.float64), atol=0.51
    )


@pytest.mark.parametrize(("orientation", "stored"), [
    (6, lambda image: np.rot90(image)), (8, lambda image: np.rot90(image, -1)),
    (5, lambda image: image.swapaxes(0, 1)), (7, lambda image: np.rot90(image, 2).swapaxes(0, 1)),
])  # fmt: skip
def test_orientations_are_applied_where_the_size_says_so(orientation: int, stored: Any, tmp_path: Path) -> None:
    write_colmap(tmp_path)
    for i, name in enumerate(NAMES):
        (tmp_path / "images" / name).write_bytes(turned_jpeg(stored(picture(i)), orientation))
    difference = read(tmp_path).images[0].astype(int) - picture(1)
    assert np.abs(difference).mean() < 4  # JPEG's


def test_headers_of_pngs_are_read_without_their_pixels(tmp_path: Path) -> None:
    """Be it that an orientation stands behind these."""
    exif = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    chunk = len(exif).to_bytes(4, "big") + b"eXIf" + exif + zlib.crc32(b"eXIf" + exif).to_bytes(4, "big")
    content = iio.imwrite("<bytes>", picture(0), extension=".png")
    path = tmp_path / "a.png"
    file = SourceFile(path, SourceLocation(path))
    path.write_bytes(content[:-12] + chunk + content[-12:])
    assert read_header(file) == ImageHeader(WIDTH, HEIGHT, 3, 6)
    path.write_bytes(content[: content.index(b"IDAT") + 8])
    assert read_header(file) == ImageHeader(WIDTH, HEIGHT, 3, 1)


def test_an_image_of_more_pixels_than_pillow_opens_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_colmap(tmp_path)
    monkeypatch.setattr("PIL.Image.MAX_IMAGE_PIXELS", WIDTH * HEIGHT // 2 - 1)
    with pytest.raises(InputError, match=r"has more than [\d,]+ pixels; make it smaller"):
        read(tmp_path)


def test_orientations_that_the_camera_ignored(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    for i, name in enumerate(NAMES):
        (tmp_path / "images" / name).write_bytes(turned_jpeg(picture(i), 6))
    assert np.abs(read(tmp_path).images[0].astype(int) - picture(1)).mean() < 4


def test_orientations_that_may_mean_either(tmp_path: Path) -> None:
    """COLMAP, which turns none, saw the stored image; of who wrote a transforms.json that is not known."""
    write_colmap(tmp_path)
    (tmp_path / "images" / NAMES[3]).write_bytes(turned_jpeg(picture(3), 3))
    assert np.abs(read(tmp_path).images[2].astype(int) - picture(3)).mean() < 4
    (tmp_path / "transforms.json").write_text(json.dumps(transforms()))
    with pytest.raises(InputError, match=r"frames\[3\].file_path: .*EXIF orientation 3"):
        read(tmp_path)


def test_more_than_the_machine_has_is_refused_before_decoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_transforms(tmp_path)
    monkeypatch.setattr(memory, "MIN_SIDE", 8)
    monkeypatch.setattr("edge_se_sampler.data.frames.read_image", None)  # would not be callable
    third = 7 * (WIDTH // 3) * (HEIGHT // 3) * (2 * 3 + memory.BYTES_OF_TABLES)
    for available, of_pixel, remedy in (
        (third, 0, "give --downscale 3"),
        (third, 200, "give --downscale 4"),  # the model's is in proportion to the longest side
        (third // 100, 0, "give fewer images"),
        (third, third, "train a smaller model"),
    ):
        monkeypatch.setattr(memory, "available_memory", lambda available=available: available)
        with pytest.raises(InputError, match=rf"transforms\.json: training on its 7 images takes .*; {remedy}"):
            read(tmp_path, model_memory=lambda _, longest, of_pixel=of_pixel: of_pixel * longest)


def test_what_training_takes_is_known_of_views_that_were_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_transforms(tmp_path)
    monkeypatch.setattr(memory, "available_memory", lambda: 3 * 2**30)

    def of_pixels(has_alpha: bool, longest: int) -> int:
        return longest * 2 ** (22 if has_alpha else 23)

    of_model = read(tmp_path, model_memory=of_pixels).subset([0, 2])
    assert of_model.memory == "images 0.1 MiB, tables 0.3 MiB, model up to 0.4 GiB; 3.0 GiB available"
    of_sampler = read(tmp_path, downscale=2, model_memory=lambda *_: 0)
    assert of_sampler.memory == "images 0.0 MiB, tables 0.1 MiB; 3.0 GiB available"
    for i, name in enumerate(NAMES):
        iio.imwrite(tmp_path / "images" / name, np.dstack((picture(i), picture(i)[..., 0])))
    assert "model up to 0.2 GiB" in read(tmp_path, model_memory=of_pixels).memory


def test_images_that_nothing_is_trained_on_take_themselves_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_transforms(tmp_path)
    size = 2 * WIDTH * HEIGHT * 3
    monkeypatch.setattr(memory, "available_memory", lambda: size)
    assert len(read(tmp_path, "test").names) == 2
    monkeypatch.setattr(memory, "available_memory", lambda: size - 1)
    with pytest.raises(InputError, match=r"transforms\.json: its 2 images take .*; .* train with a larger --downscale"):
        read(tmp_path, "test")


def test_of_the_held_out_views_training_reads_the_first_that_tells_anything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_transforms(tmp_path)
    names, reads = read(tmp_path, "test").names, []
    read_image = frames.read_image
    monkeypatch.setattr(frames, "read_image", lambda file: (reads.append(file), read_image(file))[1])
    config = override(method_configs()["lean-nerf"], {"data": tmp_path})
    preview = _read_preview(config)
    assert preview is not None
    assert (preview.name, len(reads)) == (names[0], 1)
    (tmp_path / "masks").mkdir()
    iio.imwrite(tmp_path / "masks" / Path(names[0]).name, np.zeros((HEIGHT, WIDTH), np.uint8))
    preview = _read_preview(config)
    assert preview is not None
    assert preview.name == names[1]
    assert "left out" not in capsys.readouterr().err


def test_processes_share_what_a_machine_has(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_available_on_machine", lambda: 2**32)
    monkeypatch.setattr(memory, "_available_in_container", lambda: None)
    assert memory.available_memory() == 2**32
    monkeypatch.setattr(ranks, "_world_size", 8)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")  # on four machines
    assert memory.available_memory() == 2**31


@pytest.mark.parametrize("size", ["paper", "small", "tiny"])
def test_weights_and_their_moments_are_in_the_estimate(size: Any) -> None:
    config = NeRFModelConfig(size=size)
    weights = sum(weight.numel() for weight in NeRFModel(config, np.random.default_rng(0)).parameters())
    of_points = 2 * 4 * config.preset.width * (config.preset.depth + 2) * 2**14
    assert 16 * weights < config.training_memory(True, 1024) - of_points < 1.5 * 16 * weights


def test_the_rays_that_a_step_has_are_in_the_estimate() -> None:
    default = override(method_configs()["lean-nerf"], {"machine.device_type": "cpu"})
    more, too_many = (override(default, {f"{MANAGER}.train_num_rays_per_batch": 2**n}) for n in (16, 20))
    estimates = [_training_memory(config, True, 100) for config in (default, more, too_many)]
    rays = decide_size(default.pipeline.model, 100).preset.rays
    assert estimates[1] - estimates[0] == BYTES_PER_RAY * (2**16 - rays)
    assert estimates[2] == estimates[1]  # they are looked at in parts


def test_train_and_inspect_say_what_training_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, edge_se: Any
) -> None:
    write_transforms(tmp_path / "scene")
    monkeypatch.setattr(memory, "available_memory", lambda: 3 * 2**30)
    flags = ["--data", tmp_path / "scene"]
    training = ["--output-dir", tmp_path, "--max-num-iterations", "1", "--machine.device-type", "cpu"]
    answers = [
        edge_se("inspect", *flags, "--output-path", tmp_path / "x.png"),
        edge_se("train", "lean-nerf", *flags, *training),
    ]
    found = [re.search(r"^memory +(.*)$", answer.out, re.MULTILINE) for answer in answers]
    assert [match and match[1] for match in found] == [
        "images 0.1 MiB, tables 0.3 MiB, model up to 0.3 GiB; 3.0 GiB available"
    ] * 2


READ = """
import resource, sys
from pathlib import Path
from edge_se_sampler.data.dataset import DataSettings, read_split

train = read_split(Path(sys.argv[1]), "train", DataSettings(downscale=8, eval_every=300))
print(len(train.images), train.images[0].shape, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


@pytest.mark.slow
def test_300_large_photographs_are_read_within_2_gib(tmp_path: Path) -> None:
    """Of 12 million pixels each, whose lens is undone: decoded they would take 10 GiB."""
    (tmp_path / "images").mkdir()
    file = tmp_path / "images" / "0.jpg"
    noise = np.random.default_rng(0).integers(0, 256, (300, 400, 3), dtype=np.uint8)
    iio.imwrite(file, noise.repeat(10, axis=0).repeat(10, axis=1))
    for i in range(1, 300):
        os.link(file, file.with_name(f"{i}.jpg"))
    large = {"w": 4000, "h": 3000, "fl_x": 3600, "fl_y": 3600, "cx": 2000, "cy": 1500}
    document: dict[str, Any] = transforms(OPENCV) | large
    frame = document["frames"][0]
    document["frames"] = [frame | {"file_path": f"images/{i}.jpg"} for i in range(300)]
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    command = [sys.executable, "-c", READ, str(tmp_path)]
    answer = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
    *read_images, kilobytes = answer.rsplit(maxsplit=1)
    assert read_images == ["299 (375, 500, 3)"]
    assert int(kilobytes) < 2 * 2**20


@pytest.mark.parametrize(("limit", "expected"), [("1000", 700), ("400", 100), ("max", None)])
def test_a_containers_memory_counts(limit: str, expected: int | None, tmp_path: Path) -> None:
    (tmp_path / "memory.max").write_text(f"{limit}\n")
    (tmp_path / "memory.current").write_text("500\n")
    (tmp_path / "memory.stat").write_text("anon 300\ninactive_file 200\n")
    assert memory._available_in_container(tmp_path) == expected
    assert memory._available_in_container(tmp_path / "none") is None


def test_pixels_that_show_nothing_are_masked(tmp_path: Path) -> None:
    """A principal point outside leaves no zoom at which all pixels show something."""
    document = write_transforms(tmp_path, OPENCV) | {"cx": 70.0, "k1": 0.3}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    masks = read(tmp_path).masks
    assert masks is not None
    assert 0 < masks[0].mean() < 1


def test_a_polynomial_that_turns_back_shows_no_pixel_twice(tmp_path: Path) -> None:
    document = write_transforms(tmp_path, Distortion("OPENCV", {"k1": -1.2}))
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    frame = read_transforms(tmp_path).frames[0]
    sources, inside = find_sources(frame.camera, frame.pinhole, WIDTH, HEIGHT)
    row = round(CY)
    shown = np.diff(sources[0, row][inside[row]])
    assert (shown > 0).all()


def test_transparent_colors_do_not_show_between_pixels(tmp_path: Path) -> None:
    """Red in front of transparent green stays red where the lens's image falls between both."""
    write_colmap(tmp_path, OPENCV)
    image = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    image[...] = (0, 255, 0, 0)
    image[8:25, 9:30] = (255, 0, 0, 255)
    for name in NAMES:
        iio.imwrite(tmp_path / "images" / name, image)
    shown = read(tmp_path).images[0]
    partly = (shown[..., 3] > 0) & (shown[..., 3] < 255)
    assert partly.sum() > 20
    assert (shown[shown[..., 3] > 0][:, :3] == (255, 0, 0)).all()
