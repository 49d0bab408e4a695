"""LLFF's poses_bounds.npy: its axes, sizes and depths; and files that cannot be used."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from capture_folder import FX, HEIGHT, NAMES, WIDTH, bounds, poses, read, write_colmap, write_images, write_llff

from edge_se_sampler.data.dataset import DataSettings, find_format, read_split
from edge_se_sampler.errors import InputError
from edge_se_sampler.occupancy.depths import find_depths


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_rays_and_depths(scale: float, tmp_path: Path) -> None:
    """A ray through the middle of a pixel, by LLFF's own code: K^-1 [u, v, 1] along right, up and back."""
    write_llff(tmp_path, bounds(scale))
    views = read(tmp_path)
    assert (views.data_format, views.names, views.masks) == ("llff", tuple(NAMES[1:8]), None)
    pixel = torch.tensor([[2, 5, 7]])
    ray = views.cameras.pixel_rays(pixel)
    x, y = (7.5 - WIDTH / 2) / FX, -(5.5 - HEIGHT / 2) / FX
    expected = poses()[3][:3, :3] @ (x, y, -1)
    np.testing.assert_allclose(ray.directions[0], expected / np.linalg.norm(expected), atol=1e-12)
    np.testing.assert_allclose(ray.origins[0], poses()[3][:3, 3], atol=1e-12)
    found = find_depths(views)
    assert found.near == pytest.approx(0.9 * 2, rel=1e-3)
    assert found.far == pytest.approx(1.1 * 8, rel=1e-3)


def test_masks_of_instant_ngps_are_no_images(tmp_path: Path) -> None:
    write_llff(tmp_path, bounds())
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, :9] = 255
    iio.imwrite(tmp_path / "images" / f"dynamic_mask_{Path(NAMES[1]).stem}.png", mask)
    views = read(tmp_path)
    assert views.names == tuple(NAMES[1:8])
    assert views.masks is not None
    np.testing.assert_array_equal(views.masks[0], mask == 0)


def test_a_model_of_colmap_beside_it_says_more(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", bounds())
    assert find_format(tmp_path) == "colmap"
    assert find_format(tmp_path, "llff") == "llff"


def changed(row: int, column: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(rows: np.ndarray) -> np.ndarray:
        rows[row, column] = value
        return rows

    return change


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda rows: rows[:-1], "has 8 poses, images has 9 images"),
        (lambda rows: rows[:, :15], r"has the shape \(9, 15\)"),
        (lambda rows: rows[:0], r"has the shape \(0, 17\)"),
        (lambda rows: rows.astype(str), "is not a file of numbers"),
        (lambda rows: rows + 1j, "is not a file of numbers"),
        (lambda rows: rows.astype(object), "is not a file of numbers"),
        (changed(3, 2, np.nan), r"\[3\]: is not finite"),
        (changed(3, 0, 0.9), r"\[3\]: its pose is no rotation"),
        (changed(2, 14, 0.0), r"\[2\]: its height, width or focal length"),
        (changed(1, 15, 9.0), r"\[1\]: its depths are 9 and 8"),
        (changed(1, 16, 1e300), r"\[1\]: its depths are 2 and 1e\+300"),
        (changed(1, 14, 1e300), r"\[1\]: 'view 01.png' .* focal length is 1e\+300"),
        (changed(1, 3, -1e300), r"\[1\]: 'view 01.png' has its camera at -1e\+300"),
        (changed(0, 4, 99.0), r"view 00.png' is 48 x 36 pixels, its camera's images 48 x 99"),
    ],
)
def test_files_that_cannot_be_used(change: Callable[[np.ndarray], np.ndarray], says: str, tmp_path: Path) -> None:
    write_llff(tmp_path, change(bounds()))
    with pytest.raises(InputError, match=says):
        read_split(tmp_path, "train", DataSettings())


@pytest.mark.parametrize("data", [b"", b"\x93NUMPY", b"PK\x03\x04", b"1 2 3"])
def test_files_that_are_none(data: bytes, tmp_path: Path) -> None:
    write_images(tmp_path / "images")
    (tmp_path / "poses_bounds.npy").write_bytes(data)
    with pytest.raises(InputError, match=r"poses_bounds\.npy: (is empty|is not a file of numbers)"):
        read_split(tmp_path, "train", DataSettings())
