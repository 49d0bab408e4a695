"""Regions, quadtree and expansive supervision: their rules against slow references, and what every strategy must do."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from batches import MIXED, NUMBERS, SAME, batch_of, following, half_masks
from goodness import ALPHA, mean_is, p_value, pixel_counts
from tiny import resume_trainer, tiny_config, tiny_trainer, tiny_views
from torch import Tensor

from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs
from edge_se_sampler.sampling import quadtree
from edge_se_sampler.sampling.edges import color_change, edge_strength
from edge_se_sampler.sampling.expansive import ANCHOR_AREA, anchors
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.parts import TrainingStep
from edge_se_sampler.sampling.pixel_sampler import EdgeSEPixelSampler
from edge_se_sampler.sampling.quadtree import LEARNT_PIXELS, MAX_LEVEL, SIDE, START_LEVEL, Forest, leaf_strength
from edge_se_sampler.sampling.regions import FLOOR, WINDOW_PIXELS, classify

STRATEGIES = ("regions", "quadtree", "expansive")
LEARNING = STRATEGIES[:2]
SIZES = [(9, 14), (40, 30), (5, 5)]
"""One image whose leaves have more pixels than LEARNT_PIXELS."""


def smooth_batch(sizes: list[tuple[int, int]], masked: bool = False, channels: int = 4) -> dict[str, Any]:
    """Images that are flat at the top, and vary more and more to the right below."""
    host = batch_of(sizes, channels=channels, stacked=False, masks=half_masks(sizes) if masked else None)
    for image in host["image"]:
        ramp = np.linspace(0.1, 1, image.shape[1])[:, None]
        image[:] = torch.from_numpy((cv2.blur(image.numpy(), (3, 3)) * ramp).astype(np.uint8))
        image[: len(image) // 3, :, :] = 255
    return host


def error_at(pixels: dict[str, Any]) -> Tensor:
    """Squared errors that depend on the pixel alone: large on the right, small where it is flat."""
    column = pixels["indices"][:, 2].double()
    return 0.0005 + column / 50 * (pixels["image"].double().std(dim=1) > 5)


def part_of(sampler: Any, strategy: str) -> Any:
    """The distribution of a strategy."""
    return sampler.strategies[strategy].distribution


def trained(strategy: str, host: dict[str, Any], steps: int = 40, **settings: Any) -> EdgeSEPixelSampler:
    """A sampler that has learnt for some steps of a late phase."""
    sampler = following(rays=64, planned=10, late=strategy, early="uniform", early_fraction=0.0, **settings)
    for step in range(steps):
        sampler.set_step(step)
        sampler.observe(error_at(sampler.sample(host)))
    return sampler


def reference(sampler: EdgeSEPixelSampler, host: dict[str, Any], k: int) -> np.ndarray:
    """(H, W) p of an image's pixels, by the rules and what the sampler has learnt."""
    name = sampler.config.late
    image, part = host["image"][k].numpy(), part_of(sampler, name)
    valid = host["mask"][k][..., 0].numpy() if "mask" in host else np.ones(image.shape[:2], dtype=bool)
    change = color_change(image)
    if name == "regions":
        means = [part.errors[r] for r in range(3)]
        strength = np.array([[max(means[r] / max(means), FLOOR) for r in row] for row in classify(change)])
    elif name == "quadtree":
        level = part.forest.level[part.forest.row[int(host["image_idx"][k])]]
        strength = slow_leaf_strength(change, valid, level, part.forest.deepest)
    else:
        anchor = anchors(edge_strength(image))
        strength = np.where(anchor, 0.5 / anchor.sum(), 0.5 / (~anchor).sum())
    strength = strength * valid
    return strength / strength.sum()


# ---- color change and what is made of it


@pytest.mark.parametrize("channels", [3, 4])
def test_color_change_is_the_deviation_of_the_neighborhood(channels: int) -> None:
    image = batch_of([(7, 9)], [3], channels=channels)["image"][0].numpy()
    image[2:6, 2:6] = 90
    background = (0.0, 0.5, 1.0)
    color = image[..., :3] / 255.0
    if channels == 4:
        alpha = image[..., 3:] / 255.0
        color = color * alpha + np.array(background) * (1 - alpha)
    gray = np.pad(np.rint(255 * color @ np.array([0.299, 0.587, 0.114])), 1, mode="edge")
    expected = [[gray[y : y + 3, x : x + 3].std() / 255 for x in range(9)] for y in range(7)]
    found = color_change(image, background)
    np.testing.assert_allclose(found, expected, atol=2**-17 + 1e-7)
    assert np.array_equal(found, np.rint(found * 2**16) / 2**16)
    assert not found[3:5, 3:5].any()
    np.testing.assert_array_equal(color_change(image.astype(np.float32) / 255, background), found)


def test_regions_are_split_at_the_mean_and_at_the_mean_above_it() -> None:
    change = color_change(smooth_batch([(20, 30)] * 3)["image"][1].numpy())
    values = [float(d) for d in change.ravel()]
    mean = math.fsum(values) / len(values)
    above = [d for d in values if d > mean]
    second = math.fsum(above) / len(above)
    expected = [0 if d <= mean else 1 if d <= second else 2 for d in values]
    assert classify(change).ravel().tolist() == expected
    assert set(expected) == {0, 1, 2}
    assert not classify(np.full((4, 5), 0.25, dtype=np.float32)).any()


def test_anchors_are_the_pixels_with_the_strongest_edges() -> None:
    edges = edge_strength(smooth_batch([(60, 50)] * 3)["image"][0].numpy())
    anchor = anchors(edges)
    assert ANCHOR_AREA <= anchor.mean() <= ANCHOR_AREA + 0.02
    assert edges[anchor].min() > edges[~anchor].max() - edges.max() / 1000
    assert not anchors(np.zeros((6, 7), dtype=np.float32)).any()
    few = np.zeros((6, 7), dtype=np.float32)
    few[2, 3:5] = 1e-4, 0.8
    assert np.array_equal(anchors(few), few > 0)


# ---- the quadtree


def slow_leaf_strength(change: np.ndarray, valid: np.ndarray, level: np.ndarray, deepest: int) -> np.ndarray:
    height, width = change.shape
    leaves: dict[tuple[int, int, int], list[tuple[int, int]]] = {}
    for y, x in np.argwhere(valid).tolist():
        row, column = math.floor(y / height * SIDE), math.floor(x / width * SIDE)
        depth = int(level[row, column])
        side = SIDE // 2**depth
        leaves.setdefault((depth, row // side, column // side), []).append((y, x))
    strength = np.zeros((height, width))
    floor = max(0.01 * float(change.mean(dtype=np.float64)), 2**-16)
    for (depth, _, _), pixels in leaves.items():
        weight = len(pixels) if depth == deepest else min(len(pixels), LEARNT_PIXELS)
        c = [max(float(change[at]), math.ceil(floor * 2**16) / 2**16) for at in pixels]
        for at, own in zip(pixels, c, strict=True):
            strength[at] = weight / 2 * (1 / len(pixels) + own / sum(c))
    return strength


def random_tree(seed: int) -> np.ndarray:
    """Levels of a tree that is subdivided at random down to the smallest cells."""
    rng, level = np.random.default_rng(seed), np.full((SIDE, SIDE), START_LEVEL)
    for deeper in range(START_LEVEL + 1, MAX_LEVEL + 1):
        side = SIDE >> (deeper - 1)
        grown = (rng.random((SIDE // side, SIDE // side)) < 0.6).repeat(side, axis=0).repeat(side, axis=1)
        level[grown & (level == deeper - 1)] = deeper
    return level.astype(np.uint8)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", [(40, 70), (5, 33), (1, 1)])
def test_a_leaf_is_drawn_by_its_weight_half_of_it_by_color_change(size: tuple[int, int], masked: bool) -> None:
    rng = np.random.default_rng(0)
    change = np.rint(rng.random(size) ** 6 * 2**15).astype(np.float32) / 2**16
    change[: size[0] // 2] = 0
    valid = rng.random(size) < 0.5 if masked else np.ones(size, dtype=bool)
    for level, deepest in ((random_tree(1), MAX_LEVEL), (np.full((SIDE, SIDE), 2, dtype=np.uint8), 2)):
        found = leaf_strength(change, valid, level, deepest)
        np.testing.assert_allclose(found, slow_leaf_strength(change, valid, level, deepest), rtol=1e-6)


def test_open_leaves_with_large_errors_are_subdivided_when_enough_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quadtree, "PIXELS_PER_LEAF", 3)
    forest, rng, threshold = Forest(), np.random.default_rng(0), 0.1
    forest.add([7, 3])
    rows = columns = trees = np.zeros(0, dtype=np.int64)
    squared = np.zeros(0)
    judged, unseen = [], 0
    for step in range(200):
        n = 50
        cells = rng.integers(0, 2, n), rng.integers(0, SIDE, n), rng.integers(0, SIDE, n)
        error = 3 * threshold**2 * rng.random(n) * (0.2 + 2 * (cells[2] > 10))
        trees, rows, columns = (np.append(a, b) for a, b in zip((trees, rows, columns), cells, strict=True))
        squared = np.append(squared, error)
        before, deepest = forest.level.copy(), forest.deepest
        forest.observe(cells, error)
        side = SIDE >> deepest
        corners = before[:, ::side, ::side] == deepest
        enough = deepest < MAX_LEVEL and corners.any() and len(squared) >= 3 * corners.sum()
        assert forest.subdivide(threshold) == enough, step
        if not enough:
            assert np.array_equal(forest.level, before)
            continue
        for tree, row, column in np.argwhere(np.ones(corners.shape)).tolist():
            inside = (trees == tree) & (rows // side == row) & (columns // side == column)
            found = squared[inside]
            is_large = not len(found) or math.sqrt(found.mean() / 3) > threshold  # what nobody looked at stays open
            grows, unseen = corners[tree, row, column] and is_large, unseen + (not len(found))
            block = np.s_[tree, row * side : (row + 1) * side, column * side : (column + 1) * side]
            assert np.array_equal(forest.level[block], np.full((side, side), deepest + 1) if grows else before[block])
        rows = columns = trees = np.zeros(0, dtype=np.int64)
        squared = np.zeros(0)
        judged.append(deepest)
    assert judged == [2, 3, 4]
    assert unseen
    assert set(np.unique(forest.level)) == {2, 3, 4, 5}


def test_leaves_without_a_pixel_to_draw_are_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither those that are masked, nor those of an image of fewer pixels than cells."""
    monkeypatch.setattr(quadtree, "PIXELS_PER_LEAF", 3)
    mask = torch.zeros((40, 40), dtype=torch.bool)
    mask[:10, :20] = True  # 2 leaves of the 16 of level 2, 8 of level 3 and 32 of level 4
    host = batch_of([(40, 40), (3, 3)], [1, 2], stacked=False, masks=[mask, torch.ones((3, 3), dtype=torch.bool)])
    sampler = following(rays=1, planned=10, late="quadtree", early="uniform", early_fraction=0.0, images_per_step="all")
    part = part_of(sampler, "quadtree")
    judged = []
    for step in range(400):
        before = part.forest.deepest
        sampler.set_step(step)
        sampler.observe(3.0 + 0 * error_at(sampler.sample(host)))
        judged += [step + 1] * (part.forest.deepest > before)
    leaves = np.array([2 + 9, 8 + 9, 32 + 9])  # the small image has 9 cells with a pixel at any level
    assert judged == (3 * leaves).cumsum().tolist()
    level = part.forest.level[0]
    assert (level[:8, :16] == MAX_LEVEL).all()
    assert (level[8:] == START_LEVEL).all()


def test_an_image_that_is_met_later_begins_with_open_leaves() -> None:
    host = smooth_batch(SAME)
    sampler = trained("quadtree", {key: value[:2] for key, value in host.items()}, steps=80)
    part = part_of(sampler, "quadtree")
    assert part.forest.deepest > START_LEVEL
    before = part.forest.level.copy()
    sampler.sample(host)
    assert np.array_equal(part.forest.level[:2], before)
    assert (part.forest.level[2] == part.forest.deepest).all()


# ---- regions' errors


def test_a_regions_error_is_a_running_mean() -> None:
    host = smooth_batch(MIXED)
    sampler = following(rays=5000, planned=10, late="regions", early_fraction=0.0, images_per_step="all")
    part = part_of(sampler, "regions")
    assert part.region_strength.tolist() == [1, 1, 1]
    mean, seen = [0.0] * 3, [0.0] * 3
    for step in range(8):
        sampler.set_step(step)
        pixels = sampler.sample(host)
        error = error_at(pixels)
        sampler.observe(error)
        regions = {
            int(n): classify(color_change(i.numpy())) for n, i in zip(host["image_idx"], host["image"], strict=True)
        }
        of_pixel = [int(regions[n][y, x]) for n, y, x in pixels["indices"].tolist()]
        for r in range(3):
            found = [e for e, region in zip(error.tolist(), of_pixel, strict=True) if region == r]
            seen[r] = min(seen[r] + len(found), WINDOW_PIXELS)
            mean[r] += len(found) / seen[r] * (sum(found) / len(found) - mean[r])
    np.testing.assert_allclose(part.errors, mean, rtol=1e-9)
    assert max(seen) == WINDOW_PIXELS
    np.testing.assert_allclose(part.region_strength, [max(e / max(mean), FLOOR) for e in mean], rtol=1e-9)


def test_no_region_is_forgotten() -> None:
    part = part_of(following(late="regions"), "regions")
    part.load_state_dict({"errors": [0.0, 2.0, 0.0], "seen": [5.0, 5.0, 0.0]})
    assert part.region_strength.tolist() == [FLOOR, 1, 1]
    part.load_state_dict({"errors": [0.0, 0.0, 0.0], "seen": [5.0, 5.0, 0.0]})
    assert part.region_strength.tolist() == [1, 1, 1]


@pytest.mark.parametrize("strategy", LEARNING)
def test_errors_of_pixels_drawn_otherwise_are_not_learnt_from(strategy: str) -> None:
    host = smooth_batch(SAME)
    sampler = following(0, late=strategy, early="edge")
    part = part_of(sampler, strategy)
    pixels = sampler.sample(host)
    before = part.state_dict()
    sampler.observe(error_at(pixels))
    assert str(part.state_dict()) == str(before)
    sampler.set_step(500)
    sampler.observe(error_at(sampler.sample(host)))
    assert str(part.state_dict()) != str(before)


# ---- what is drawn


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_pixels_are_drawn_as_the_rule_says(strategy: str, masked: bool) -> None:
    host = smooth_batch(SIZES, masked)
    sampler = trained(strategy, host, images_per_step="all")
    p = [reference(sampler, host, k) for k in range(3)]
    sampler.set_num_rays_per_batch(60_000)
    drawn = sampler.sample(host)["indices"]
    counts = [
        pixel_counts(drawn[drawn[:, 0] == number][:, 1:], size).ravel()
        for number, size in zip(NUMBERS, SIZES, strict=True)
    ]
    expected = np.concatenate([image.ravel() for image in p]) / 3
    enough = (expected == 0) | (expected * 60_000 >= 5)
    counts, rest = np.concatenate(counts), expected[~enough].sum()
    counts = np.append(counts[enough], counts[~enough].sum())
    assert p_value(counts, np.append(expected[enough], rest)) > ALPHA
    uniform = np.concatenate([(image > 0).ravel() / np.count_nonzero(image) for image in p]) / 3
    assert p_value(counts, np.append(uniform[enough], uniform[~enough].sum())) < ALPHA
    per_image = [np.count_nonzero(drawn[:, 0] == number) for number in NUMBERS]
    assert p_value(np.array(per_image), np.full(3, 1 / 3)) > ALPHA


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_density_ratios_are_those_of_the_draws(strategy: str, masked: bool) -> None:
    host = smooth_batch(MIXED, masked)
    sampler = trained(strategy, host)
    part, batch = part_of(sampler, strategy), ImageBatch.of(host, use_mask=True)
    for k, (height, width) in enumerate(MIXED):
        p = reference(sampler, host, k)
        every = torch.cartesian_prod(torch.tensor([k]), torch.arange(height), torch.arange(width))
        expected = p.ravel() * np.count_nonzero(p)
        np.testing.assert_allclose(part.density_ratio(batch, every), expected, rtol=1e-5, atol=1e-7)
    drawn = part.draw(batch, 500, TrainingStep(9))
    np.testing.assert_allclose(drawn.density_ratio(), part.density_ratio(batch, drawn.pixels))


def test_one_image_a_step() -> None:
    host = smooth_batch(MIXED)
    for strategy in STRATEGIES:
        sampler = trained(strategy, host, images_per_step="one")
        met = set()
        for step in range(40, 80):
            sampler.set_step(step)
            numbers = set(sampler.sample(host)["indices"][:, 0].tolist())
            assert len(numbers) == 1
            met |= numbers
        assert met == set(NUMBERS)


def test_expanded_errors_are_those_of_the_whole_image() -> None:
    """Half of the pixels are anchors; weighted, the mean error of few is that of all, unweighted it is not."""
    host = smooth_batch([(30, 40)] * 3)
    sampler = trained("expansive", host, images_per_step="all")
    sampler.set_num_rays_per_batch(20_000)
    pixels = sampler.sample(host)
    every: list[Any] = [
        (i, *at, image[at])
        for i, image in zip(NUMBERS, host["image"], strict=True)
        for at in np.ndindex(*image.shape[:2])
    ]
    whole = {
        "indices": torch.tensor([row[:3] for row in every]),
        "image": torch.stack([row[3] for row in every]),
    }
    error, truth = error_at(pixels).numpy(), float(error_at(whole).mean())
    assert mean_is(error * pixels["weight"].numpy(), truth)
    assert not mean_is(error, truth)
    edges = {n: anchors(edge_strength(i.numpy())) for n, i in zip(NUMBERS, host["image"], strict=True)}
    anchor = np.array([edges[n][y, x] for n, y, x in pixels["indices"].tolist()])
    assert abs(anchor.mean() - 0.5) < 0.02
    area = np.array([edges[n].mean() for n in pixels["indices"][:, 0].tolist()])
    expected = np.where(anchor, area, 1 - area) / 0.5
    np.testing.assert_allclose(pixels["weight"], expected, rtol=1e-5)


# ---- what every strategy must do


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_flat_images_are_drawn_uniformly(strategy: str) -> None:
    host = batch_of(SAME, stacked=False)
    for image in host["image"]:
        image[:] = 200
    sampler = following(rays=30_000, early=strategy, images_per_step="all")
    drawn = sampler.sample(host)["indices"][:, 1:]
    counts = pixel_counts(drawn, (9, 14))
    assert p_value(counts, np.full((9, 14), 1 / 126)) > ALPHA


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("images_per_step", ["one", "all"])
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_the_union_over_ranks_is_one_draw(strategy: str, images_per_step: str, masked: bool) -> None:
    host = smooth_batch(MIXED, masked)
    whole = trained(strategy, host, images_per_step=images_per_step)
    state = whole.state_dict()
    whole.set_num_rays_per_batch(120)
    whole.set_step(77)
    parts = []
    for rank in range(3):
        settings: dict[str, Any] = {"late": strategy, "early_fraction": 0.0, "images_per_step": images_per_step}
        sampler = following(77, rays=40, planned=10, rank=rank, world=3, **settings)
        sampler.load_state_dict(state)
        parts.append(sampler.sample(host)["indices"])
    assert torch.equal(torch.stack(parts, dim=1).reshape(-1, 3), whole.sample(host)["indices"])
    assert not torch.equal(parts[0], parts[1])


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_a_restored_sampler_draws_and_learns_the_same_bit_for_bit(strategy: str) -> None:
    host = smooth_batch(SIZES, masked=True)
    for steps in (0, 13, 150):
        first = trained(strategy, host, steps)
        file = io.BytesIO()
        torch.save(first.state_dict(), file)
        file.seek(0)
        second = trained(strategy, host, 0)
        second.load_state_dict(torch.load(file, weights_only=True))
        order = [2, 0, 1]  # a host collates images in any order
        permuted = {key: value[torch.tensor(order)] if key == "image_idx" else [value[k] for k in order]
                    for key, value in host.items()}  # fmt: skip
        for step in range(steps, steps + 30):
            for sampler, batch in ((first, host), (second, permuted)):
                sampler.set_step(step)
                sampler.observe(error_at(sampler.sample(batch)))
            assert torch.equal(first.sample(host)["indices"], second.sample(permuted)["indices"])
        learnt = first.state_dict().get(f"{strategy}.distribution"), second.state_dict().get(f"{strategy}.distribution")
        assert (learnt[0] is None) == (strategy == "expansive")
        if strategy == "regions" and learnt[0] and learnt[1]:
            assert learnt[0] == learnt[1]


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_a_resumed_run_is_the_same_bit_for_bit(strategy: str, tmp_path: Path) -> None:
    config, views = method_configs()["edge-nerf"], tiny_views(3, 16, 12)
    sampler = replace(config.pipeline.datamanager.pixel_sampler, late=strategy, schedule="steps", early_steps=2)
    manager = replace(config.pipeline.datamanager, train_num_rays_per_batch=64, pixel_sampler=sampler)
    pipeline = replace(config.pipeline, model=tiny_config(near=2.0, far=6.0), datamanager=manager)
    whole = tiny_trainer(replace(config, pipeline=pipeline, max_num_iterations=45), views, tmp_path)
    for step in range(16):
        whole.train_iteration(step)
    whole.next_step = 16
    whole.save()
    resumed = resume_trainer(whole, views)
    for step in range(16, 45):
        assert whole.train_iteration(step) == resumed.train_iteration(step)
    if strategy == "quadtree":
        forest = part_of(whole.pipeline.datamanager.train_pixel_sampler, strategy).forest
        assert forest.deepest > START_LEVEL


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_nothing_to_draw_and_bad_pixels_are_input_errors(strategy: str) -> None:
    masked = batch_of(SAME, masks=[torch.zeros(9, 14, dtype=torch.bool)] * 3)
    with pytest.raises(InputError, match="masked in all images"):
        following(early=strategy).check_images(masked)
    bad = batch_of(dtype=torch.float32)
    bad["image"][1, 2, 2, 0] = torch.nan
    with pytest.raises(InputError, match=rf"image {NUMBERS[1]}: .*not finite"):
        following(early=strategy).sample(bad)


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"quadtree_threshold": 0.02}, "quadtree-threshold is 0.02: has no effect without early or late quadtree"),
        ({"late": "quadtree", "quadtree_threshold": 1.5}, "quadtree-threshold is 1.5: must be between 0 and 1"),
        ({"late": "expansive", "importance_weight": 0.5}, "importance-weight is 0.5: expansive weights"),
    ],
)
def test_settings_without_meaning_are_refused(settings: dict[str, Any], problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        following(**settings)
    following(late="quadtree", quadtree_threshold=0.02)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_tables_take_at_most_5_bytes_a_pixel(strategy: str) -> None:
    sampler = following(early=strategy)
    sampler.sample(batch_of([(256, 256)] * 2, [0, 1], channels=3))
    assert part_of(sampler, strategy)._table.nbytes <= 5 * 2 * 256 * 256
