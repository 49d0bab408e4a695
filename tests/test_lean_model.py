"""The lean model: gradients, cells that come and go, its state, and a training from files to a checkpoint and back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from tiny import cells, check_gradients, occupied_after, tiny_model, tiny_rays
from torch import Tensor

from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.config import SAMPLER, TrainerConfig, override
from edge_se_sampler.engine.inspection import inspect
from edge_se_sampler.engine.pipeline import analyze_views, load_weights, saved_grid
from edge_se_sampler.engine.rendering import render_rays, render_view, to_pictures
from edge_se_sampler.engine.session import describe_run, load_model, prepare, prepare_resume
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models import lean
from edge_se_sampler.models.config import LeanModelConfig
from edge_se_sampler.models.lean import UPDATE_INTERVAL, LeanModel
from edge_se_sampler.occupancy.grid import OccupancyGrid
from edge_se_sampler.occupancy.hull import Hull, find_hit_pixels

RAYS = 12
FIRST_PRUNING = 2 * UPDATE_INTERVAL
SIDE = 0.3


def ball(radius: float = 1.0) -> Hull:
    count = 8
    at = (np.arange(count) + 0.5 - count / 2) * SIDE
    inside = np.linalg.norm(np.stack(np.meshgrid(at, at, at, indexing="ij")), axis=0) < radius
    return Hull(np.full(3, -count * SIDE / 2), SIDE, inside)


def model_in(hull: Hull, **changes: Any) -> LeanModel:
    """A tiny one in float64, its features not all 0."""
    config = replace(
        LeanModelConfig(size="tiny", width=8, depth=2, position_frequencies=2, direction_frequencies=1, feature_dim=3),
        **changes,
    )
    model = LeanModel(config, np.random.default_rng(0), OccupancyGrid.from_hull(hull)).double()
    assert model.features is not None
    with torch.no_grad():
        model.features.table.copy_(torch.from_numpy(np.random.default_rng(1).normal(size=model.features.table.shape)))
    return model


def reloaded(model: LeanModel) -> LeanModel:
    """Another model from its state."""
    state = model.state_dict()
    grid = saved_grid(state)
    assert isinstance(grid, OccupancyGrid)
    other = LeanModel(model.config, np.random.default_rng(5), grid).to(model.dtype)
    load_weights(other, state)
    return other


def pixels() -> Tensor:
    return torch.from_numpy(np.random.default_rng(2).random((RAYS, 4)))


def loss_of(model: LeanModel) -> Tensor:
    model.begin_step(3, 7)
    return model.training_loss(tiny_rays(RAYS), {"image": pixels()})[0].sum()


def test_gradients_of_everything_against_finite_differences() -> None:
    model = model_in(ball(), background_color="random").train()
    check_gradients(model, lambda: loss_of(model))


def test_culled_rendering_equals_dense_rendering_of_zeros_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same samples in a box that is wholly occupied, their density set to 0 outside of the ball."""
    hull = ball()
    culled = model_in(hull).eval()
    whole = model_in(Hull(hull.aabb_min, SIDE, np.ones_like(hull.cells))).eval()
    whole.fine.load_state_dict(culled.fine.state_dict())
    one, other = culled.features, whole.features
    assert one is not None
    assert other is not None
    with torch.no_grad():
        shape = cells(whole).occupied.shape
        number = other.cell_to_row[np.ravel_multi_index(one.cell_origin.long().T.numpy(), shape)]
        other.table[other.rows[number.long()]] = one.table[one.rows]
    inside = cells(culled).contains
    field = whole.fine.forward

    def masked(positions: Tensor, *others: Any) -> tuple[Tensor, Tensor]:
        raw, color = field(positions, *others)
        world = positions * cells(whole).half_extent + cells(whole).center
        return torch.where(inside(world), raw, -torch.inf), color

    monkeypatch.setattr(whole.fine, "forward", masked)
    rays = tiny_rays(RAYS)
    # both march from where the same box begins
    cells(whole).aabb_min.copy_(cells(culled).aabb_min)
    shown, expected = culled(rays), whole(rays)
    assert 0.01 < float(shown["accumulation_fine"].detach().mean()) < 0.99
    for key in ("rgb_fine", "accumulation_fine", "depth_fine"):
        torch.testing.assert_close(shown[key], expected[key], rtol=0, atol=1e-9)


def test_rays_that_miss_the_scene_show_the_background_and_have_no_gradient() -> None:
    model = model_in(ball(0.3)).train()
    rays = tiny_rays(RAYS)
    away = type(rays)(rays.origins, -rays.directions, rays.camera_indices, rays.metadata)
    error, _ = model.training_loss(away, {"image": pixels()})
    error.sum().backward()
    assert bool((model.eval()(away)["rgb_fine"] == 1).all())
    assert all(weight.grad is None or not weight.grad.any() for weight in model.parameters())


# -- cells that come and go


def test_empty_cells_are_pruned_and_some_reactivated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lean, "DENSITY_BIAS", -20.0)  # nothing anywhere
    model = model_in(ball()).train()
    before = int(cells(model).occupied.sum())
    model.training_loss(tiny_rays(200), {"image": pixels().repeat(17, 1)[:200]})
    assert occupied_after(model, FIRST_PRUNING - UPDATE_INTERVAL) == before  # too early
    assert occupied_after(model, FIRST_PRUNING + 1) == before  # not the time
    first = occupied_after(model, FIRST_PRUNING)
    assert 0 < first < 0.1 * before  # a fiftieth on average
    again = cells(model).occupied.clone()
    occupied_after(model, FIRST_PRUNING + UPDATE_INTERVAL)
    assert not torch.equal(again, cells(model).occupied)  # others


def test_densities_of_the_first_interval_do_not_count() -> None:
    model = model_in(ball()).train()
    before = int(cells(model).occupied.sum())
    model.training_loss(tiny_rays(2000), {"image": torch.ones(2000, 3).double()})
    assert occupied_after(model, UPDATE_INTERVAL) == before
    assert occupied_after(model, FIRST_PRUNING) < 0.1 * before  # nothing was seen since


def test_a_dense_cell_stays() -> None:
    model = model_in(ball()).train()
    before = int(cells(model).occupied.sum())
    for seed in range(3):
        rays = tiny_rays(2000, seed)
        model.training_loss(rays, {"image": torch.ones(2000, 3).double()})
    assert occupied_after(model, FIRST_PRUNING) > 0.95 * before


def test_without_features_there_is_the_network_alone() -> None:
    config = LeanModelConfig(
        size="tiny", width=8, depth=2, position_frequencies=2, direction_frequencies=1, feature_dim=0
    )
    model = LeanModel(config, np.random.default_rng(0), OccupancyGrid.from_hull(ball()))
    (group,) = model.parameter_groups()
    assert group.lr_scale == 1
    assert len(group.parameters) == len(list(model.fine.parameters())) == len(list(model.parameters()))
    loss_of(model.double().train()).backward()
    assert model.fine.layers[0].weight.grad.any()  # pyright: ignore


@pytest.mark.parametrize("off", [{"cull_by_density": False}, {"empty_space_skipping": False}])
def test_without_culling_nothing_is_pruned(off: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lean, "DENSITY_BIAS", -20.0)
    model = model_in(ball(), **off).train()
    before = int(cells(model).occupied.sum())
    model.training_loss(tiny_rays(200), {"image": pixels().repeat(17, 1)[:200]})
    assert not bool(cells(model).max_density.any())
    assert occupied_after(model, FIRST_PRUNING) == before


def test_pruning_is_a_function_of_the_seed() -> None:
    one, other = (model_in(ball()) for _ in range(2))
    for model in (one, other):
        torch.rand(3)  # the global generator is nobody's
        model.begin_step(FIRST_PRUNING, 11)
    assert torch.equal(cells(one).occupied, cells(other).occupied)


# -- state


@pytest.mark.parametrize("count", [6, 40])
def test_an_uncarved_box_is_transparent_at_first(count: int) -> None:
    size = 3.0
    cube = Hull(np.full(3, -size / 2), size / count, np.ones((count, count, count), dtype=bool))
    config = LeanModelConfig(size="tiny", width=32, depth=1, position_frequencies=4, direction_frequencies=2)
    model = LeanModel(config, np.random.default_rng(0), OccupancyGrid.from_hull(cube))
    cube.cells[: count // 2] = False  # carved
    fog = LeanModel(config, np.random.default_rng(0), OccupancyGrid.from_hull(cube))
    rays = tiny_rays(RAYS, dtype=torch.float32)
    met = model.eval()(rays)["accumulation_fine"]
    assert 0.3 < float(met.detach().max()) < 0.9
    assert float(fog.eval()(rays)["accumulation_fine"].detach().max()) > 0.8
    assert torch.equal(reloaded(model).eval()(rays)["accumulation_fine"], met)


def test_a_state_holds_its_grid() -> None:
    model = model_in(ball())
    cells(model).occupied[3] = False
    fresh = reloaded(model)
    rays = tiny_rays(RAYS)
    assert torch.equal(fresh.eval()(rays)["rgb_fine"], model.eval()(rays)["rgb_fine"])
    assert torch.equal(cells(fresh).occupied, cells(model).occupied)


def test_grids_of_other_scenes_are_told_apart() -> None:
    """As many corners, elsewhere: features would be read at the wrong ones without a word."""
    model, mirrored = model_in(ball()), ball()
    one = model_in(replace(mirrored, aabb_min=mirrored.aabb_min + 1e-3))
    mirrored.cells[0] = False
    mirrored.cells[0, 4, 4] = True
    for other in (one, model_in(mirrored)):
        assert not model.grid.is_of_the_same_scene(other.grid)
    assert model.grid.is_of_the_same_scene(model_in(ball()).grid)


def test_a_run_is_not_resumed_on_a_scene_that_has_changed(larger: Path, tmp_path: Path) -> None:
    config = replace(lean_config(larger, tmp_path), max_num_iterations=1)
    trainer = prepare(config)
    trainer.train()
    image = next(path for path in sorted(larger.rglob("*.png")) if "train" in str(path))
    changed_pixels = iio.imread(image)
    changed_pixels[:12] = 255
    iio.imwrite(image, changed_pixels)
    with pytest.raises(InputError, match="cells are not the checkpoint's"):
        prepare_resume(trainer.run, trainer.config)


def test_weights_of_another_model_are_refused() -> None:
    with pytest.raises(InputError, match="not this model's"):
        load_weights(model_in(ball(), feature_dim=2), model_in(ball()).state_dict())
    with pytest.raises(InputError, match="another version"):
        saved_grid({"grid.corner": torch.zeros(3)})


def test_nerf_on_a_grid_that_is_all_occupied_is_the_dense_nerf() -> None:
    everything, middle = (
        OccupancyGrid.from_hull(Hull(np.full(3, -half), size, np.ones((count,) * 3, dtype=bool)))
        for half, size, count in ((9.0, 1.0, 18), (0.3, 0.2, 3))
    )
    dense, whole, part = (
        tiny_model(grid=grid, density_activation="softplus").eval() for grid in (None, everything, middle)
    )
    rays = tiny_rays(RAYS)
    for key, value in dense(rays).items():
        torch.testing.assert_close(whole(rays)[key], value, rtol=0, atol=1e-12)
    assert float((part(rays)["rgb_fine"] - dense(rays)["rgb_fine"]).detach().abs().max()) > 1e-3


# -- from files


@pytest.fixture
def larger(tmp_path: Path) -> Path:
    """A scene of enough views and pixels to know where the object is not."""
    return make_scenes(tmp_path / "synthetic", ["mic"], size=48, num_train=6, num_val=1, num_test=1)[0]


def lean_config(scene: Path, output_dir: Path, **model: Any) -> TrainerConfig:
    config: TrainerConfig = method_configs()["lean-nerf"]
    manager = replace(config.pipeline.datamanager, train_num_rays_per_batch=128)
    pipeline = replace(config.pipeline, datamanager=manager, model=replace(config.pipeline.model, **model))
    machine = replace(config.machine, device_type="cpu")
    return replace(
        config, data=scene, output_dir=output_dir, max_num_iterations=120, pipeline=pipeline, machine=machine
    )


def test_it_learns_in_a_moment_and_its_checkpoint_renders_without_the_images(larger: Path, tmp_path: Path) -> None:
    trainer = prepare(lean_config(larger, tmp_path))
    model = trainer.pipeline.model
    views = trainer.pipeline.datamanager
    assert not bool(views.image_batch["mask"].all())  # only pixels whose rays hit the hull
    assert views.train_pixel_sampler.strategy == "uniform"
    trainer.train()
    picture = to_pictures(read_blender(larger, "test"))[0]
    _, psnr = render_view(model, picture)
    away = picture.image[..., 3:] * (1 - picture.image[..., :3])
    background = -10 * np.log10(np.mean(away.astype(np.float64) ** 2))
    assert 5 < background < 30
    assert psnr > background + 3
    again, _ = load_model(trainer.run, trainer.config)
    rays = picture.rays(model.device)
    assert torch.equal(render_rays(again, rays), render_rays(model, rays))


def test_without_alpha_it_trains_on_all_pixels_by_edges_while_they_pay(larger: Path, tmp_path: Path) -> None:
    trainer = prepare(lean_config(larger, tmp_path, cull_by_alpha=False))
    analysis = analyze_views(read_blender(larger, "train"), trainer.config.pipeline.model)
    assert (analysis.max_level, analysis.num_silhouettes) == (1, 0)
    assert cells(trainer.pipeline.model).is_of_the_same_scene(
        OccupancyGrid.from_hull(analysis.hull, analysis.max_level)
    )
    views = trainer.pipeline.datamanager
    assert "mask" not in views.image_batch
    loss = [trainer.train_iteration(step) for step in range(3)]
    assert all(np.isfinite(loss))
    sampler = views.train_pixel_sampler
    assert (sampler.strategy, sampler.schedule.observations) == ("edge", 3)
    assert "pixels   edge until the object is learned, then uniform" in describe_run(trainer)


@pytest.mark.parametrize("by_alpha", [True, False])
def test_pixels_that_were_chosen_stay_chosen(by_alpha: bool, larger: Path, tmp_path: Path) -> None:
    config = lean_config(larger, tmp_path, cull_by_alpha=by_alpha)
    chosen = "edge" if by_alpha else "uniform"
    sampler = prepare(override(config, {f"{SAMPLER}.early": chosen})).pipeline.datamanager.train_pixel_sampler
    assert (sampler.strategy, sampler.config.schedule) == (chosen, "fraction")


def test_commands_refuse_what_has_no_meaning(scene: Path, tmp_path: Path, edge_se: Any) -> None:
    flags = ["train", "lean-nerf", "--data", scene, "--output-dir", tmp_path / "out", "--max-num-iterations", "3"]
    for flag, value, word in (
        ("--pipeline.model.voxel-size-px", "0", "voxel-size-px is 0.0"),
        ("--pipeline.model.step-size-voxels", "nan", "step-size-voxels is nan"),
        ("--pipeline.model.feature-dim", "-1", "feature-dim is -1"),
        ("--pipeline.model.feature-dim", "100000", "between 0 and 64"),
        ("--pipeline.model.step-size-voxels", "1e-6", "at least 0.05"),
        ("--pipeline.model.voxel-size-px", "1e300", "at most 1000"),
        ("--reinit-dead", "True", "cannot die"),
        ("--pipeline.datamanager.pixel-sampler.error-source", "coarse", "no coarse network"),
    ):
        answer = edge_se(*flags, flag, value)
        assert answer.code == 2, (flag, answer)
        assert word in answer.err
        assert answer.err.count("\n") == 1
    flags[1] = "edge-nerf"
    answer = edge_se(*flags, "--pipeline.datamanager.skip-empty-rays", "True")
    assert answer.code == 2
    assert "add --pipeline.model.empty-space-skipping True" in answer.err
    assert not (tmp_path / "out").exists()


def test_from_the_command_line(scene: Path, tmp_path: Path, edge_se: Any) -> None:
    flags = ["--data", scene, "--output-dir", tmp_path / "out", "--max-num-iterations", "8"]
    assert edge_se("train", "lean-nerf", *flags).code == 0
    (run,) = (tmp_path / "out").glob("*/lean-nerf/*")
    answer = edge_se("eval", run, "--output-path", tmp_path / "eval.json")
    assert answer.code == 0, answer
    assert json.loads((tmp_path / "eval.json").read_text())["method_name"] == "lean-nerf"


def test_inspect_tells_what_was_derived(larger: Path, tmp_path: Path, edge_se: Any) -> None:
    answer = edge_se("inspect", "--data", larger, "--output-path", tmp_path / "inspect.png")
    assert answer.code == 0, answer
    findings = dict(line.split(maxsplit=1) for line in answer.out.splitlines()[:-1])
    analysis = analyze_views(read_blender(larger, "train"), LeanModelConfig())
    assert f"{analysis.hull.cells.sum():,} of" in findings["cells"]
    assert findings["silhouettes"].startswith("6 of 6 views")
    assert findings["pixel"].startswith(f"{analysis.box.pixel_footprint:.4f}")
    hit = find_hit_pixels(read_blender(larger, "train"), analysis.hull)
    assert findings["rays"].startswith(f"{100 * np.mean(hit):.1f} %")
    assert iio.imread(tmp_path / "inspect.png").shape[1] > 500
    assert findings["sampling"].startswith("uniform")
    wave = 2 * np.pi * float(analysis.grid().half_extent) / 2**5 / analysis.box.pixel_footprint
    assert wave > 2  # pixels: no more than the cameras resolve
    assert findings["encoding"].startswith(f"6 frequencies of a position, the finest wave {wave:.1f} pixels long")
    assert findings["network"] == "1 x 64, 256 rays a step, 12,000 steps: size tiny, by the images' longer side"
    unlocated = inspect(read_blender(larger, "train"), LeanModelConfig(cull_by_alpha=False), tmp_path / "open.png")
    assert "by edges as long as they pay" in unlocated
    large = analyze_views(read_blender(larger, "train"), LeanModelConfig(cull_by_alpha=False))
    for cells_line, finest in ((unlocated, large.hull.cell_size / 2), (findings["cells"], analysis.hull.cell_size)):
        assert f"training begins with {2 * finest:.4f}, subdivided to {finest:.4f} if dense" in cells_line
    whole = large.hull.cells
    assert f"{whole.sum():,} of {whole.size:,} may hold something ({100 * whole.mean():.1f} %)" in unlocated
    for flag, value in (
        ("--near", "7"),
        ("--voxel-size-px", "0"),
        ("--step-size-voxels", "inf"),
        ("--step-size-voxels", "1e-5"),
    ):
        assert edge_se("inspect", "--data", larger, flag, value).code == 2
