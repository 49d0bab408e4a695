"""Trainings on real scenes: what is measured of one, and the page of a result."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from capture_folder import HEIGHT, WIDTH, write_colmap

from edge_se_sampler.bench.baselines.run import read_baselines
from edge_se_sampler.bench.real import trials
from edge_se_sampler.bench.real.command import BenchReal
from edge_se_sampler.bench.real.figures import draw_chart
from edge_se_sampler.bench.real.published import PUBLISHED
from edge_se_sampler.bench.real.report import describe, draw
from edge_se_sampler.bench.real.summary import seconds_of
from edge_se_sampler.bench.real.trials import MEMBERS, VARIANTS, Settings, Trial, run_trial, training_length
from edge_se_sampler.bench.results import new_result, write_result
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.errors import InputError

RUN = {
    "size": [400, 400], "psnr": 30.0, "ssim": 0.95, "val_psnr": 31.0, "train_psnr": 33.0, "steps": 1000,
    "seconds": 60.1, "cpu_seconds": 110.0, "level": 2, "rows": 5_000_000, "memory": 1.9, "seconds_per_view": 0.1,
}  # fmt: skip


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    make_scenes(folder, ("bricks",), size=24, num_train=6, num_val=1, num_test=2)
    return folder


@pytest.mark.slow
def test_a_training_is_measured_on_every_split(scenes: Path, tmp_path: Path) -> None:
    run = run_trial(Trial("bricks", 1, "2s", "lean-nerf", 0), scenes, tmp_path, Settings(num_train_views=2))
    assert run.keys() == RUN.keys()
    assert run["seconds"] == pytest.approx(2, abs=1)
    assert run["size"] == [24, 24]
    assert 12 < run["psnr"] < 40
    assert len({run[name] for name in ("psnr", "val_psnr", "train_psnr")}) == 3  # other views each
    assert 0.2 < run["memory"] < 4


def test_a_training_that_was_stopped_is_none(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(trainer: Trainer) -> None:
        trainer.stop_requested = True  # as by a SIGTERM

    monkeypatch.setattr(Trainer, "train", stop)
    with pytest.raises(KeyboardInterrupt):
        trials._train(Trial("bricks", 1, "2s", "lean-nerf", 0), 0, scenes, tmp_path)


@pytest.mark.slow
def test_a_capture_has_no_validation_views_of_its_own(tmp_path: Path) -> None:
    write_colmap(tmp_path / "scenes" / "mug")
    run = run_trial(Trial("mug", 2, "2s", "lean-nerf", 0), tmp_path / "scenes", tmp_path, Settings(num_train_views=1))
    assert run["size"] == [WIDTH // 2, HEIGHT // 2]
    assert run["val_psnr"] is None
    assert 5 < run["psnr"] != run["train_psnr"]


def result_of(folder: Path, runs: list[dict[str, Any]], *baselines: dict[str, Any]) -> Path:
    result = new_result("real", {"num_train_views": 5}) | {"errors": [], "runs": runs}
    result["machine"]["threads"] = 2
    write_result(folder / "result.json", json.loads(json.dumps(result)))
    for i, baseline in enumerate(baselines):
        (folder / "baselines").mkdir(exist_ok=True)
        write_result(folder / "baselines" / f"{i}.json", baseline)
    return folder


def run_of(
    psnr: float, seed: int, scene: str = "lego", budget: str = "1m", variant: str = "lean-nerf", **more: Any
) -> dict[str, Any]:
    key = {"scene": scene, "downscale": 2, "budget": budget, "variant": variant, "seed": seed}
    return {**key, **RUN, "psnr": psnr, **more}


def baseline_of(
    curves: dict[str, list[list[float]]], label: str = "", program: str = "other", image_size: int = 400
) -> dict[str, Any]:
    """A result of another program: scene -> curve of a seed."""
    settings = {"seconds": 600, "threads": 2, "image_size": image_size, "program": program, "label": label,
                "program_version": "1", "flags": ""}  # fmt: skip
    runs = [{"scene": scene, "seed": 0, "steps": 9, "curve": curve} for scene, curve in curves.items()]
    return new_result("baselines", settings) | {"errors": [], "runs": runs}


def test_the_page_has_medians_and_differences_on_the_same_seeds(tmp_path: Path) -> None:
    runs = [run_of(psnr, seed) for seed, psnr in enumerate((30.0, 32.0, 31.5))]
    runs += [run_of(33.0, 0, budget="3m"), run_of(35.0, 0, scene="chair"), run_of(29.5, 0, variant="no hull")]
    page = describe(result_of(tmp_path, runs))
    assert "| lego, 400 px | 31.50 (30.00 to 32.00) | 33.00 |" in page
    assert "| chair, 400 px | 35.00 | – |" in page
    assert "| lego, 400 px | 1m | no hull | 29.50 | -0.50 | 1 | 1.00 |" in page


def test_uniform_pixels_have_rows_and_a_line_of_their_own(tmp_path: Path) -> None:
    runs = [run_of(30.0, 0), run_of(31.0, 0, scene="chair")]
    runs += [run_of(29.0, seed, budget=budget, variant="uniform pixels") for seed, budget in ((0, "1m"), (0, "60m"))]
    folder = result_of(tmp_path, runs)
    page = describe(folder)
    assert "| lego, 400 px | 30.00 | – |\n| lego, 400 px, uniform pixels | 29.00 | 29.00 |" in page
    assert "| lego, 400 px, uniform pixels | 60m | 29.00 | 0.95 |" in page
    assert "| lego, 400 px | 1m | uniform pixels | 29.00 | -1.00 | 1 | 1.00 |" in page
    lines = {line.get_label(): line for line in draw_chart(runs, {}).axes[1].lines}
    assert lines["lean-nerf, uniform pixels"].get_xydata().tolist() == [[60, 29], [3600, 29]]


def test_budgets_of_steps_are_told_where_one_thing_is_changed_and_nowhere_else(tmp_path: Path) -> None:
    runs = [run_of(30.0, 0), run_of(29.0, 0, budget="2000 steps"), run_of(25.0, 0, budget="500 steps")]
    runs += [
        run_of(28.0, 0, budget="2000 steps", variant="no hull", cpu_seconds=55.0),
        run_of(25.1, 0, budget="500 steps", variant="no hull"),
    ]
    folder = result_of(tmp_path, runs)
    page = describe(folder)
    changed = page.split("## One thing changed")[1]
    assert [seconds_of(budget) for budget in ("90", "90s", " 10m ", "1h")] == [90, 90, 600, 3600]
    assert "| lego, 400 px | 500 steps | no hull | 25.10 | +0.10 | 1 | 1.00 |" in changed
    assert "| lego, 400 px | 2000 steps | no hull | 28.00 | -1.00 | 1 | 0.50 |" in changed
    assert changed.index("500 steps") < changed.index("2000 steps")
    assert "steps |" not in page.split("## One thing changed")[0].replace("| steps |", "")
    draw(folder, None)
    assert (folder / "chart.png").exists()


@pytest.mark.parametrize("budget", ["many steps", "1.5 steps", "0 steps", " steps", "soon"])
def test_a_budget_is_a_time_or_a_number_of_steps(budget: str, scenes: Path, tmp_path: Path) -> None:
    command = BenchReal(output_dir=tmp_path, scenes_dir=scenes, scenes=("bricks",), budgets=("1m", budget))
    with pytest.raises(InputError, match=r"steps|time-budget"):
        command.experiment()


@pytest.mark.slow
def test_a_training_has_as_many_steps_as_its_budget(scenes: Path, tmp_path: Path) -> None:
    run = run_trial(Trial("bricks", 1, "3 steps", "lean-nerf", 0), scenes, tmp_path, Settings(num_train_views=2))
    assert run["steps"] == 3


@pytest.mark.parametrize(("at_once", "threads"), [(1, 4), (2, 2), (9, 1)])
def test_trainings_at_once_share_the_cores(
    at_once: int, threads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Seen(Exception):
        """Ends the training as it begins."""

    def train(*_: Any) -> None:
        raise Seen(torch.get_num_threads())

    monkeypatch.setattr(trials, "_train", train)
    monkeypatch.setattr(trials, "run_in_subprocess", lambda function, *arguments: function(*arguments))
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(4)
        with pytest.raises(Seen, match=f"^{threads}$"):
            trials.run_trial(Trial("bricks", 1, "1 steps", "lean-nerf", 0), tmp_path, tmp_path, Settings(), at_once)
    finally:
        torch.set_num_threads(before)


@pytest.mark.slow
def test_several_trainings_share_a_budget_and_their_mean_is_measured(scenes: Path, tmp_path: Path) -> None:
    def train(steps: int, variant: str, seed: int) -> dict[str, Any]:
        trial = Trial("bricks", 1, f"{steps} steps", variant, seed)
        return run_trial(trial, scenes, tmp_path, Settings(num_train_views=2))

    mean, *alone = train(60, "mean of three trainings", 5), *(train(20, "lean-nerf", seed) for seed in (5, 1005, 2005))
    assert mean["steps"] == 60
    assert mean["rows"] == sum(run["rows"] for run in alone)
    assert mean["psnr"] > sum(run["psnr"] for run in alone) / 3
    assert training_length("2m", 3) == {"time_budget": "40"}


def test_sizes_are_the_images(tmp_path: Path) -> None:
    old = {key: value for key, value in run_of(31.0, 0, downscale=1).items() if key != "size"}  # NeRF's 800 pixels
    fox = run_of(22.0, 0, scene="fox", downscale=4, size=[270, 480], val_psnr=None)
    page = describe(result_of(tmp_path, [fox, old, run_of(30.0, 0)]))
    table = page.split("\n\n")[3]
    assert [line.split(" | ")[0] for line in table.splitlines()[2:]] == [
        "| lego, 400 px",
        "| lego, 800 px",
        "| fox, 270 x 480 px",
    ]
    assert "| fox, 270 x 480 px | 1m | 22.00 | 0.95 | – | 33.00 |" in page


LEGO = {"lego": [[60.4, 20.0], [180.2, 24.0], [600.3, 26.0]]}


def test_other_programs_stand_beside_ours_at_equal_seconds(tmp_path: Path) -> None:
    """The best of a program's trainings counts that were looked at then, on images of that size."""
    runs = [run_of(psnr, 0, budget=budget) for psnr, budget in ((30.0, "1m"), (32.0, "3m"), (33.0, "10m"))]
    runs += [run_of(31.0, 0, budget="3m", variant="no hull"), run_of(29.0, 0, "chair")]
    runs += [run_of(21.0, 0, "fox", budget, size=[270, 480], val_psnr=None) for budget in ("1m", "5m")]
    short = baseline_of({"lego": [[60.1, 19.0], [180.3, 25.0]]}, "180 s")
    fox = baseline_of({"fox": [[300.0, 18.0], [600.0, 19.0]]}, "captures", image_size=480)
    large = baseline_of({"lego": [[600.0, 99.0]]}, "large", image_size=800)
    page = describe(result_of(tmp_path, runs, baseline_of(LEGO, "600 s"), short, fox, large))
    assert "|  | program | 1m | 3m | 5m | 10m |" in page
    assert "| lego, 400 px | lean-nerf | 30.00 | 32.00 | – | 33.00 |" in page
    assert "| lego, 400 px | lean-nerf, no hull | – | 31.00 | – | – |" in page
    assert "| lego, 400 px | other (1) | 20.00 | 25.00 | – | 26.00 |" in page
    assert "| fox, 270 x 480 px | other (1) | – | – | 18.00 | 19.00 |" in page  # nobody looked after 60 s
    assert "chair, 400 px | lean-nerf |" not in page  # nobody else was there


def test_programs_on_other_threads_are_refused(tmp_path: Path) -> None:
    other = baseline_of(LEGO)
    other["settings"]["threads"] = 1
    with pytest.raises(InputError, match="threads is 1"):
        describe(result_of(tmp_path, [run_of(30.0, 0)], other))


def test_the_chart_has_a_panel_for_every_scene_and_size(tmp_path: Path) -> None:
    runs = [run_of(psnr, seed, budget=budget) for seed, budget, psnr in
            ((0, "3m", 32.0), (0, "1m", 30.0), (1, "1m", 31.0), (2, "1m", 33.0))]  # fmt: skip
    runs += [run_of(28.0, 0, variant="no hull"), run_of(20.0, 0, variant="half the memory")]
    runs += [run_of(29.0, 0, downscale=1, size=[800, 800])]
    folder = result_of(tmp_path, runs, baseline_of(LEGO))
    figure = draw_chart(runs, read_baselines(folder))
    small, large = figure.axes
    assert (small.get_title(), large.get_title()) == ("lego, 400 px", "lego, 800 px")
    lines = {line.get_label(): line for line in small.lines}
    assert [*lines] == ["lean-nerf", "lean-nerf, no hull", "other (1)"]
    assert lines["lean-nerf"].get_xydata().tolist() == [[60, 31], [180, 32]]
    assert [line.get_linestyle() for line in lines.values()] == ["-", "--", ":"]
    assert lines["other (1)"].get_xydata().tolist() == LEGO["lego"]
    band = small.collections[0].get_paths()[0].vertices
    assert {tuple(vertex) for vertex in band} >= {(60, 30), (60, 33), (180, 32)}
    published = {line.get_label(): line.get_xydata().tolist() for line in large.lines[1:]}
    assert len(published) == len(PUBLISHED)
    assert [[900.0, 34.64]] in published.values()
    draw(folder, None)
    assert (folder / "chart.png").stat().st_size > 10_000


@pytest.mark.parametrize("trained", [[], [run_of(30.0, 0)]])
def test_a_variant_without_what_it_is_compared_with_is_not_drawn(trained: list[dict[str, Any]], tmp_path: Path) -> None:
    folder = result_of(tmp_path, [*trained, run_of(29.0, 0, scene="chair", variant="no total variation")])
    draw(folder, None)
    assert (folder / "chart.png").exists() == bool(trained)


def test_without_variants_there_is_no_section_of_them(tmp_path: Path) -> None:
    assert "One thing changed" not in describe(result_of(tmp_path, [run_of(30.0, 0)]))


def test_every_variant_changes_what_there_is() -> None:
    from edge_se_sampler.engine.config import override
    from edge_se_sampler.methods import method_configs

    config = method_configs()["lean-nerf"]
    for label, changes in VARIANTS.items():
        assert (override(config, changes) != config) == (label != "lean-nerf" and label not in MEMBERS), label


def test_missing_scenes_are_refused(scenes: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no folder lego"):
        BenchReal(output_dir=tmp_path, scenes_dir=scenes).experiment()
