"""The map of stability: how a training is judged, on networks built to be in each state, and what the map shows."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from edge_se_sampler.bench import runner as experiment
from edge_se_sampler.bench.stability import scenes as scene
from edge_se_sampler.bench.stability import train as train_module
from edge_se_sampler.bench.stability.scenes import COLORS, SHIFT, background_of, views
from edge_se_sampler.bench.stability.settings import AXES, BASE, PAIRS, STRATEGIES, Cell, Point, cells, points
from edge_se_sampler.bench.stability.summary import table, totals
from edge_se_sampler.bench.stability.train import Measured, Scale, ending, measured, portrait, run_cell, trainer_of
from edge_se_sampler.engine.reinitialization import dead_networks
from edge_se_sampler.models.nerf import NeRFModel
from edge_se_sampler.sampling.edges import edge_strength

SMALL = Scale(iterations=4, rays=8, width=8, samples=4)


@pytest.fixture(autouse=True)
def few_pixels(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(scene, "SIZE", 24)
    monkeypatch.setattr(scene, "SHIFT", (5, 3))
    scene.views.cache_clear()
    scene._focal.cache_clear()
    yield
    scene.views.cache_clear()
    scene._focal.cache_clear()


# -- the map


def test_every_point_of_the_map_is_another() -> None:
    every = points()
    assert every[0] == BASE
    assert len({*every}) == len(every) == 1 + sum(map(len, AXES.values())) + len(PAIRS)
    assert len({point.label for point in every}) == len(every)
    for axis, values in AXES.items():
        assert getattr(BASE, axis) not in values
    assert [len(point.changes) for point in every[1 : -len(PAIRS)]] == [1] * sum(map(len, AXES.values()))


def test_every_strategy_meets_the_same_seeds() -> None:
    every = cells((), (), (0, 1))
    assert len(every) == len({*every}) == len(points()) * len(STRATEGIES) * 2
    assert [cell.seed for cell in every] == sorted(cell.seed for cell in every)


# -- the object


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_the_object_covers_what_it_is_asked_to(share: float) -> None:
    train, test = views(share, False, 12)
    assert len(train.images) == 12
    assert len(test.images) == scene.TEST_VIEWS
    assert np.mean([image[..., 3] > 0 for image in train.images]) == pytest.approx(share, rel=0.1)


def test_off_centre_is_the_same_picture_elsewhere() -> None:
    centred, shifted = views(0.05, False, 3)[0], views(0.05, True, 3)[0]
    dx, dy = scene.SHIFT
    for here, there in zip(centred.images, shifted.images, strict=True):
        np.testing.assert_array_equal(there, np.roll(here, (dy, dx), axis=(0, 1)))
    assert (shifted.cameras.cx - centred.cameras.cx).unique().tolist() == [dx]
    assert (shifted.cameras.cy - centred.cameras.cy).unique().tolist() == [dy]
    assert SHIFT != (0, 0)


def test_what_lies_behind() -> None:
    rays = train_module.pictures_of(views(0.05, False, 3)[1])[0].rays(torch.device("cpu"))
    green, texture = background_of("green"), background_of("textured")
    assert background_of("random") is None
    assert green is not None
    assert texture is not None
    torch.testing.assert_close(green(rays), torch.tensor(scene.COLORS["green"]).expand(len(rays), 3))
    colors = texture(rays).reshape(24, 24, 3)
    assert colors.min() >= 0
    assert colors.max() <= 1
    assert (colors[:, 4:] - colors[:, :-4]).abs().mean() > 0.1  # changes within a few pixels


# -- how a training ended


def seen(share: float, gain: float = 5.0, accumulation: float = 0.0) -> Measured:
    return Measured(share=share, psnr=20 + gain, background_psnr=20, accumulation=accumulation)


@pytest.mark.parametrize(
    ("shown", "dead", "expected"),
    [
        (seen(0.2), False, "learnt"),
        (seen(0.2), True, "learnt"),  # begun anew
        (seen(0.5, 0.4), False, "slow"),
        (seen(0.89, -3), False, "slow"),
        (seen(1.0, 0), True, "dead at the start"),
        (seen(1.0, 0), False, "killed by the data"),
        (seen(1.0, 0, accumulation=1.0), False, "opaque background"),
        (seen(0.95, 0.6), False, "killed by the data"),
    ],
)
def test_endings(shown: Measured, dead: bool, expected: str) -> None:
    assert ending(shown, dead) == expected


def built(state: str, tmp_path: Path) -> tuple[NeRFModel, Any]:
    """A model that is in a state, and views of the object."""
    trainer, pictures = trainer_of(BASE, "vanilla-nerf", 0, SMALL, tmp_path)
    model = trainer.pipeline.model
    raw = {"empty": -1.0, "opaque white": 50.0}[state]
    with torch.no_grad():
        for field in (model.coarse, model.fine):
            field.density.weight.zero_()
            field.density.bias.fill_(raw)
            field.color.weight.zero_()
            field.color.bias.fill_(20.0)  # white
    return model, pictures


def test_an_empty_network_is_told_dead_or_killed_by_how_it_began(tmp_path: Path) -> None:
    model, pictures = built("empty", tmp_path)
    dead = dead_networks(model, [picture.rays(model.device) for picture in pictures])
    assert dead == ["coarse", "fine"]
    for level in ("coarse", "fine"):
        shown = measured(model, pictures)[level]
        assert shown.share == pytest.approx(1)
        assert shown.psnr == pytest.approx(shown.background_psnr)
        assert shown.accumulation == 0
        assert ending(shown, level in dead) == "dead at the start"
        assert ending(shown, False) == "killed by the data"


def test_an_opaque_white_network_is_no_living_one(tmp_path: Path) -> None:
    """Its accumulation is that of an object everywhere, its gradient is alive: opacity tells nothing."""
    model, pictures = built("opaque white", tmp_path)
    assert dead_networks(model, [picture.rays(model.device) for picture in pictures]) == []
    shown = measured(model, pictures)["fine"]
    assert shown.accumulation > 0.99
    assert ending(shown, False) == "opaque background"


def test_a_perfect_network_has_learnt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer, pictures = trainer_of(BASE, "vanilla-nerf", 0, SMALL, tmp_path)
    model = trainer.pipeline.model
    monkeypatch.setattr(model, "squared_error", lambda outputs, image, level: torch.full((len(image),), 1e-4))
    shown = measured(model, pictures)["coarse"]
    assert shown.share < 0.01
    assert shown.psnr == pytest.approx(-10 * np.log10(1e-4 / 3))
    assert ending(shown, False) == "learnt"


# -- a training


@pytest.mark.parametrize(
    "point",
    [BASE, Point(placement="shifted", views=10), Point(background="textured"), Point(background="random", noise=1.0)],
)
def test_a_point_is_trained_as_it_says(point: Point, tmp_path: Path) -> None:
    trainer, pictures = trainer_of(point, "auto", 3, SMALL, tmp_path)
    assert len(trainer.pipeline.datamanager.image_batch["image"]) == point.views
    assert trainer.pipeline.model.config.density_noise == point.noise
    assert trainer.pipeline.datamanager.train_pixel_sampler.watch is not None
    assert trainer.dead_network_reset is not None
    outputs = trainer.pipeline.model(pictures[0].rays(torch.device("cpu"))[:5])
    expected = background_of(point.background)
    if expected is not None:
        torch.testing.assert_close(outputs["background"], expected(pictures[0].rays(torch.device("cpu"))[:5]))
    assert np.isfinite(trainer.train_iteration(0))


@pytest.mark.parametrize("background", ["white", "black", "grey", "green"])
def test_edges_are_taken_in_front_of_the_points_background(background: Any, tmp_path: Path) -> None:
    trainer, _ = trainer_of(Point(background=background), "edge-nerf", 3, SMALL, tmp_path)
    manager = trainer.pipeline.datamanager
    image = manager.image_batch["image"][0].numpy()
    edges = edge_strength(image, background=COLORS[background]) + np.float32(0.01)
    tables = manager.train_pixel_sampler._tables["edge"]
    drawn = tables.table.probability(tables.place[0]).numpy()
    np.testing.assert_allclose(drawn, edges / edges.sum(), rtol=1e-3, atol=1e-9)


def test_a_run_tells_where_it_stands_and_how_it_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    number = next(n for n, point in enumerate(points()) if point.label == "torch weights")
    first, again = (run_cell(Cell(number, "vanilla-nerf", 5), SMALL, tmp_path / "views") for _ in range(2))
    assert (first["point"], first["strategy"], first["seed"]) == (number, "vanilla-nerf", 5)
    assert first["initialization"] == "torch"
    assert first["outcome"] == first["fine_ending"] != "learnt"  # after four steps
    assert len(first["shares"]) == 4
    (view,) = (tmp_path / "views").iterdir()
    assert view.name == f"{Cell(number, 'vanilla-nerf', 5).name}.png"
    assert iio.imread(view).shape == (24, 3 * 24, 3)
    for run in (first, again):
        del run["cpu_seconds"]
    assert first == again
    assert json.loads(json.dumps(first)) == first


@pytest.mark.parametrize(("density", "opaque"), [(-10.0, 0.0), (10.0, 1.0)])
def test_a_portrait_shows_the_truth_the_rendering_and_the_opacity(
    tmp_path: Path, density: float, opaque: float
) -> None:
    trainer, pictures = trainer_of(Point(background="green"), "vanilla-nerf", 1, SMALL, tmp_path)
    model = trainer.pipeline.model
    with torch.no_grad():
        for field in (model.coarse, model.fine):
            field.density.weight.zero_()
            field.density.bias.fill_(density)
    truth, rendering, opacity = np.split(portrait(model, pictures[0]), 3, axis=1)
    alpha = pictures[0].image[..., 3:].astype(np.float32) / (255 if pictures[0].image.dtype == np.uint8 else 1)
    green = np.array([0.1, 0.75, 0.2])
    assert (alpha > 0).any()
    np.testing.assert_allclose(truth[alpha[..., 0] == 0], np.broadcast_to(green, ((alpha == 0).sum(), 3)), atol=1e-6)
    assert np.abs(truth - green)[alpha[..., 0] == 1].max() > 0.2
    np.testing.assert_allclose(opacity, np.full_like(opacity, opaque), atol=1e-6)
    assert np.allclose(rendering, green, atol=1e-6) == (not opaque)


# -- what the map shows


def test_the_table_counts_failures_and_how_they_ended() -> None:
    def run(strategy: str, seed: int, how: str) -> dict[str, Any]:
        return {
            "point": 0, "strategy": strategy, "seed": seed, "outcome": how, "fine_ending": how,
            "coarse_ending": "learnt", "revived": 1,
        }  # fmt: skip

    endings = ["killed by the data"] * 2 + ["opaque background"] + ["learnt"] * 7
    runs = [run("vanilla-nerf", seed, how) for seed, how in enumerate(endings)] + [run("auto", 0, "learnt")]
    random, auto = totals(runs)
    assert (random["failures"], random["runs"], random["revived"]) == (3, 10, 10)
    assert random["interval"] == [0.1078, 0.6032]
    assert auto["failures"] == 0
    assert "| base | **3/10** [11–60 %] (2 killed, 1 opaque) | **0/1** [0–79 %] |" in table(runs)


def test_the_command_draws_a_small_map(tmp_path: Path, edge_se: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train_module, "Scale", lambda: SMALL)
    monkeypatch.setattr(experiment, "executor_of", lambda *_: lambda: ThreadPoolExecutor(1))
    out = tmp_path / "new" / "out"
    flags = ["--points", 0, 5, "--strategies", "vanilla-nerf", "auto", "--seeds", 0, "--workers", 1]
    answer = edge_se("bench", "stability", "--output-dir", out, "--workplace", tmp_path / "w", *flags)
    assert answer.code == 0, answer
    assert {path.name for path in out.iterdir()} == {
        "result.json", "table.md", "map.png", "survival.png", "sheet.png",
    }  # fmt: skip
    result = json.loads((out / "result.json").read_text())
    assert [(run["point"], run["strategy"]) for run in result["runs"]] == [
        (0, "auto"), (0, "vanilla-nerf"), (5, "auto"), (5, "vanilla-nerf"),
    ]  # fmt: skip
    assert len(result["totals"]) == 4


def test_a_dry_run_tells_the_points(tmp_path: Path, edge_se: Any) -> None:
    answer = edge_se("bench", "stability", "--output-dir", tmp_path / "o", "--dry-run")
    lines = answer.out.splitlines()
    assert lines[0] == "point  0: base"
    assert len(lines) == len(points()) + 1
    every = 10 * len(STRATEGIES) * len(points())
    assert lines[-1] == f"{every} trainings of 300 steps, {every} still to do"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("flags", "named"),
    [(("--points", "99"), "--points: 99"), (("--strategies", "se"), "--strategies: 'se'"), (("--workers", "0"), "one")],
)
def test_bad_choices_are_refused(flags: tuple[str, ...], named: str, tmp_path: Path, edge_se: Any) -> None:
    answer = edge_se("bench", "stability", "--output-dir", tmp_path / "out", *flags)
    assert answer.code == 2
    assert named in answer.err
    assert answer.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
