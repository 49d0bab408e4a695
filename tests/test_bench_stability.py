"""The robustness sweep: its settings and images, how a training ends (on networks built to be in each state), and what
the report counts."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from edge_se_sampler.bench import command
from edge_se_sampler.bench.outcomes import Outcome
from edge_se_sampler.bench.results import new_result, write_result
from edge_se_sampler.bench.stability import report, scenes
from edge_se_sampler.bench.stability import train as train_module
from edge_se_sampler.bench.stability.scenes import COLORS, background_of, read_real_splits, render_splits
from edge_se_sampler.bench.stability.settings import AXES, PAIRS, SETTINGS, SYNTHETIC_SETTINGS, Setting, Trial
from edge_se_sampler.bench.stability.train import (
    TrainingSize,
    build_trainer,
    failure_mode,
    measure_views,
    run_trial,
)
from edge_se_sampler.bench.train import cached_scene
from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.data.downscale import average_pixels
from edge_se_sampler.engine.reinitialization import dead_networks
from edge_se_sampler.engine.rendering import to_pictures
from edge_se_sampler.models.nerf import NeRFModel
from edge_se_sampler.sampling.distribution import PixelTable
from edge_se_sampler.sampling.edges import edge_strength

SMALL = TrainingSize(iterations=4, rays=8, width=8, samples=4)
BASE = Setting()
CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def small_images(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(scenes, "SIZE", 24)
    monkeypatch.setattr(scenes, "SHIFT", (5, 3))
    scenes.render_splits.cache_clear()
    yield
    scenes.render_splits.cache_clear()


# -- settings


def test_every_setting_is_different_and_named_by_what_it_changes() -> None:
    assert len(SYNTHETIC_SETTINGS) == 1 + sum(len(values) for _, values in AXES.values()) + len(PAIRS) == 24
    assert len(set(SETTINGS.values())) == len(SETTINGS) == 24 + 2 * 5
    assert SETTINGS["base"] == BASE
    assert SETTINGS["off centre, 10 views"] == Setting(placement="shifted", num_views=10)


# -- images


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_the_object_covers_the_share_that_a_setting_wants(share: float) -> None:
    train, test = render_splits(share, False, 12)
    assert (len(train.images), len(test.images)) == (12, scenes.NUM_TEST)
    assert np.mean([image[..., 3] > 0 for image in train.images]) == pytest.approx(share, rel=0.1)


def test_off_centre_shows_the_same_picture_shifted_by_whole_pixels() -> None:
    centered, shifted = (render_splits(0.05, off_center, 3)[0] for off_center in (False, True))
    dx, dy = scenes.SHIFT
    for before, after in zip(centered.images, shifted.images, strict=True):
        np.testing.assert_array_equal(after, np.roll(before, (dy, dx), axis=(0, 1)))
    assert (shifted.cameras.cx - centered.cameras.cx).eq(dx).all()
    assert (shifted.cameras.cy - centered.cameras.cy).eq(dy).all()


def test_a_real_scene_is_as_small_and_where_a_setting_wants_it(tmp_path: Path) -> None:
    folder = cached_scene(tmp_path, "mic", size=96, num_train=9, num_val=1, num_test=6)
    whole, test = read_real_splits(folder, None, False, 5)
    assert (len(whole.images), len(test.images)) == (5, scenes.NUM_TEST)
    np.testing.assert_array_equal(whole.images[1], average_pixels(read_blender(folder, "train").images[2], 4))
    share = np.mean([image[..., 3] > 0 for image in whole.images])
    small, _ = read_real_splits(folder, share / 4, False, 5)
    assert np.mean([image[..., 3] > 0 for image in small.images]) == pytest.approx(share / 4, rel=0.25)
    shifted, _ = read_real_splits(folder, share / 4, True, 5)
    dx, dy = scenes.SHIFT
    for before, after in zip(small.images, shifted.images, strict=True):
        np.testing.assert_array_equal(after, np.roll(before, (dy, dx), axis=(0, 1)))
    for views, dx, dy in ((whole, 0, 0), (small, 0, 0), (shifted, *scenes.SHIFT)):
        factor = round(float(read_blender(folder, "train").cameras.fx[0] / views.cameras.fx[0]))
        corner = (24 - 96 // factor) // 2
        axis = -views.cameras.camera_to_worlds[2, :, 2]  # seen in the middle of the scene's own images
        middle = torch.tensor([[corner + 48 / factor + dy, corner + 48 / factor + dx]], dtype=torch.float64)
        torch.testing.assert_close(views.cameras.generate_rays(torch.tensor([[2]]), middle).directions[0], axis)


def test_backgrounds() -> None:
    rays = to_pictures(render_splits(0.05, False, 3)[1])[0].rays(CPU)
    green, textured = background_of("green"), background_of("textured")
    assert background_of("random") is None
    assert green is not None
    assert textured is not None
    torch.testing.assert_close(green(rays), torch.tensor(COLORS["green"]).expand(len(rays), 3))
    colors = textured(rays).reshape(24, 24, 3)
    assert colors.min() >= 0
    assert colors.max() <= 1
    assert (colors[:, 4:] - colors[:, :-4]).abs().mean() > 0.1  # changes within a few pixels


# -- how a training ends


@pytest.mark.parametrize(
    ("outcome", "accumulation", "dead_at_start", "mode"),
    [
        ("converged", 0.0, False, None),
        ("converged", 0.0, True, None),  # it was reinitialized
        ("underfit", 1.0, True, "underfit"),
        ("collapsed", 0.0, True, "dead at the start"),
        ("collapsed", 0.0, False, "emptied"),
        ("collapsed", 1.0, False, "opaque background"),
    ],
)
def test_failure_modes(outcome: Outcome, accumulation: float, dead_at_start: bool, mode: str | None) -> None:
    assert failure_mode(outcome, accumulation, dead_at_start) == mode


def constant_model(raw_density: float, setting: Setting, folder: Path) -> tuple[NeRFModel, Any]:
    """A model of one raw density and white everywhere, and held-out views."""
    trainer, pictures = build_trainer(setting, "vanilla-nerf", 0, SMALL, folder)
    model = trainer.pipeline.model
    with torch.no_grad():
        for field in (model.coarse, model.fine):
            field.density.weight.zero_()
            field.density.bias.fill_(raw_density)
            field.color.weight.zero_()
            field.color.bias.fill_(20.0)  # white
    return model, pictures


def test_an_empty_network_shows_the_background_alone(tmp_path: Path) -> None:
    model, pictures = constant_model(-1.0, BASE, tmp_path)
    assert dead_networks(model, [picture.rays(CPU) for picture in pictures]) == ["coarse", "fine"]
    measured = measure_views(model, pictures)
    assert measured["foreground_share"] == pytest.approx(1)
    assert measured["psnr"] == pytest.approx(measured["background_psnr"])
    assert measured["accumulation"] == 0


def test_an_opaque_white_network_has_collapsed_although_it_is_not_dead(tmp_path: Path) -> None:
    model, pictures = constant_model(50.0, BASE, tmp_path)
    assert dead_networks(model, [picture.rays(CPU) for picture in pictures]) == []
    measured = measure_views(model, pictures)
    assert measured["accumulation"] > 0.99
    assert measured["foreground_share"] == pytest.approx(1, abs=0.05)


def test_a_network_with_small_errors_has_converged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer, pictures = build_trainer(BASE, "vanilla-nerf", 0, SMALL, tmp_path)
    model = trainer.pipeline.model
    monkeypatch.setattr(model, "squared_error", lambda outputs, image, network: torch.full((len(image),), 1e-4))
    measured = measure_views(model, pictures)
    assert measured["foreground_share"] < 0.01
    assert measured["psnr"] == pytest.approx(-10 * np.log10(1e-4 / 3))


# -- a training


@pytest.mark.parametrize(
    "setting",
    [
        BASE,
        Setting(placement="shifted", num_views=10),
        Setting(background="textured"),
        Setting(background="random", density_noise=1.0),
    ],
)
def test_a_trainer_follows_its_setting(setting: Setting, tmp_path: Path) -> None:
    trainer, pictures = build_trainer(setting, "adaptive", 3, SMALL, tmp_path)
    assert len(trainer.pipeline.datamanager.image_batch["image"]) == setting.num_views
    assert trainer.pipeline.model.config.density_noise == setting.density_noise
    assert vars(trainer.config.pipeline.datamanager.pixel_sampler)["schedule"] == "adaptive"
    assert trainer.dead_network_reset is not None
    background = background_of(setting.background)
    if background is not None:
        rays = pictures[0].rays(CPU)[:5]
        torch.testing.assert_close(trainer.pipeline.model(rays)["background"], background(rays))
    assert np.isfinite(trainer.train_iteration(0))


@pytest.mark.parametrize("background", ["white", "black", "grey", "green"])
def test_edges_are_those_in_front_of_the_settings_background(background: Any, tmp_path: Path) -> None:
    trainer, _ = build_trainer(Setting(background=background), "edge-nerf", 3, SMALL, tmp_path)
    manager = trainer.pipeline.datamanager
    edges = edge_strength(manager.image_batch["image"][0].numpy(), background=COLORS[background]) + np.float32(0.01)
    sampler = manager.train_pixel_sampler
    table, table_index = sampler.strategies["edge"].distribution.tables(sampler._read(manager.image_batch))
    assert isinstance(table, PixelTable)
    probability = table.probability(int(table_index[0])).numpy()
    np.testing.assert_allclose(probability, edges / edges.sum(), rtol=1e-3, atol=1e-9)


def test_a_run_repeats_itself() -> None:
    trial = Trial("torch initialisation", "vanilla-nerf", 5)
    run, repeated = (run_trial(trial, SMALL) for _ in range(2))
    assert run["failure_mode"] is not None  # after four steps
    del run["cpu_seconds"], repeated["cpu_seconds"]
    assert run == repeated == json.loads(json.dumps(run))


# -- the report


def test_the_tables_count_failures_and_failure_modes() -> None:
    def run(strategy: str, seed: int, mode: str | None) -> dict[str, Any]:
        outcome = "converged" if mode is None else "collapsed"
        return {"setting": "base", "strategy": strategy, "seed": seed, "outcome": outcome, "failure_mode": mode}

    modes = ["emptied", "emptied", "opaque background", *[None] * 7]
    runs = [run("vanilla-nerf", seed, mode) for seed, mode in enumerate(modes)] + [run("adaptive", 0, None)]
    counts = report.count_failure_modes(runs)
    assert "| base | 3/10 [11–60%] (2 emptied, 1 opaque) | 0/1 [0–79%] |" in report.tabulate_settings(counts)
    assert "| Random | 3 of 10 | 0 | 2 | 1 | 0 | 0 | 0 |" in report.tabulate_strategies(counts)


def test_real_scenes_are_counted_apart(tmp_path: Path) -> None:
    labels = {"base": None, "real lego, object 2%": "emptied"}
    runs = [
        {"setting": label, "strategy": "edge-nerf", "seed": seed, "outcome": "-", "failure_mode": mode}
        for label, mode in labels.items()
        for seed in range(2)
    ]
    write_result(tmp_path / "result.json", new_result("stability", asdict(SMALL)) | {"errors": [], "runs": runs})
    page = report.describe(tmp_path)
    assert "| Edge | 0 of 2 |" in page
    assert page.index("| base | 0/2") < page.index("## On real scenes") < page.index("| real lego, object 2% | **2/2**")


def test_the_command_trains_and_reports_a_small_sweep(
    tmp_path: Path, edge_se: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train_module, "TrainingSize", lambda: SMALL)
    monkeypatch.setattr(command, "executor_factory", lambda *_: lambda: ThreadPoolExecutor(1))
    out = tmp_path / "new" / "out"
    flags = ["--settings", "base", "off centre", "--strategies", "vanilla-nerf", "adaptive", "--seeds", 0]
    answer = edge_se("bench", "stability", "--output-dir", out, "--workplace", tmp_path / "w", *flags)
    assert answer.code == 0, answer
    assert {path.name for path in out.iterdir()} == {"result.json", "README.md"}
    runs = json.loads((out / "result.json").read_text())["runs"]
    assert [(run["setting"], run["strategy"]) for run in runs] == [
        ("base", "adaptive"), ("base", "vanilla-nerf"), ("off centre", "adaptive"), ("off centre", "vanilla-nerf"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (("--settings", "99"), "--settings: '99'"),
        (("--strategies", "se"), "--strategies: 'se'"),
        (("--workers", "0"), "--workers"),
        (("--settings", "real lego, object 5%"), "needs --scenes-dir"),
        (("--scenes-dir", "nowhere"), "--scenes-dir nowhere: has no folder"),
    ],
)
def test_flags_without_meaning_are_refused(flags: tuple[str, ...], named: str, tmp_path: Path, edge_se: Any) -> None:
    answer = edge_se("bench", "stability", "--output-dir", tmp_path / "out", *flags)
    assert answer.code == 2
    assert named in answer.err
    assert answer.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
