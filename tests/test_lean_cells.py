"""The voxel model: how its cells are subdivided, pruned and left unsampled as training goes on, and resumed."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from lean_models import VIEWS, config_of, full_model, steps_of
from tiny import resume_trainer, tiny_rays, tiny_trainer

from edge_se_sampler.engine.optimizers import create_adam
from edge_se_sampler.engine.pipeline import load_weights, saved_grid
from edge_se_sampler.engine.rendering import render_outputs
from edge_se_sampler.models import lean
from edge_se_sampler.models.lean import LeanModel
from edge_se_sampler.models.ray_model import ParameterGroup
from edge_se_sampler.occupancy.bricks import unpack_bits


def test_training_learns_the_ball_in_ever_smaller_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lean, "ROWS_PER_SEEN", 100)  # few rays are trained on
    trainer = tiny_trainer(config_of(300), VIEWS)
    model = trainer.pipeline.model
    sizes, losses = [], []
    for step in range(300):
        losses.append(trainer.train_iteration(step))
        sizes.append(float(model.grid.cell_size))
    # subdivided after 0.2025 and 0.45 of all
    assert [sizes.count(size) for size in sorted(set(sizes), reverse=True)] == [61, 74, 165]
    assert sizes[0] == pytest.approx(2 * sizes[100])
    assert 2.5 * sizes[-1] < sizes[0] <= 8 * sizes[-1]
    assert np.mean(losses[-20:]) < 0.1 * np.mean(losses[:20])


def show_all(model: LeanModel, times: int = 1) -> None:
    """As if each cell had been seen that often at full weight."""
    model.grid.max_weight.fill_(1)
    model.grid.num_seen.fill_(times * model.grid.num_rows)


def test_what_the_optimizer_remembers_of_cells_ends_when_they_are_subdivided() -> None:
    """Its rows are other cells' afterwards, even where there are as many."""
    trainer = tiny_trainer(config_of(100), VIEWS)
    model = trainer.pipeline.model
    remembered = []
    for step in range(30):
        level = int(model.grid.level)
        trainer.train_iteration(step)
        if int(model.grid.level) > level:
            remembered = [int(trainer.optimizer.state[weight]["step"]) for weight in (model.density, model.features)]
    assert remembered == [1, 1]
    assert int(trainer.optimizer.state[model.fine.hidden]["step"]) == 30


def test_cells_without_weight_are_left_out_when_cells_are_subdivided() -> None:
    """All but those of one corner of the box, and the smaller ones next to them."""
    model = full_model()
    show_all(model, 100)
    seen = torch.zeros((8, 8, 8), dtype=torch.bool)
    seen[:2, :3, :2] = True
    rows = torch.nonzero(model.grid.occupied.reshape(-1))[:, 0]
    in_corner = torch.stack([model.grid.to_cells(torch.arange(model.grid.num_rows) == row)[seen].any() for row in rows])
    model.grid.max_weight.zero_()[rows] = in_corner.float()
    model.update_cells(0.26, 0.28)
    grid = model.grid
    assert int(grid.level) == 1
    expected = torch.zeros((16, 16, 16), dtype=torch.bool)
    expected[:5, :7, :5] = True
    assert torch.equal(grid.to_cells(grid.occupied.reshape(-1)), expected)
    assert model.density.shape == (grid.num_rows, 1)
    assert model.features.shape == (grid.num_rows, 16)


@pytest.mark.parametrize(("max_level", "smallest"), [(1, 0.25), (2, 0.5)])
def test_cells_are_halved_and_become_at_last_as_small_as_what_was_seen_allows(max_level: int, smallest: float) -> None:
    sizes = []
    for times in (1, 100, 10_000):
        model = full_model(max_level=max_level)
        allowed = lean.ROWS_PER_SEEN * times * model.grid.num_rows
        show_all(model, times)
        model.update_cells(0.4, 0.5)
        sizes.append(float(model.grid.cell_size) / 0.25)
        assert int(model.grid.level) == 1
        assert sizes[-1] in (0.5, smallest) or model.grid.num_rows == pytest.approx(allowed, rel=0.3)
    assert sizes[0] == 0.5
    assert sizes[-1] == smallest
    assert smallest == 0.5 or smallest < sizes[1] < 0.5


@pytest.mark.parametrize("num_pixels", [100, 10_000])
def test_there_are_no_more_corners_than_pixels_can_tell(num_pixels: int) -> None:
    """But cells are halved all the same."""
    model = full_model(max_level=1, num_pixels=num_pixels)
    show_all(model, 10_000)
    model.update_cells(0.4, 0.5)
    if num_pixels == 100:
        assert float(model.grid.cell_size) == 0.25 / 2
    else:
        assert model.grid.num_rows == pytest.approx(lean.ROWS_PER_PIXEL * num_pixels, rel=0.3)


def test_subdividing_changes_little_of_what_is_rendered() -> None:
    """Corners in the middle of edges are interpolated, so values inside are as before; rays take more steps."""
    model = full_model(max_level=1).eval()
    with torch.no_grad():
        model.density.copy_(torch.from_numpy(np.random.default_rng(1).normal(size=model.density.shape)))
        model.features.mul_(100)
    rays = tiny_rays(200, dtype=torch.float32)
    before = render_outputs(model, rays, ["rgb_fine", "accumulation_fine"])
    show_all(model)
    model.update_cells(0.59, 0.61)
    assert float(model.grid.cell_size) == 0.25 / 2
    assert int(model.grid.level) == 1
    after = render_outputs(model, rays, ["rgb_fine", "accumulation_fine"])
    assert float(before["accumulation_fine"].max()) > 0.9
    for key, value in before.items():
        assert float((after[key] - value).abs().mean()) < 0.02, key


def test_cells_are_not_subdivided_before_enough_was_seen() -> None:
    model = full_model()
    model.grid.update_max_weight(torch.arange(511), torch.ones(511))  # of 512 cells
    model.update_cells(0.26, 0.3)
    assert int(model.grid.level) == 0
    model.grid.update_max_weight(torch.arange(1), torch.ones(1))
    model.update_cells(0.3, 0.31)
    assert int(model.grid.level) == 1


@pytest.mark.parametrize(("seen_per_row", "end"), [(lean.SEEN_PER_ROW + 1, 0.135), (lean.SEEN_PER_ROW - 1, 0.2025)])
def test_levels_end_earlier_where_each_cell_will_be_seen_often(seen_per_row: float, end: float) -> None:
    """For each of sixteen times as many rows, in what is left after 0.135 of the training."""
    model = full_model()
    show_all(model)
    model.grid.num_seen.fill_(round(seen_per_row * 16 * model.grid.num_rows * 0.135 / 0.865))
    levels = []
    for before, now in itertools.pairwise((0.134, 0.1349, 0.1351, 0.2024, 0.2026)):
        model.update_cells(before, now)
        levels.append(int(model.grid.level))
    assert levels == [0, *((0, 0, 1) if end > 0.2 else (1, 1, 1))]
    show_all(model)
    model.update_cells(end / 0.45 - 0.001, end / 0.45 + 0.001)
    assert int(model.grid.level) == 2


def test_whether_levels_end_earlier_is_kept_in_checkpoints_but_for_those_of_earlier_versions() -> None:
    model, other = full_model(), full_model()
    model.subdivides_early.fill_(True)
    state = model.state_dict()
    other.load_state_dict(state)
    assert other.subdivides_early
    del state["subdivides_early"]
    other.load_state_dict(state)
    assert not other.subdivides_early


def test_weights_of_the_first_part_of_a_level_do_not_count() -> None:
    model = full_model()
    model.grid.update_max_weight(torch.arange(512), torch.ones(512))
    model.update_cells(0.07, 0.08)
    assert model.grid.max_weight.any()
    model.update_cells(0.08, 0.082)  # 0.4 of 0.2025
    assert not model.grid.max_weight.any()


@pytest.mark.parametrize(("times", "expected"), [(2560, 27 + 8 + 18), (2559, 512)])
def test_finest_cells_far_from_those_seen_are_left_out_if_enough_was_seen(times: int, expected: int) -> None:
    """Enough are 20 weights for each of 512 cells; those that count are inside the box, at its corner and edge; the
    fourth does not."""
    model = full_model(max_level=0)
    x, y, z = torch.tensor([[1, 7, 4, 4], [1, 7, 7, 1], [1, 7, 1, 5]])
    rows = 64 * model.grid.numbers[x // 4, y // 4, z // 4].long() + 16 * (x % 4) + 4 * (y % 4) + z % 4
    weights = torch.tensor([0.05, 0.3, 1.0, 0.03])
    model.update_cells(0.39, 0.4)
    model.grid.update_max_weight(rows.repeat(times), weights.repeat(times))
    model.update_cells(0.69, 0.695)
    assert model.grid.occupied.sum() == 512
    model.update_cells(0.695, 0.7)
    assert model.grid.occupied.sum() == expected
    found = model.grid.to_cells(model.grid.occupied.reshape(-1))
    assert found[:3, :3, :3].all()
    assert found[6:, 6:, 6:].all()
    assert found[3:6, 6:, :3].all()
    assert (unpack_bits(model.grid.sampled) == model.grid.occupied).all()


def test_finest_cells_in_which_nothing_counts_are_an_error() -> None:
    model = full_model(max_level=0)
    model.grid.update_max_weight(torch.arange(512).repeat(20), torch.full((10240,), 0.01))
    with pytest.raises(FloatingPointError, match="no cell has anything"):
        model.update_cells(0.695, 0.7)


def test_weights_are_remembered_only_while_they_will_be_looked_at() -> None:
    model = full_model(max_level=0)
    rendered = model.render(tiny_rays(50, dtype=torch.float32))[1]
    assert len(rendered.cells)
    remembered = []
    for before, now in itertools.pairwise((0.0, 0.1, 0.41, 0.69, 0.71)):
        model.update_cells(before, now)
        seen = int(model.grid.num_seen)
        model.remember(rendered)
        remembered.append(int(model.grid.num_seen) > seen)
    assert remembered == [False, True, True, False]


def test_cells_that_have_become_transparent_are_not_sampled() -> None:
    model = full_model()
    with torch.no_grad():
        model.density.fill_(-20.0)
        model.density[0] = 0.0
    assert (unpack_bits(model.grid.sampled) == model.grid.occupied).all()
    model.update_sampled()
    sampled = model.grid.to_cells(unpack_bits(model.grid.sampled).reshape(-1))
    x, y, z = model.grid.bricks[0].tolist()
    assert torch.nonzero(sampled).tolist() == [[x, y, z]]  # cells on the other sides of that corner are outside
    assert torch.nonzero(model.grid.table >= 0).tolist() == [[x, y, z]]


def test_total_variation_counts_in_every_fourth_step() -> None:
    """Four times as much: without another gradient, a row moves towards its neighbors then."""
    values = torch.nn.Parameter(torch.zeros(64, 16))
    with torch.no_grad():
        values[0] = 1.0
    group = ParameterGroup([values], lr_scale=10.0, total_variation=0.1)
    config = config_of(None, size="tiny")
    adam = create_adam([group], config.preset, config.optimizer)
    gradient = torch.sparse_coo_tensor(torch.tensor([[0]]), torch.zeros(1, 16), (64, 16), check_invariants=True)
    seen = []
    for _ in range(4):
        values.grad = gradient.clone()
        adam.step()
        seen.append(values[0, 0].item())
    assert seen[:3] == [1.0] * 3
    step = 10 * config.preset.learning_rate  # of Adam, whose means are a tenth and a hundredth of the first gradient
    assert seen[3] == pytest.approx(1 - step, rel=1e-5)
    weight = 4 * 0.1 / (3 * config.preset.rays)
    assert float(adam.state[values]["exp_avg"][0, 0]) == pytest.approx(0.1 * 3 * weight, rel=1e-5)  # three neighbors


def test_a_grid_that_would_be_empty_is_an_error_once_enough_was_seen() -> None:
    """Before, it has just not learned anything: in a training of ten steps."""
    model = full_model()
    model.grid.update_max_weight(torch.arange(512).repeat(19), torch.full((19 * 512,), 0.001))
    assert not model.update_cells(0.26, 0.3)
    model.grid.update_max_weight(torch.arange(512), torch.full((512,), 0.001))
    with pytest.raises(FloatingPointError, match=r"no cell has anything.*--optimizer\.lr"):
        model.update_cells(0.26, 0.3)


def test_cells_are_subdivided_only_as_far_as_memory_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second time they would be too many."""
    monkeypatch.setattr(lean, "ROWS_PER_SEEN", 100)
    rows = 16 * 2**10 * lean.BYTES_PER_ROW / 2**30  # more than 8^3 cells and their corners take, less than 32^3
    trainer = tiny_trainer(config_of(60, max_memory=rows), VIEWS)
    model = trainer.pipeline.model
    begin = float(model.grid.cell_size)
    steps_of(trainer, 60)
    assert int(model.grid.level) == 2
    assert begin / 4 < float(model.grid.cell_size) < begin
    assert model.grid.num_rows * lean.BYTES_PER_ROW <= 1.2 * rows * 2**30
    state = model.state_dict()
    loaded = LeanModel(model.config, np.random.default_rng(1), saved_grid(state))  # pyright: ignore
    load_weights(loaded, state)
    before, after = (
        render_outputs(of, tiny_rays(50, dtype=torch.float32), ["rgb_fine"])["rgb_fine"] for of in (model, loaded)
    )
    assert torch.equal(before, after)


@pytest.mark.parametrize("stop", [5, 20, 40])
def test_a_resumed_training_is_the_same_bit_for_bit_at_every_level(
    stop: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lean, "STEPS_PER_SAMPLED", 7)
    whole = tiny_trainer(config_of(50), VIEWS)
    expected = steps_of(whole, 50)
    assert int(whole.pipeline.model.grid.level) == 2
    first = tiny_trainer(config_of(50), VIEWS, tmp_path)
    steps_of(first, stop)
    first.next_step = stop
    first.save()
    second = resume_trainer(first, VIEWS)
    assert steps_of(second, 50 - stop, stop) == expected[stop:]
    for name, value in whole.pipeline.model.state_dict().items():
        assert torch.equal(second.pipeline.model.state_dict()[name], value), name


@pytest.mark.parametrize(("rows", "levels"), [(8_000, [0, 0, 1]), (20_000, [1, 1, 2])])
def test_a_level_that_memory_will_not_allow_is_left_out_and_the_one_before_begins_later(
    rows: int, levels: list[int]
) -> None:
    """Halved cells have 8,000 rows, and four times as many are expected of the next; after 0.2025 and 0.45 of all."""
    model = full_model()
    model.config = replace(model.config, max_memory=rows * lean.BYTES_PER_ROW / 2**30)
    for now, level in zip((0.21, 0.44, 0.46), levels, strict=True):
        show_all(model)
        model.update_cells(now - 0.01, now)
        assert int(model.grid.level) == level
    assert int(model.grid.max_level) == levels[-1]


def test_cells_are_subdivided_though_a_host_still_holds_the_last_loss() -> None:
    """nerfstudio's trainer does: the graph of a loss remembers how many rows there were."""
    model, rays, batch = full_model(), tiny_rays(50, dtype=torch.float32), {"image": torch.rand(50, 4)}

    def loss() -> torch.Tensor:
        found = model.training_loss(rays, batch)[0].mean()
        found.backward()
        return found

    held = loss()
    model.grid.update_max_weight(torch.arange(512), torch.ones(512))
    assert model.update_cells(0.2, 0.21)
    loss()
    assert model.density.grad is not None
    assert model.density.grad.shape == model.density.shape
    del held
