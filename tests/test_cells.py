"""Cells of images: what is drawn, its density, masks, mixed sizes, and changes of values."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from batches import MIXED, NUMBERS, SAME, batch_of, half_masks
from goodness import ALPHA, p_value, pixel_counts

from edge_se_sampler.sampling.cells import CellTable, cell_means
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.random_streams import Stream, stream

DRAWS = 40_000


def images(sizes: list[tuple[int, int]], masked: bool) -> ImageBatch:
    masks = half_masks(sizes) if masked else None
    if masks is not None:
        masks[0][:3, :] = False  # whole cells
        masks[0][4, :] = False
        masks[0][4, 5] = True  # a cell with a single pixel
    return ImageBatch.of(batch_of(sizes, masks=masks), use_mask=True)


def strengths(table: CellTable, batch: ImageBatch, k: int) -> np.ndarray:
    """(H, W) what each pixel's probability is in proportion to, pixel by pixel."""
    height, width = batch.sizes[k]
    rows, columns = min(height, table.side), min(width, table.side)
    values = table.values[table.first[k] :][: rows * columns].reshape(rows, columns).astype(np.float64)
    strength = np.array(
        [[values[y * rows // height, x * columns // width] for x in range(width)] for y in range(height)]
    )
    return strength * batch.valid(k).numpy() if batch.mask is not None else strength


def random_table(batch: ImageBatch, side: int, **options: bool) -> tuple[CellTable, torch.Tensor]:
    table = CellTable(side, **options)
    indices = table.add(batch)
    table.values[:] = np.random.default_rng(1).random(len(table.values)) + 0.2
    table.refresh()
    return table, indices


@pytest.mark.parametrize("across_images", [False, True])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(("sizes", "side"), [(SAME, 4), (MIXED, 3), (MIXED, 100)])
def test_pixels_are_drawn_in_proportion_to_their_cells_value(
    sizes: list, side: int, masked: bool, across_images: bool
) -> None:
    batch = images(sizes, masked)
    table, indices = random_table(batch, side, across_images=across_images)
    expected = [strengths(table, batch, k) for k in range(3)]
    total = sum(s.sum() for s in expected)
    expected = [s / total if across_images else s / s.sum() / 3 for s in expected]
    drawn = table.draw(indices, DRAWS, stream(0, 0, Stream.PIXELS))
    shapes = [np.zeros(size) for size in batch.sizes]
    for k, counts in enumerate(shapes):
        counts += pixel_counts(drawn[drawn[:, 0] == k, 1:], batch.sizes[k])
    counts, p = (np.concatenate([part.ravel() for part in parts]) for parts in (shapes, expected))
    assert p_value(counts, p) > ALPHA
    wrong = p * np.random.default_rng(3).uniform(0.7, 1.3, len(p))  # another sampler's
    assert p_value(counts, wrong / wrong.sum()) < ALPHA

    every = torch.cat([torch.nonzero(torch.ones(1, *size)) + torch.tensor([k, 0, 0]) for k, size in enumerate(sizes)])
    uniform = np.concatenate([(s > 0).ravel() / np.count_nonzero(s) / 3 for s in expected])
    ratio = table.density_ratio(indices, every).numpy()
    np.testing.assert_allclose((ratio * uniform), p, rtol=1e-5)


@pytest.mark.parametrize("across_images", [False, True])
def test_images_without_a_valid_pixel_count_in_no_ratio(across_images: bool) -> None:
    masks = half_masks(SAME)
    masks[1] = torch.zeros_like(masks[1])
    table, indices = random_table(
        ImageBatch.of(batch_of(SAME, masks=masks), use_mask=True), 4, across_images=across_images
    )
    valid = torch.cat([torch.nonzero(mask[None]) + torch.tensor([k, 0, 0]) for k, mask in enumerate(masks)])
    support = torch.tensor([mask.sum() for mask in masks])[valid[:, 0]]
    uniform = 1 / (2 * support.double())
    assert float((table.density_ratio(indices, valid) * uniform).sum()) == pytest.approx(1)


def test_changed_values_are_drawn_from_and_kept_bit_for_bit() -> None:
    batch = images(MIXED, masked=True)
    table, indices = random_table(batch, 100)
    cells = np.random.default_rng(2).choice(len(table.values), 50, replace=False)
    table.set(cells, np.linspace(0, 5, 50))
    loaded = CellTable.from_state(table.state_dict())
    assert torch.equal(loaded.add(batch), indices)
    for state in (table, loaded):
        state.set(cells[:7], np.arange(7.0))
    rng = [stream(0, 1, Stream.PIXELS) for _ in range(2)]
    assert torch.equal(table.draw(indices, 1000, rng[0]), loaded.draw(indices, 1000, rng[1]))
    refreshed = table._mass.copy()
    table.refresh()
    assert np.array_equal(table._mass, refreshed)


def test_images_that_are_added_later_change_nothing_of_the_others() -> None:
    batch = images(MIXED, masked=True)
    one = ImageBatch.of(
        {"image": [batch.per_pixel["image"][0]], "mask": [batch.mask[0]], "image_idx": torch.tensor(NUMBERS[:1])},
        use_mask=True,
    )
    table = CellTable(4)
    first = table.add(one)
    before = table.draw(first, 100, stream(0, 0, Stream.PIXELS))
    assert table.add(batch).tolist() == [0, 1, 2]
    assert torch.equal(table.draw(first, 100, stream(0, 0, Stream.PIXELS)), before)


def test_an_image_whose_errors_are_all_zero_is_drawn_uniformly_and_a_masked_one_never() -> None:
    batch = ImageBatch.of(
        batch_of(SAME, masks=[torch.ones(9, 14), torch.zeros(9, 14), torch.ones(9, 14)]), use_mask=True
    )
    table = CellTable(4)
    indices = table.add(batch)
    table.set(np.arange(16), np.zeros(16))
    assert table.drawable(indices).tolist() == [True, False, True]
    drawn = table.draw(indices[:1], 20_000, stream(0, 0, Stream.PIXELS))
    assert p_value(pixel_counts(drawn[:, 1:], (9, 14)), np.full((9, 14), 1 / 126)) > ALPHA


@pytest.mark.parametrize("larger", [1.0, 1e30])
def test_an_image_without_errors_is_drawn_uniformly_however_large_those_of_others_are(larger: float) -> None:
    sizes = [(12, 10)] * 3
    table = CellTable(10)  # several blocks an image
    indices = table.add(images(sizes, masked=False))
    table.values[:] = larger
    table.values[table.first[1] : table.first[2]] = 0
    table.refresh()
    drawn = table.draw(indices, DRAWS, stream(0, 0, Stream.PIXELS))
    counts = [pixel_counts(drawn[drawn[:, 0] == k, 1:], sizes[k]).ravel() for k in range(3)]
    assert p_value(np.concatenate(counts), np.full(360, 1 / 360)) > ALPHA
    np.testing.assert_allclose(table.density_ratio(indices, drawn).numpy(), 1, rtol=1e-5)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e39])
def test_values_that_are_not_finite_are_refused_before_they_are_drawn_from(value: float) -> None:
    table = CellTable(4)
    table.add(images(SAME, masked=True))
    before = table.values.copy()
    with pytest.raises(FloatingPointError, match="1 of 2 cells"):
        table.set(np.arange(2), np.array([1.0, value]))
    assert np.array_equal(table.values, before)
    with np.errstate(over="ignore"):
        table.values[3] = value
    with pytest.raises(FloatingPointError, match="not finite"):
        table.refresh()


def test_of_several_errors_in_a_cell_the_mean_counts() -> None:
    cells, means = cell_means(np.array([5, 2, 5]), np.array([1.0, 7.0, 2.0]))
    assert (cells.tolist(), means.tolist()) == ([2, 5], [7.0, 1.5])
