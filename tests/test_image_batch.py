"""A host's batch, stacked or in lists, seen one way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from batches import MIXED, NUMBERS, SAME, batch_of, half_masks, picture

from edge_se_sampler.sampling.image_batch import ImageBatch, unit_interval

SOME = torch.tensor([[2, 4, 3], [0, 8, 5], [1, 0, 0], [2, 0, 4], [0, 8, 5]])


@pytest.mark.parametrize(("sizes", "stacked"), [(SAME, True), (SAME, False), (MIXED, False)])
@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_every_key_is_gathered_at_the_drawn_pixels(sizes: Any, stacked: bool, channels: int, dtype: Any) -> None:
    host = batch_of(sizes, channels=channels, dtype=dtype, masks=half_masks(sizes), stacked=stacked)
    pixels = ImageBatch.of(host, use_mask=True).gather(SOME)
    assert set(pixels) == {"image", "address", "mask", "indices"}
    assert pixels["image"].dtype == dtype
    assert pixels["image"].shape == (len(SOME), channels)
    assert pixels["mask"].shape == (len(SOME), 1)
    for row, (position, y, x) in enumerate(SOME.tolist()):
        assert torch.equal(pixels["image"][row], host["image"][position][y, x])
        assert torch.equal(pixels["mask"][row], host["mask"][position][y, x])
        assert pixels["indices"][row].tolist() == [NUMBERS[position], y, x]
    assert torch.equal(pixels["address"], pixels["indices"])


@pytest.mark.parametrize(("sizes", "stacked"), [(SAME, True), (MIXED, False)])
def test_sizes_numbers_and_images(sizes: Any, stacked: bool) -> None:
    batch = ImageBatch.of(batch_of(sizes, channels=4, stacked=stacked), use_mask=True)
    assert batch.sizes == sizes
    assert batch.numbers.tolist() == NUMBERS
    assert batch.mask is None
    for k, (number, size) in enumerate(zip(NUMBERS, sizes, strict=True)):
        np.testing.assert_array_equal(batch.image(k), picture(number, size, 4, torch.uint8).numpy())


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.float32])
@pytest.mark.parametrize(("sizes", "stacked"), [(SAME, True), (MIXED, False)])
def test_valid_is_where_the_mask_is_not_zero(dtype: torch.dtype, sizes: Any, stacked: bool) -> None:
    masks = half_masks(sizes)
    host = batch_of(sizes, masks=[mask.to(dtype) * (1 if dtype == torch.bool else 0.5) for mask in masks])
    batch = ImageBatch.of(host, use_mask=True)
    if dtype == torch.uint8:  # 0.5 is 0 there
        host = batch_of(sizes, masks=[mask.to(dtype) * 255 for mask in masks], stacked=stacked)
        batch = ImageBatch.of(host, use_mask=True)
    for k, mask in enumerate(masks):
        assert batch.valid(k).dtype == torch.bool
        assert torch.equal(batch.valid(k), mask)


def test_a_mask_that_is_not_used_is_still_gathered() -> None:
    batch = ImageBatch.of(batch_of(masks=half_masks(SAME)), use_mask=False)
    assert batch.mask is None
    assert "mask" in batch.gather(SOME[1:3])


def test_keys_without_a_value_are_left_out() -> None:
    pixels = ImageBatch.of(batch_of() | {"depth_image": None}, use_mask=True).gather(SOME[1:3])
    assert set(pixels) == {"image", "address", "indices"}


def test_one_channel_maps_without_a_channel_axis() -> None:
    depth = torch.rand(3, 9, 14)
    pixels = ImageBatch.of(batch_of() | {"depth_image": depth}, use_mask=True).gather(SOME[[1, 2]])
    assert torch.equal(pixels["depth_image"], torch.stack((depth[0, 8, 5], depth[1, 0, 0])))


@pytest.mark.parametrize(
    "value",
    [
        torch.zeros(2, 9, 14),  # an image too few
        torch.zeros(3, 14, 9),
        torch.zeros(3, 9, 13, 1),
        [torch.zeros(9, 14), torch.zeros(9, 14)],
        [torch.zeros(9, 14), torch.zeros(9, 14), torch.zeros(9, 15)],
    ],
)
def test_a_key_that_does_not_fit_the_images_is_refused(value: Any) -> None:
    with pytest.raises(ValueError, match="image batch: 'depth_image' has not one"):
        ImageBatch.of(batch_of() | {"depth_image": value}, use_mask=True)


@pytest.mark.parametrize("value", ["a name", torch.zeros(3), [0.5, 0.5, 0.5], 7])
def test_a_key_that_holds_no_pixels_is_refused(value: Any) -> None:
    with pytest.raises(ValueError, match="image batch: 'near'"):
        ImageBatch.of(batch_of() | {"near": value}, use_mask=True)


@pytest.mark.parametrize("count", [2, 4])
def test_as_many_numbers_as_images(count: int) -> None:
    with pytest.raises(ValueError, match="image_idx"):
        ImageBatch.of(batch_of() | {"image_idx": torch.arange(count)}, use_mask=True)


def test_the_hosts_batch_is_not_touched() -> None:
    host = batch_of(masks=half_masks(SAME))
    kept = {key: value.clone() for key, value in host.items()}
    pixels = ImageBatch.of(host, use_mask=True).gather(SOME[1:3])
    for value in pixels.values():
        value.zero_()
    assert set(host) == set(kept)
    assert all(torch.equal(host[key], kept[key]) for key in kept)


def test_uint8_is_scaled_to_the_unit_interval_and_floats_are_kept() -> None:
    assert unit_interval(torch.tensor([0, 51, 255], dtype=torch.uint8)).tolist() == pytest.approx([0, 0.2, 1])
    assert unit_interval(torch.tensor([255], dtype=torch.uint8)).tolist() == [1.0]
    floats = torch.tensor([0.25, 1.0])
    assert unit_interval(floats) is floats
