"""Trainings of lean-nerf from files: time budgets, checkpoints, and its commands."""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from lean_models import VIEWS, config_of
from tiny import tiny_trainer

from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.config import MANAGER, MODEL, SAMPLER, TrainerConfig, override
from edge_se_sampler.engine.inspection import inspect
from edge_se_sampler.engine.pipeline import analyze_views, load_weights, saved_grid
from edge_se_sampler.engine.rendering import measure_psnr, render_rays, render_view, to_pictures
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.session import describe_run, load_model, prepare, prepare_resume
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models.config import LeanModelConfig
from edge_se_sampler.viewer.viewed import Viewed


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    return make_scenes(folder, ("bricks",), size=24, num_train=8, num_val=1, num_test=2)[0]


def trained(config: TrainerConfig) -> Trainer:
    trainer = prepare(config)
    trainer.train()
    return trainer


def test_a_time_budget_is_kept_and_its_plan_repeats_it_bit_for_bit(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = override(config_of(None), {"data": scene, "output_dir": tmp_path, "machine.device_type": "cpu"})
    with monkeypatch.context() as patch:  # a clock that goes on when it is looked at: the machine may be busy
        patch.setattr("time.monotonic", itertools.count(0, 0.01).__next__)
        first = trained(override(config, {"time_budget": "3s"}))
    assert first.elapsed + first.setup_seconds == pytest.approx(3, rel=0.05)
    saved = RunFolder(first.run.path).config(method_configs())
    assert saved.segments is not None
    assert sum(saved.segments) == first.next_step
    loaded, _ = load_model(first.run, saved)
    again = trained(override(config, {"segments": saved.segments}))
    for name, value in first.pipeline.model.state_dict().items():
        assert torch.equal(again.pipeline.model.state_dict()[name], value), name
        assert torch.equal(loaded.state_dict()[name], value), name
    previews = [line for line in first.run.metrics() if "val_psnr" in line]
    assert 2 <= len(previews) <= 11  # ten, where many steps fit into the time
    resumed = prepare_resume(first.run, saved)
    resumed.train()
    assert resumed.next_step == first.next_step


def test_a_time_budget_is_kept_where_a_resumed_run_is_set_up_sooner(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = override(config_of(None), {"data": scene, "output_dir": tmp_path, "machine.device_type": "cpu"})
    with monkeypatch.context() as patch:
        patch.setattr("time.monotonic", itertools.count(0, 0.01).__next__)
        first = prepare(override(config, {"time_budget": "6s", "max_seconds": 1.0}))
        first.setup_seconds = 2.0
        first.train()
        assert 0 < first.plan.progress(first.next_step) < 1
        resumed = prepare_resume(first.run, RunFolder(first.run.path).config(method_configs()), max_seconds=10)
        resumed.train()
    assert resumed.setup_seconds == 2
    assert resumed.elapsed == pytest.approx(4, rel=0.05)
    found = RunFolder(first.run.path).config(method_configs())
    assert found.segments is not None  # the plan that came out
    assert found.max_seconds == 1  # of the run itself


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"time_budget": "10 parsecs"}, "--time-budget is '10 parsecs'"),
        ({"time_budget": "0"}, "--time-budget is '0'"),
        ({"time_budget": "60", "max_num_iterations": 7}, "--max-num-iterations and --time-budget"),
        ({"segments": (1, 2, 3)}, "--segments"),
        ({"optimizer.eps": 0.0}, "--optimizer.eps is 0.0: must be above 0 for lean-nerf"),
        ({f"{MODEL}.prune_weight": 1.0}, "prune-weight"),
        ({f"{MODEL}.max_memory": 0.0}, "max-memory"),
        ({f"{MODEL}.max_memory": 1e300}, "max-memory"),
    ],
)
def test_bad_settings_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        tiny_trainer(override(config_of(None), changes), VIEWS)


def test_other_methods_have_no_time_budget() -> None:
    with pytest.raises(InputError, match="vanilla-nerf cannot follow"):
        tiny_trainer(override(method_configs()["vanilla-nerf"], {"time_budget": "60"}), VIEWS)


def test_budgets_are_seconds_minutes_or_hours() -> None:
    found = [override(config_of(None), {"time_budget": text}).budget_seconds for text in ("60", "1.5m", "90 s", "1h")]
    assert found == [60, 90, 90, 3600]


def test_a_finished_checkpoint_that_cannot_be_extended_has_no_moments(scene: Path, tmp_path: Path) -> None:
    """They are twice as large as the model."""
    length = {"max_num_iterations": None, "segments": (1,) * 30 + (0,) * 70}
    config = override(config_of(30), {"data": scene, "output_dir": tmp_path, "machine.device_type": "cpu", **length})
    trainer = trained(config)
    (checkpoint,) = trainer.run.checkpoints.glob("*.ckpt")
    weights = sum(value.numel() * value.element_size() for value in trainer.pipeline.model.state_dict().values())
    assert checkpoint.stat().st_size < 1.2 * weights + 50_000
    assert sys.modules["numba"]


# -- a scene of enough views and pixels to know where the object is not


@pytest.fixture
def larger(tmp_path: Path) -> Path:
    return make_scenes(tmp_path / "synthetic", ["mic"], size=48, num_train=6, num_val=1, num_test=1)[0]


def lean_config(scene: Path, output_dir: Path, **model: Any) -> TrainerConfig:
    changes = {"data": scene, "output_dir": output_dir, "max_num_iterations": 120, "machine.device_type": "cpu"}
    model = {f"{MODEL}.{name}": value for name, value in model.items()}
    return override(method_configs()["lean-nerf"], {**changes, f"{MANAGER}.train_num_rays_per_batch": 128, **model})


def test_it_learns_in_a_moment_and_its_checkpoint_renders_without_the_images(larger: Path, tmp_path: Path) -> None:
    trainer = prepare(lean_config(larger, tmp_path))
    model = trainer.pipeline.model
    views = trainer.pipeline.datamanager
    assert not bool(views.image_batch["mask"].all())  # only pixels whose rays hit the hull
    assert views.train_pixel_sampler.config.late == "expansive"
    trainer.train()
    picture = to_pictures(read_blender(larger, "test"))[0]
    psnr = measure_psnr(render_view(model, picture), picture, 1.0)
    away = picture.image[..., 3:] * (1 - picture.image[..., :3])
    background = -10 * np.log10(np.mean(away.astype(np.float64) ** 2))
    assert 5 < background < 30
    assert psnr > background + 3
    again, _ = load_model(trainer.run, trainer.config)
    rays = picture.rays(model.device)
    assert torch.equal(render_rays(again, rays), render_rays(model, rays))


def test_without_alpha_it_trains_on_all_pixels(larger: Path, tmp_path: Path) -> None:
    trainer = prepare(lean_config(larger, tmp_path, cull_by_alpha=False))
    analysis = analyze_views(read_blender(larger, "train"), trainer.config.pipeline.model)
    assert analysis.num_silhouettes == 0
    assert trainer.pipeline.model.grid.is_of_the_same_scene(analysis.grid())
    views = trainer.pipeline.datamanager
    assert "mask" not in views.image_batch
    loss = [trainer.train_iteration(step) for step in range(3)]
    assert all(np.isfinite(loss))


@pytest.mark.parametrize("by_alpha", [True, False])
def test_pixels_that_were_chosen_stay_chosen(by_alpha: bool, larger: Path, tmp_path: Path) -> None:
    config = lean_config(larger, tmp_path, cull_by_alpha=by_alpha)
    sampler = prepare(override(config, {f"{SAMPLER}.early": "edge"})).pipeline.datamanager.train_pixel_sampler
    assert (sampler.strategy, sampler.config.schedule) == ("edge", "fraction")


@pytest.mark.parametrize(("by_alpha", "early"), [(True, "uniform"), (False, "edge until the object is learned")])
def test_edges_come_first_where_no_alpha_tells_where_the_object_is(
    by_alpha: bool, early: str, larger: Path, tmp_path: Path
) -> None:
    config = lean_config(larger, tmp_path, cull_by_alpha=by_alpha)
    trainer = prepare(override(config, {f"{SAMPLER}.early": "auto", f"{SAMPLER}.late": "se"}))
    assert f"pixels   {early}" in describe_run(trainer)


def test_a_run_is_not_resumed_on_a_scene_that_has_changed(larger: Path, tmp_path: Path) -> None:
    trainer = trained(override(lean_config(larger, tmp_path), {"max_num_iterations": 1}))
    image = next(path for path in sorted(larger.rglob("*.png")) if "train" in str(path))
    changed_pixels = iio.imread(image)
    changed_pixels[:12] = 255
    iio.imwrite(image, changed_pixels)
    with pytest.raises(InputError, match=r"cells are not the checkpoint's.* --changed-data True"):
        prepare_resume(trainer.run, trainer.config)
    grid = trainer.pipeline.model.grid
    resumed = prepare_resume(trainer.run, trainer.config, max_num_iterations=3, changed_data=True)
    assert (resumed.pipeline.model.grid.bricks == grid.bricks).all()
    resumed.train()
    assert resumed.next_step == 3
    grid = resumed.pipeline.model.grid
    assert (Viewed.load(trainer.run, trainer.config).model.grid.bricks == grid.bricks).all()  # as rendering does
    again = prepare_resume(trainer.run, resumed.config, max_num_iterations=4)  # these are its images now
    assert (again.pipeline.model.grid.bricks == grid.bricks).all()


def test_the_viewer_knows_the_phase_of_a_run_by_the_clock(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before it has ended, its checkpoint alone tells how far it is."""
    phases = {f"{SAMPLER}.early": "edge", f"{SAMPLER}.late": "se"}
    changes = {"data": scene, "output_dir": tmp_path, "machine.device_type": "cpu", "time_budget": "3s", **phases}
    trainer = prepare(override(config_of(None), changes))
    train_iteration = trainer.train_iteration

    def interrupted(step: int) -> float:
        trainer.stop_requested = trainer.progress(step) > 0.4
        return train_iteration(step)

    monkeypatch.setattr(trainer, "train_iteration", interrupted)
    monkeypatch.setattr("time.monotonic", itertools.count(0, 0.01).__next__)
    trainer.train()
    viewed = Viewed.load(trainer.run, RunFolder(trainer.run.path).config(method_configs()))
    assert (viewed.trainer.next_step, viewed.strategy) == (trainer.next_step, "se")


def test_a_budget_and_what_one_came_out_as_are_not_both_given(larger: Path, tmp_path: Path) -> None:
    config = override(lean_config(larger, tmp_path), {"time_budget": "10m", "segments": (1,) * 100})
    with pytest.raises(InputError, match="--time-budget and --segments: give one of them"):
        prepare(config)


def test_weights_of_another_model_are_refused() -> None:
    one, other = (tiny_trainer(config_of(5, voxel_size_px=size), VIEWS).pipeline.model for size in (0.5, 1.0))
    with pytest.raises(InputError, match="not this model's"):
        load_weights(one, other.state_dict())
    with pytest.raises(InputError, match="another version"):
        saved_grid({"grid.corner": torch.zeros(3)})


def test_commands_refuse_what_has_no_meaning(scene: Path, tmp_path: Path, edge_se: Any) -> None:
    flags = ["train", "lean-nerf", "--data", scene, "--output-dir", tmp_path / "out", "--max-num-iterations", "3"]
    for flag, value, word in (
        ("--pipeline.model.voxel-size-px", "0", "voxel-size-px is 0.0"),
        ("--pipeline.model.voxel-size-px", "1e-300", "at least 0.01"),
        ("--pipeline.model.step-size-voxels", "nan", "step-size-voxels is nan"),
        ("--pipeline.model.step-size-voxels", "1e-6", "at least 0.05"),
        ("--pipeline.model.voxel-size-px", "1e300", "at most 1000"),
        ("--pipeline.model.far", "1e308", "far <= 1e+25"),
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


@pytest.mark.parametrize("far", [6.0, 1e25])
def test_from_the_command_line(far: float, scene: Path, tmp_path: Path, edge_se: Any) -> None:
    flags = ["--data", scene, "--output-dir", tmp_path / "out", "--max-num-iterations", "8"]
    flags += ["--pipeline.model.far", far]
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
    assert findings["cells"].startswith(f"{analysis.hull.cell_size:.4f} a side, 4.0 pixels")
    assert findings["levels"].startswith("what training sees is subdivided 2 times, to about 1 pixel, ")
    assert findings["silhouettes"].startswith("6 of 6 views")
    assert findings["pixel"].startswith(f"{analysis.box.pixel_footprint:.4f}")
    assert findings["rays"].startswith(f"{100 * np.mean(analysis.hit_pixels):.1f} %")
    assert "training draws among them" in findings["rays"]
    assert iio.imread(tmp_path / "inspect.png").shape[1] > 500
    assert findings["training"] == "2048 rays a step, 4,000 steps: size tiny, by the images' longer side"
    unlocated = inspect(read_blender(larger, "train"), LeanModelConfig(cull_by_alpha=False), tmp_path / "open.png")
    assert "training draws among them" not in unlocated
    whole = analyze_views(read_blender(larger, "train"), LeanModelConfig(cull_by_alpha=False)).hull.cells
    assert f"{whole.sum():,} of {whole.size:,} may hold something ({100 * whole.mean():.1f} %)" in unlocated
    for flag, value in (("--near", "7"), ("--voxel-size-px", "0"), ("--downscale", "0")):
        assert edge_se("inspect", "--data", larger, flag, value).code == 2
