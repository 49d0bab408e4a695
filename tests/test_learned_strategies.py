"""Strategies that learn from errors: each rule against a plain reading of it on small images, resumption, ranks."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from batches import LATE, MIXED, NUMBERS, SAME, batch_of, following, half_masks
from goodness import ALPHA, mean_is, p_value, pixel_counts
from tiny import resume_trainer, tiny_config, tiny_trainer, tiny_views

from edge_se_sampler.engine.config import override
from edge_se_sampler.engine.run_folder import config_digest, config_from_json, config_to_json
from edge_se_sampler.engine.show import probability_map
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs
from edge_se_sampler.sampling import actray, instant_ngp, soft_mining, torch_ngp
from edge_se_sampler.sampling.edges import edge_strength
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.parts import PixelBatch, TrainingStep
from edge_se_sampler.sampling.pixel_sampler import EdgeSEPixelSampler
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig
from edge_se_sampler.sampling.strategies import Uniform

LEARNED = ("error-map", "error-cdf", "soft-mining", "actray")
WALKS = ("soft-mining",)  # no independent draws


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rebuild after a few steps what is rebuilt after many."""
    monkeypatch.setattr(instant_ngp, "FIRST_INTERVAL", 3)
    monkeypatch.setattr(actray, "REFRESH_STEPS", 2)


def settings(**values: Any) -> EdgeSEPixelSamplerConfig:
    values = {"early": "uniform", "images_per_step": "all"} | values
    return EdgeSEPixelSamplerConfig(**values)


def errors_of(pixels: dict[str, Any]) -> torch.Tensor:
    """Stand in for a model's: fixed for a pixel, between 0 and 3, and larger at the bottom of an image."""
    number, row, column = pixels["indices"].unbind(1)
    return (row + 1) ** 2 / 400 + ((7 * number + 3 * row + 5 * column) % 11) / 11


def trained(
    name: str, steps: int, batch: dict[str, Any], sampler: EdgeSEPixelSampler | None = None, **more: Any
) -> Any:
    """A sampler after so many late steps, and the indices and weights of the last one."""
    more = {"early": "uniform", "late": name, "images_per_step": "all"} | more
    sampler = sampler or following(LATE, **more)
    pixels: dict[str, Any] = {}
    for _ in range(steps):
        pixels = sampler.sample(batch)
        sampler.observe(errors_of(pixels))
        sampler.set_step(sampler._step.number + 1)
    return sampler, pixels


def saved_bytes(sampler: EdgeSEPixelSampler) -> bytes:
    file = io.BytesIO()
    torch.save(sampler.state_dict(), file)
    return file.getvalue()


def drawn_uniformly(batch: ImageBatch, count: int, seed: int) -> PixelBatch:
    return Uniform(settings()).draw(batch, count, TrainingStep(seed=seed))


# ---- what all of them do


@pytest.mark.parametrize("name", LEARNED)
def test_nothing_is_learnt_for_an_early_phase_that_is_over(name: str) -> None:
    batch = batch_of(SAME)
    sampler, _ = trained("uniform", 3, batch, following(0, early=name, late="uniform", images_per_step="all"))
    assert sampler.needs_errors
    assert f"{name}.distribution" in sampler.state_dict()
    sampler.set_step(LATE)
    sampler.sample(batch)
    assert not sampler.needs_errors
    assert sampler.pending_batch is None
    assert f"{name}.distribution" not in sampler.state_dict()


@pytest.mark.parametrize("images_per_step", ["one", "all"])
@pytest.mark.parametrize("sizes", [SAME, MIXED])
@pytest.mark.parametrize("name", LEARNED)
def test_masked_pixels_are_never_drawn_and_all_images_are(name: str, sizes: list, images_per_step: str) -> None:
    masks = half_masks(sizes)
    batch, seen = batch_of(sizes, masks=masks, channels=4), set()
    sampler = following(LATE, early="uniform", late=name, images_per_step=images_per_step, rays=150)
    for _ in range(12):
        _, pixels = trained(name, 1, batch, sampler)
        assert torch.equal(pixels["address"], pixels["indices"])
        assert pixels["mask"].all()
        seen |= set(pixels["indices"][:, 0].tolist())
        assert images_per_step == "all" or len(torch.unique(pixels["indices"][:, 0])) == 1
    assert seen == set(NUMBERS)


@pytest.mark.parametrize("name", LEARNED)
def test_errors_change_what_is_drawn(name: str) -> None:
    """With errors that grow downwards, pixels come from lower down than uniform ones."""
    sampler, _ = trained(name, 20, batch_of([(60, 50)] * 3), rays=500)
    rows = torch.cat([trained(name, 1, batch_of([(60, 50)] * 3), sampler)[1]["indices"][:, 1] for _ in range(10)])
    assert rows.double().mean() > 29.5 + 4


@pytest.mark.parametrize("images_per_step", ["one", "all"])
@pytest.mark.parametrize("name", LEARNED)
def test_a_resumed_sampler_draws_the_same_bit_for_bit(name: str, images_per_step: str) -> None:
    batch = batch_of(MIXED, masks=half_masks(MIXED))
    for steps in (0, 1, 4, 9):
        sampler, _ = trained(name, steps, batch, images_per_step=images_per_step)
        resumed = following(LATE + steps, early="uniform", late=name, images_per_step=images_per_step)
        resumed.load_state_dict(torch.load(io.BytesIO(saved_bytes(sampler)), weights_only=True))
        for _ in range(5):
            (_, went_on), (_, again) = trained(name, 1, batch, sampler), trained(name, 1, batch, resumed)
            assert all(torch.equal(went_on[key], again[key]) for key in went_on)


@pytest.mark.parametrize("name", LEARNED)
def test_a_resumed_run_takes_the_same_steps(name: str, tmp_path: Path) -> None:
    changes = {
        "pipeline.datamanager.train_num_rays_per_batch": 16,
        "pipeline.datamanager.pixel_sampler": settings(late=name, early_fraction=0.2),
        "pipeline.model": tiny_config(),
        "max_num_iterations": 20,
    }
    views = tiny_views(3, 12, 12)
    trainer = tiny_trainer(override(method_configs()["edge-se-nerf"], changes), views, tmp_path)
    for step in range(9):
        trainer.train_iteration(step)
    trainer.next_step = 9
    trainer.save()
    assert [resume_trainer(trainer, views).train_iteration(9)] == [trainer.train_iteration(9)]


@pytest.mark.parametrize("name", [name for name in LEARNED if name not in WALKS])
def test_ranks_that_have_learnt_the_same_slice_one_draw(name: str) -> None:
    batch, world = batch_of(MIXED), 3
    state = trained(name, 9, batch)[0].state_dict()
    drawn = []
    for rays, rank, ranks in [(120, 0, 1), *((40, rank, world) for rank in range(world))]:
        sampler = following(LATE, early="uniform", late=name, images_per_step="all", rays=rays, rank=rank, world=ranks)
        sampler.load_state_dict(state)
        drawn.append(sampler.sample(batch)["indices"])
    assert torch.equal(torch.stack(drawn[1:], dim=1).reshape(-1, 3), drawn[0])


@pytest.mark.parametrize("name", WALKS)
def test_ranks_walk_by_themselves_in_the_same_image(name: str) -> None:
    drawn = [trained(name, 3, batch_of(), images_per_step="one", rank=rank, world=2)[1]["indices"] for rank in range(2)]
    assert torch.equal(drawn[0][:, 0], drawn[1][:, 0])
    assert not torch.equal(drawn[0], drawn[1])


@pytest.mark.parametrize("name", LEARNED)
def test_the_order_of_the_images_does_not_matter(name: str) -> None:
    order = [2, 0, 1]
    permuted = batch_of([MIXED[i] for i in order], [NUMBERS[i] for i in order])
    sampler, _ = trained(name, 6, batch_of(MIXED))
    other = following(LATE + 6, early="uniform", late=name, images_per_step="all")
    other.load_state_dict(sampler.state_dict())
    assert torch.equal(sampler.sample(batch_of(MIXED))["address"], other.sample(permuted)["address"])


@pytest.mark.parametrize("name", LEARNED)
def test_all_pixels_masked_and_more_images_later(name: str) -> None:
    with pytest.raises(InputError, match="masked in all images"):
        following(LATE, early="uniform", late=name).check_images(batch_of(masks=[torch.zeros(9, 14)] * 3))
    sampler, _ = trained(name, 4, batch_of(MIXED[:2], NUMBERS[:2]))
    _, pixels = trained(name, 8, batch_of(MIXED), sampler)
    assert set(pixels["indices"][:, 0].tolist()) == set(NUMBERS)


@pytest.mark.parametrize("name", [name for name in LEARNED if name not in WALKS])
def test_drawn_pixels_and_importance_weights_follow_the_density(name: str) -> None:
    """Pixels of many draws at one state, against the map of densities, and against a uniform one as control."""
    host = batch_of(MIXED, masks=half_masks(MIXED))
    sampler, _ = trained(name, 20, host, importance_weight=1.0)
    sampler.set_num_rays_per_batch(200_000)
    batch, distribution = sampler._read(host), sampler.strategies[name].distribution
    pixels = sampler.sample(host)
    counts, expected, uniform = [], [], []
    for k, number in enumerate(NUMBERS):
        here = pixels["indices"][pixels["indices"][:, 0] == number, 1:]
        counts.append(pixel_counts(here, MIXED[k]).ravel())
        share = len(here) / 200_000 if name == "actray" else 1 / 3  # which draws images by their errors, too
        expected.append(probability_map(distribution, batch, k).ravel() * share)
        uniform.append(batch.valid(k).double().numpy().ravel() / int(batch.valid(k).sum()) / 3)
    assert p_value(np.concatenate(counts), np.concatenate(expected)) > ALPHA
    assert p_value(np.concatenate(counts), np.concatenate(uniform)) < ALPHA
    mean = float(np.mean([errors_of_image(k)[batch.valid(k).numpy()].mean() for k in range(3)]))
    assert mean_is((errors_of(pixels) * pixels["weight"]).double().numpy(), mean)
    assert not mean_is(errors_of(pixels).double().numpy(), mean)


def errors_of_image(k: int) -> np.ndarray:
    row, column = torch.meshgrid(*(torch.arange(n) for n in MIXED[k]), indexing="ij")
    indices = torch.stack((torch.full_like(row, NUMBERS[k]), row, column), dim=2)
    return errors_of({"indices": indices.reshape(-1, 3)}).reshape(MIXED[k]).double().numpy()


def test_errors_of_the_early_phase_are_learnt_from_by_the_late_strategy() -> None:
    batch = batch_of(MIXED)
    sampler = following(0, early="edge", late="error-map", images_per_step="all")
    for step in range(5):
        sampler.set_step(step)
        sampler.observe(errors_of(sampler.sample(batch)))
    cells = sampler.strategies["error-map"].distribution.cells  # pyright: ignore[reportAttributeAccessIssue]
    assert len(np.unique(cells.values)) > 50


# ---- torch-ngp


def test_the_error_map_keeps_a_tenth_and_takes_nine_tenths_of_the_new(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch_ngp, "SIDE", 4)
    batch = ImageBatch.of(batch_of(MIXED), use_mask=False)
    strategy = torch_ngp.ErrorMapCells(settings(late="error-map"))
    expected = {(k, r, c): 1.0 for k in range(3) for r in range(4) for c in range(4)}
    for step in range(5):
        drawn = drawn_uniformly(batch, 30, step)
        errors = errors_of(drawn.values)
        strategy.update(drawn, errors, TrainingStep(step))
        found: dict[tuple, list[float]] = {}
        for (k, y, x), error in zip(drawn.pixels.tolist(), errors.tolist(), strict=True):
            height, width = MIXED[k]
            found.setdefault((k, y * 4 // height, x * 4 // width), []).append(error / 3)
        for cell, values in found.items():
            expected[cell] = 0.1 * expected[cell] + 0.9 * np.mean(values)
    got = [strategy.cells.values[strategy.cells.first[k] + 4 * r + c] for k, r, c in expected]
    np.testing.assert_allclose(got, list(expected.values()), rtol=1e-5)


# ---- instant-ngp


def test_the_cdf_is_that_of_errors_over_their_density_shared_bilinearly() -> None:
    batch = ImageBatch.of(batch_of(MIXED), use_mask=False)
    strategy = instant_ngp.ErrorCdf(settings(late="error-cdf"))
    side = int(3.5 * (3 * 300 / 3) ** 0.25)
    m = [np.zeros((min(side, height), min(side, width))) for height, width in MIXED]
    for step in range(3):
        drawn = drawn_uniformly(batch, 300, step)
        errors = errors_of(drawn.values)
        for (k, y, x), error in zip(drawn.pixels.tolist(), errors.tolist(), strict=True):
            (height, width), (rows, columns) = MIXED[k], m[k].shape
            for r in range(rows):
                for c in range(columns):  # a tent around each cell's center, level beyond the outermost
                    at_row = np.clip((y + 0.5) / height * rows - 0.5, 0, rows - 1)
                    at_column = np.clip((x + 0.5) / width * columns - 0.5, 0, columns - 1)
                    m[k][r, c] += error * max(0, 1 - abs(at_row - r)) * max(0, 1 - abs(at_column - c))
        strategy.update(drawn, errors, TrainingStep(step))
    assert (strategy.steps, strategy.interval, strategy.map) == (0, 4, None)
    for k, sums in enumerate(m):
        p = np.zeros_like(sums)
        for r, c in np.ndindex(sums.shape):
            row = 0.99 * sums[r].sum() / sums.sum() + 0.01 / len(sums)
            p[r, c] = row * (0.99 * sums[r, c] / sums[r].sum() + 0.01 / len(sums[r]))
        got = strategy.cells.values[strategy.cells.first[k] :][: p.size].reshape(p.shape)
        np.testing.assert_allclose(got, 0.5 + 0.5 * p * p.size, rtol=1e-5)


def test_errors_are_divided_by_the_density_of_the_pixels() -> None:
    host = batch_of()
    sampler, _ = trained("error-cdf", 3, host, rays=20_000)
    strategy = sampler.strategies["error-cdf"].distribution
    before = [probability_map(strategy, sampler._read(host), k) for k in range(3)]
    sampler, _ = trained("error-cdf", 4, host, sampler)  # the same errors again, though drawn by them
    after = [probability_map(strategy, sampler._read(host), k) for k in range(3)]
    assert np.abs(np.array(after) / before - 1).mean() < 0.05


@pytest.mark.parametrize("name", [*LEARNED, "regions", "quadtree", "se"])
def test_a_step_whose_errors_are_not_finite_teaches_nothing(name: str) -> None:
    batch = batch_of(SAME)
    changes: dict[str, Any] = {"error_source": "cached"} if name == "se" else {}
    sampler, _ = trained(name, 4, batch, **changes)
    before = saved_bytes(sampler)
    pixels = sampler.sample(batch)
    between = saved_bytes(sampler)  # walkers have moved
    assert name in WALKS or between == before
    errors = errors_of(pixels)
    errors[5] = torch.nan
    sampler.observe(errors)
    assert saved_bytes(sampler) == between
    sampler.sample(batch)
    sampler.observe(errors_of(pixels))
    assert saved_bytes(sampler) != between


# ---- Soft Mining


def walking(**values: Any) -> tuple[soft_mining.SoftMining, ImageBatch]:
    batch = ImageBatch.of(batch_of([(200, 160)] * 2, [1, 2]), use_mask=False)
    strategy = soft_mining.SoftMining(settings(late="soft-mining", **values))
    strategy.tables(batch)
    return strategy, batch


def test_walkers_drift_along_the_gradient_of_the_logarithm_and_diffuse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soft_mining, "SHARE", 0.0)
    strategy, batch = walking()
    column = np.tile(np.arange(64) / 64, 64)
    strategy.map = np.tile(np.exp(100 * column), 2)
    start = np.column_stack((np.zeros(4000), np.full((4000, 2), 0.4), np.arange(4000.0)))
    start[0, 3] = -1.0  # the one with the smallest error is restarted
    _, _, drawable = strategy.drawable(batch)
    moved = strategy._move(start, batch, drawable, np.arange(2), np.random.default_rng(0))[1:, 1:3] - 0.4
    assert mean_is(moved[:, 0], 0)
    assert mean_is(moved[:, 1], 100 * 0.02**2 / 2)
    assert not mean_is(moved[:, 1], 0)
    np.testing.assert_allclose(moved.std(axis=0), 0.02, rtol=0.05)


def test_the_gradient_is_the_central_difference_between_known_cells() -> None:
    strategy, _ = walking()
    rng = np.random.default_rng(1)
    # unknown, without an error, and others
    strategy.map = rng.choice([0, 1e-20, 1], p=[0.2, 0.2, 0.6], size=2 * 64 * 64) * rng.random(2 * 64 * 64)
    image, x = rng.integers(2, size=300), rng.random((300, 2))
    got = strategy._gradient(image, x)
    for i, (k, (y, z)) in enumerate(zip(image, x, strict=True)):
        q = strategy.map[64 * 64 * k :][: 64 * 64].reshape(64, 64)
        r, c = int(y * 200) * 64 // 200, int(z * 160) * 64 // 160
        for axis, (low, high) in enumerate(
            [((max(r - 1, 0), c), (min(r + 1, 63), c)), ((r, max(c - 1, 0)), (r, min(c + 1, 63)))]
        ):
            known = q[low] > 0 and q[high] > 0
            before, after = (math.log(max(q[cell], 2**-10)) for cell in (low, high))
            expected = (after - before) / ((high[axis] - low[axis]) / 64) if known else 0
            assert got[i, axis] == pytest.approx(expected)


def test_the_worst_walkers_and_those_that_left_are_restarted_from_edges_and_a_tenth_is_uniform() -> None:
    strategy, batch = walking()
    inside = np.column_stack((np.zeros(1000), np.full((1000, 2), 0.5), np.arange(1000.0)))
    inside[200:300, 1] = 0.95 + 0.5  # outside
    _, _, drawable = strategy.drawable(batch)
    moved = strategy._move(inside, batch, drawable, np.arange(2), np.random.default_rng(0))
    jumped = np.abs(moved[:, 1:3] - 0.5).max(axis=1) > 6 * 0.02
    assert jumped[:101].mean() > 0.8
    assert jumped[200:300].mean() > 0.8
    assert jumped[900:].mean() > 0.8  # always the last ones: all others walk on
    assert not np.delete(jumped, np.r_[:101, 200:300, 900:1000]).any()


@pytest.mark.parametrize("restarted", [False, True])
def test_new_walkers_are_uniform_and_restarted_ones_follow_edges(restarted: bool) -> None:
    sizes = [(12, 10)] * 2
    batch = ImageBatch.of(batch_of(sizes, [1, 2]), use_mask=False)
    strategy = soft_mining.SoftMining(settings(late="soft-mining"))
    _, _, drawable = strategy.drawable(batch)
    walkers = np.full((30_000, 4), np.nan)
    if restarted:
        walkers[:] = [0, 0.5, 0.5, 1.0]  # all errors alike: all are the worst
    moved = strategy._move(walkers, batch, drawable, np.arange(2), np.random.default_rng(0))
    pixels = np.column_stack((moved[:, 0], strategy.cells.pixel_at(moved[:, 0].astype(int), moved[:, 1:3])))
    counts = pixel_counts(torch.from_numpy(pixels).long(), (2, 12, 10))
    uniform = np.full((2, 12, 10), 1 / 240)
    edges = np.stack([edge_strength(batch.image(k)) + 1e-5 for k in range(2)]).astype(np.float64)
    edges /= 2 * edges.sum(axis=(1, 2), keepdims=True)
    right, wrong = (edges, uniform) if restarted else (uniform, edges)
    assert p_value(counts, right) > ALPHA
    assert p_value(counts, wrong) < ALPHA


def test_the_loss_is_weighted_by_the_errors_known_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soft_mining, "WARMUP_STEPS", 2 * LATE)
    strategy, _ = walking()
    strategy.map[:4] = [0.0, 0.1, 0.4, 0.9]
    cells = np.array([0, 1, 2, 3, 3])
    q = np.array([np.mean([0.1, 0.4, 0.9, 0.9]), 0.1, 0.4, 0.9, 0.9])
    for step, power in ((LATE, 0.5), (3 * LATE, 0.6), (0, 0.0)):
        weights = (q / q[0]) ** -power
        expected = np.minimum(weights, weights.mean() + weights.std())
        got = strategy._loss_weight(cells, step)
        assert got is not None
        np.testing.assert_allclose(got, expected, rtol=1e-6)
    _, pixels = trained("soft-mining", 5, batch_of())
    assert pixels["weight"].dtype == torch.float32
    assert len(torch.unique(pixels["weight"])) > 10
    _, pixels = trained("soft-mining", 5, batch_of(), soft_mining_alpha=0.0)
    assert "weight" not in pixels


def test_the_map_of_errors_and_the_density_aimed_at() -> None:
    sampler, pixels = trained("soft-mining", 8, batch_of(), rays=4000)
    strategy: Any = sampler.strategies["soft-mining"].distribution
    q = np.sqrt(errors_of(pixels).numpy() / 3)  # a cell is a pixel here, and its error always the same
    _, index = strategy.tables(sampler._read(batch_of()))
    position = torch.tensor([NUMBERS.index(n) for n in pixels["indices"][:, 0].tolist()])
    drawn = torch.column_stack((position, pixels["indices"][:, 1:]))
    np.testing.assert_allclose(strategy.map[strategy.cells.cells_at(index, drawn)], q, rtol=1e-6)
    ratio = strategy.density_ratio(sampler._read(batch_of()), drawn)
    mean = {k: strategy.map[strategy.cells.first[k] :][:126].mean() for k in range(3)}
    expected = 0.1 + 0.9 * q / np.array([mean[k] for k in position.tolist()])
    np.testing.assert_allclose(ratio, expected, rtol=1e-5)
    np.testing.assert_allclose(strategy.walkers[-1][:, 3], q, rtol=1e-6)


# ---- ActRay


def test_errors_are_passed_on_to_neighbors_of_similar_color(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(actray, "REFRESH_STEPS", 100)
    sizes = [(6, 5), (4, 7)]
    batch = ImageBatch.of(batch_of(sizes, [1, 2], channels=4), use_mask=False)
    for image in batch.per_pixel["image"]:  # mostly similar colors
        image[..., :3] = image[..., :3] // 4
        image[..., 3] = 200
    strategy = actray.ActRay(settings(late="actray"))
    colors = [actray.composite(batch.image(k), (1.0, 1.0, 1.0)) for k in range(2)]
    l, s, t = ([np.zeros(size) for size in sizes] for _ in range(3))
    reached = []
    for step in range(6):
        drawn = drawn_uniformly(batch, 5, step)
        errors = errors_of(drawn.values)
        cells: dict[tuple, list[float]] = {}
        hits = [tuple(pixel) for pixel in drawn.pixels.tolist()]
        for hit, error in zip(hits, errors.tolist(), strict=True):
            cells.setdefault(hit, []).append(error / 3)
        for (k, y, x), found in cells.items():
            l[k][y, x], s[k][y, x], t[k][y, x] = np.mean(found), 1, step + 1
        new = 0
        for down, right in actray.NEIGHBORS:
            before = [array.copy() for array in l], [array.copy() for array in s]
            for (k, y, x), error in zip(hits, errors.tolist(), strict=True):
                r, c = y + down, x + right
                if not (0 <= r < sizes[k][0] and 0 <= c < sizes[k][1]):
                    continue
                similarity = 1 - np.sqrt(((colors[k][y, x] - colors[k][r, c]) ** 2).sum())
                if similarity >= 0.7:
                    old_l, old_s = before[0][k][r, c], before[1][k][r, c]
                    new += old_s == 0 and s[k][r, c] == 0
                    l[k][r, c] = (old_l * old_s + error / 3 * similarity**2) / (old_s + similarity)
                    s[k][r, c] = (old_s**2 + similarity**2) / (old_s + similarity)
        reached.append(new / 5)
        strategy.update(drawn, errors, TrainingStep(step))
    assert strategy.best_yield == max(reached) > 0
    for k, first in enumerate(strategy.cells.first[:2]):
        for array, expected in ((strategy.l, l[k]), (strategy.s, s[k]), (strategy.drawn_at, t[k])):
            np.testing.assert_allclose(array[first : first + expected.size], expected.ravel(), rtol=1e-5)


def test_the_upper_confidence_bound() -> None:
    rng = np.random.default_rng(0)
    u, t = rng.random(99) ** 4, rng.integers(1, 50, 99).astype(float)
    u[5] = 0.0
    there = np.ones(99, dtype=bool)
    there[7] = False
    counted = there & (u > 0)
    middle = np.median(t[counted])
    k = np.log(u[counted].max() / np.median(u[counted]) / 2) / middle
    got = actray.upper_bound(u, t, there)
    np.testing.assert_allclose(got, [a * np.exp(k * min(b, middle)) for a, b in zip(u, t, strict=True)])
    stale = int(np.argmin(np.abs(u - np.median(u[counted])) - 1e3 * (t >= middle)))
    assert got[stale] == pytest.approx(u[stale] / np.median(u[counted]) * u[counted].max() / 2)
    np.testing.assert_array_equal(actray.upper_bound(np.zeros(3), np.ones(3), np.ones(3, dtype=bool)), np.zeros(3))
    np.testing.assert_array_equal(actray.upper_bound(np.ones(3), np.ones(3), np.ones(3, dtype=bool)), np.ones(3))


def test_it_explores_cells_without_an_estimate_first() -> None:
    host = batch_of([(40, 30)] * 3)
    sampler, _ = trained("actray", 2, host, rays=100)
    strategy: Any = sampler.strategies["actray"].distribution
    assert strategy.exploring
    known = strategy.s > 0
    pixels = sampler.sample(host)["indices"]
    drawn = torch.column_stack((torch.tensor([NUMBERS.index(n) for n in pixels[:, 0].tolist()]), pixels[:, 1:]))
    assert not known[strategy.cells.cells_at(torch.arange(3), drawn)].any()
    trained("actray", 60, host, sampler)
    assert not strategy.exploring
    assert (strategy.s[strategy.cells.counts > 0] > 0).all()


@pytest.mark.parametrize("images_per_step", ["one", "all"])
def test_exploration_ends_when_a_step_reaches_much_less_than_the_best(
    images_per_step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of each image by itself where a step draws from one: others that were not looked at are still to be explored."""
    yields, pass_on = [], actray.ActRay._pass_on
    monkeypatch.setattr(actray.ActRay, "_pass_on", lambda *given: yields.append(pass_on(*given)) or yields[-1])
    numbers = list(range(8))
    host = batch_of([(40, 30)] * 8, numbers)
    sampler = following(LATE, early="uniform", late="actray", images_per_step=images_per_step, rays=300)
    strategy: Any = sampler.strategies["actray"].distribution
    groups = numbers if images_per_step == "one" else [0]
    best, exploring, unvisited = dict.fromkeys(groups, 0.0), dict.fromkeys(groups, True), 0
    for step in range(40):
        _, pixels = trained("actray", 1, host, sampler)
        group = int(pixels["indices"][0, 0]) if images_per_step == "one" else 0
        best[group] = max(best[group], yields[-1] / 300)
        exploring[group] &= yields[-1] / 300 * 3.5 >= best[group]
        if step % 2:
            unknown = ((strategy.s == 0) & (strategy.cells.counts > 0)).reshape(len(groups), -1).any(axis=1)
            exploring = {g: exploring[g] and unknown[i] for i, g in enumerate(groups)}
        assert strategy.exploring.tolist() == [*exploring.values()]
        np.testing.assert_allclose(strategy.best_yield, [*best.values()])
        unvisited += any(not on for on in exploring.values()) and min(best.values()) == 0
    assert not any(exploring.values())
    assert (unvisited > 0) == (images_per_step == "one")


def test_what_an_earlier_version_knew_of_its_exploration_holds_for_all_images() -> None:
    sampler, _ = trained("actray", 4, batch_of(), images_per_step="one")
    strategy: Any = sampler.strategies["actray"].distribution
    strategy.load_state_dict(strategy.state_dict() | {"exploring": False, "best_yield": 2.5})
    assert (strategy.exploring.tolist(), strategy.best_yield.tolist()) == ([False] * 3, [2.5] * 3)


# ---- settings


def test_what_has_no_meaning_is_refused() -> None:
    with pytest.raises(InputError, match=r"importance-weight is 0.5: soft-mining weights the loss itself"):
        settings(late="soft-mining", importance_weight=0.5).check()
    with pytest.raises(InputError, match=r"soft-mining-alpha is 0.5: has no effect without early or late soft-mining"):
        settings(soft_mining_alpha=0.5).check()
    with pytest.raises(InputError, match=r"soft-mining-alpha is 2.0: must be between 0 and 1"):
        settings(late="soft-mining", soft_mining_alpha=2.0).check()


def test_runs_of_before_a_setting_was_added_are_read_and_resumed() -> None:
    config = method_configs()["edge-se-nerf"]
    old = config_to_json(config)
    del old["pipeline"]["datamanager"]["pixel_sampler"]["soft_mining_alpha"]
    assert config_from_json(config, old, "old") == config
    other = override(config, {"pipeline.datamanager.pixel_sampler.soft_mining_alpha": 0.3})
    assert config_from_json(config, config_to_json(other), "new") == other
    assert config_digest(config).startswith("8d8f64a2b612fb59")  # what 0.1.0 wrote, without the setting
    assert config_digest(other) != config_digest(config)
    del old["pipeline"]["datamanager"]["pixel_sampler"]["early"]
    with pytest.raises(InputError, match=r"fields: \['early'\]"):
        config_from_json(config, old, "old")
