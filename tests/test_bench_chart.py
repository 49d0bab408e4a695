"""The chart: what a variant trains, how a training is planned and timed, and what the runs' numbers mean."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_se_sampler.bench.chart import trials as trials_module
from edge_se_sampler.bench.chart.command import BenchChart
from edge_se_sampler.bench.chart.figures import draw_chart, draw_scenes
from edge_se_sampler.bench.chart.report import describe, draw, tables
from edge_se_sampler.bench.chart.summary import by_variant, comparable, mean_psnr_at, psnr_at, runs_on
from edge_se_sampler.bench.chart.trials import ChartSettings, Trial, config_of, iterations_within, train_and_evaluate
from edge_se_sampler.bench.chart.variants import VARIANTS
from edge_se_sampler.bench.results import write_result
from edge_se_sampler.bench.runner import run_in_subprocess
from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.session import resolve_config
from edge_se_sampler.methods import method_configs


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scenes(tmp_path_factory.mktemp("chart"), ["mic"], size=24, num_train=4, num_val=1, num_test=1)[0]


# -- variants


@pytest.mark.parametrize("name", VARIANTS)
def test_a_variant_is_its_method_with_its_changes(name: str, data: Path, tmp_path: Path) -> None:
    variant = VARIANTS[name]
    config = config_of(Trial(name, "mic", 5), data, tmp_path)
    method = method_configs()[variant.method]
    assert config.machine.seed == 5
    for path, value in variant.changes.items():
        changed, default = config, method
        for part in path.split("."):
            changed, default = getattr(changed, part), getattr(default, part)
        assert changed == value
        assert default != value  # it is a change
    if not variant.changes:
        assert config.pipeline == method.pipeline
    resolve_config(config, read_blender(data, "train"))


def test_trainings_that_are_compared_are_neighbors(tmp_path: Path) -> None:
    chart = BenchChart(output_dir=tmp_path, variants=("lean", "edge"), scenes=("mic", "chair"), seeds=(0, 1))
    trials = chart.experiment().trials([])
    assert trials[:3] == [Trial("lean", "mic", 0), Trial("edge", "mic", 0), Trial("lean", "chair", 0)]
    assert len(BenchChart(output_dir=tmp_path, seeds=(0,)).experiment().trials([])) == len(VARIANTS)


# -- a training


@pytest.mark.slow
def test_a_training_fills_its_time_and_is_evaluated_on_the_way(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trials_module, "EVAL_SECONDS", (0.2, 0.4, 1.0, 1.5))
    run = train_and_evaluate(Trial("edge", "mic", 1), ChartSettings(seconds=4), data)
    curve = np.array(run["curve"])
    assert (np.diff(curve[:, :3], axis=0) > 0).all()  # seconds, steps, queries
    assert len(curve) >= 2
    assert curve[-1].tolist() == [run["seconds"], run["steps"], run["queries"], round(run["psnr"], 3)]
    assert run["steps"] <= run["planned_steps"]
    assert 0 < run["ready_seconds"] < run["curve"][0][0]
    assert json.loads(json.dumps(run)) == run


@pytest.mark.slow
@pytest.mark.usefixtures("ticks")
def test_lean_nerf_is_trained_anew_for_every_budget(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trials_module, "BUDGETS", (0.7, 1, 3))
    run = train_and_evaluate(Trial("lean", "mic", 1), ChartSettings(seconds=2.5), data)
    assert [seconds for seconds, *_ in run["curve"]] == [pytest.approx(s, rel=0.05) for s in (0.7, 1, 2.5)]
    assert run["steps"] == run["planned_steps"] == run["curve"][-1][1]
    assert run["psnr"] == pytest.approx(run["curve"][-1][-1], abs=1e-3)


@pytest.mark.slow
def test_peak_memory_is_the_trainings_alone(data: Path) -> None:
    run = run_in_subprocess(train_and_evaluate, Trial("lean", "mic", 1), ChartSettings(seconds=1), data)
    assert run["peak_bytes"] > 2**22


@pytest.fixture
def ticks(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that every look at it moves on by 10 ms: a step takes 10 ms. "edge" has few rays a step."""
    count = itertools.count()
    few = {"pipeline.datamanager.train_num_rays_per_batch": 4}
    monkeypatch.setitem(VARIANTS, "edge", replace(VARIANTS["edge"], changes=few))
    monkeypatch.setattr(ChartSettings, "clock", lambda _: 0.01 * next(count))


@pytest.mark.slow
@pytest.mark.parametrize("guess", [10, 100_000])
@pytest.mark.usefixtures("ticks")
def test_a_plan_that_misses_its_time_is_made_again(guess: int, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trials_module, "iterations_within", lambda config, settings: guess)
    run = train_and_evaluate(Trial("edge", "mic", 1), ChartSettings(seconds=1.5), data)
    assert run["planned_steps"] == pytest.approx(149, abs=2)
    assert run["steps"] == run["planned_steps"]
    assert run["seconds"] == pytest.approx(1.5, abs=0.02)


@pytest.mark.usefixtures("ticks")
def test_a_plan_has_as_many_iterations_as_fit(data: Path, tmp_path: Path) -> None:
    config = config_of(Trial("edge", "mic", 0), data, tmp_path)
    assert [iterations_within(config, ChartSettings(seconds)) for seconds in (2, 4)] == [199, 399]


# -- what the runs say


def run_of(variant: str, scene: str, seed: int, curve: list[tuple[float, float]], outcome: str = "converged") -> Any:
    rows = [[seconds, 10 * seconds, 1000 * seconds, psnr] for seconds, psnr in curve]
    return {
        "variant": variant, "scene": scene, "seed": seed, "outcome": outcome, "curve": rows, "psnr": curve[-1][1],
        "seconds": curve[-1][0], "steps": 10 * curve[-1][0], "queries": 1000 * curve[-1][0], "ready_seconds": 0.0,
        "peak_bytes": 2**20,
    }  # fmt: skip


def baseline(runs: list[tuple[str, int, list[list[float]]]], label: str = "") -> Any:
    settings = {"seconds": 60, "threads": 1, "image_size": 100, "program": "other", "label": label,
                "program_version": "1", "flags": "--fast"}  # fmt: skip
    found = [{"scene": scene, "seed": seed, "curve": curve} for scene, seed, curve in runs]
    head = {"version": 2, "experiment": "baselines", "command": "", "settings": settings, "machine": {}, "errors": []}
    return {**head, "runs": found}


def folder_of(tmp_path: Path, runs: list[Any], *baselines: Any) -> Path:
    """A chart's folder with these results."""
    machine = {"python": "3", "torch": "2", "numpy": "1", "processor": "any", "cores": 2, "threads": 1}
    settings = {"seconds": 60, "threads": 1, "image_size": 100}
    head = {"version": 2, "experiment": "chart", "command": "", "settings": settings, "machine": machine, "errors": []}
    write_result(tmp_path / "result.json", {**head, "runs": runs})
    (tmp_path / "baselines").mkdir()
    for i, result in enumerate(baselines):
        write_result(tmp_path / "baselines" / f"{i}.json", result)
    return tmp_path


def test_between_evaluations_psnr_is_linear_in_the_logarithm_of_time() -> None:
    curve = [[1, 0, 0, 20.0], [4, 0, 0, 24.0]]
    assert psnr_at(curve, 2) == pytest.approx(22)
    assert psnr_at(curve, 0.5) is None
    assert psnr_at(curve, 9) == 24.0


def test_medians_over_seeds_then_means_over_scenes() -> None:
    runs = [run_of("lean", "mic", s, [(1, p), (3, p + 1)]) for s, p in enumerate((20, 30, 22))]
    runs += [run_of("lean", "chair", 0, [(2, 10), (3, 12)])]
    assert mean_psnr_at(runs, 3) == pytest.approx((23 + 12) / 2)
    assert mean_psnr_at(runs, 1) is None  # one scene has not been evaluated yet


def test_only_common_scenes_and_seeds_are_compared() -> None:
    runs = [run_of("lean", scene, 0, [(1, 20)]) for scene in ("mic", "chair")] + [run_of("edge", "mic", 0, [(1, 9)])]
    assert {run["scene"] for found in comparable(by_variant(runs)).values() for run in found} == {"mic"}
    runs += [run_of("lean", "mic", 1, [(1, 20)]), run_of("no-alpha-loss", "chair", 0, [(1, 20)])]
    methods = comparable(by_variant(runs, ["methods"]))
    assert {name: [run["seed"] for run in found] for name, found in methods.items()} == {"lean": [0], "edge": [0]}
    assert {run["scene"] for run in comparable(by_variant(runs, ["parts"]))["lean"]} == {"chair"}
    assert comparable(by_variant(runs)) == comparable({}) == {}  # nothing in common, or nothing at all


def test_only_runs_on_all_scenes_are_compared() -> None:
    runs = [{"scene": "mic", "seed": 0}, {"scene": "chair", "seed": 1}, {"scene": "ship", "seed": 0}]
    assert runs_on(runs[:1], ["mic", "chair"]) == []
    assert runs_on(runs, ["mic", "chair"]) == runs[:2]


# -- the report


def row_of(text: str, label: str) -> list[str]:
    """The fields of a table's row."""
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {label} |")]
    return line.removesuffix(" |").split(" | ")[1:]


def test_the_table_of_methods_counts_failures_and_has_baselines(tmp_path: Path) -> None:
    outcomes = ("converged", "collapsed", "underfit")
    runs = [run_of("random", "mic", s, [(1, 15), (7.5, 16)], outcome) for s, outcome in enumerate(outcomes)]
    table = tables(folder_of(tmp_path, runs, baseline([("mic", 0, [[1, 20.0], [2, 21.0]])])))["methods"]
    assert row_of(table, "Random")[-2:] == ["16.00", "2 of 3"]
    assert row_of(table, "other (1)") == ["21.00", "21.00", "21.00", "–"]
    assert "| lean-nerf" not in table  # not trained


def test_every_scene_has_its_column_and_failures_are_bracketed(tmp_path: Path) -> None:
    runs = [run_of("lean", scene, 0, [(1, 20 + k)]) for k, scene in enumerate(("chair", "mic", "ship"))]
    runs += [run_of("edge", "chair", 0, [(1, 10)], "collapsed"), run_of("edge", "mic", 0, [(1, 11)])]
    runs += [run_of("se", "mic", 0, [(1, 30)])]  # of a single scene
    both = baseline([(scene, 0, [[1, 5.0], [60, psnr]]) for scene, psnr in (("mic", 24), ("chair", 23), ("ship", 1))])
    text = describe(folder_of(tmp_path, runs, both)).split("## Every scene")[1]
    assert row_of(text, "") == ["chair", "mic", "ship", "mean", "least", "failed"]
    assert row_of(text, "lean-nerf") == ["20.00", "21.00", "22.00", "21.00", "20.00", "0 of 3"]
    assert row_of(text, "Edge") == ["(10.00)", "11.00", "–", "–", "10.00", "1 of 2"]
    assert row_of(text, "other (1)") == ["23.00", "24.00", "1.00", "16.00", "1.00", "–"]
    assert "| SE |" not in text


def test_a_single_variant_has_a_page_of_its_own(tmp_path: Path) -> None:
    runs = [run_of("lean", scene, seed, [(1, 20), (9, 30)]) for scene in ("chair", "mic") for seed in range(3)]
    text = describe(folder_of(tmp_path, runs))
    assert text.startswith("# 3 seeds of lean-nerf\n")
    assert row_of(text.split("## Every scene")[0], "lean-nerf")[:4] == ["25.00", "28.86", "30.00", "0 of 6"]
    assert "## Methods" not in text


def test_pictures_are_drawn_where_there_is_something_to_compare(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, [run_of("no-hull", "mic", 0, [(1, 20)])])
    draw(folder, None)
    assert [path.name for path in folder.glob("*.png")] == ["scenes.png"]
    assert "scenes.png" in describe(folder)
    assert "chart.png" not in describe(folder)


def test_curves_of_a_single_evaluation_are_drawn() -> None:
    runs = [run_of(name, "mic", s, [(1 + s, 20 + s)]) for name in ("lean", "edge") for s in (1, 2)]
    figure = draw_chart(runs, {}, ChartSettings(seconds=2))
    drawn = [line for line in figure.axes[0].lines if "lean" in str(line.get_label())]
    np.testing.assert_array_equal(drawn[0].get_xydata(), [[3, 21.5]])
    labels = [text.get_text() for text in draw_scenes(runs, {}, ChartSettings(seconds=2)).legends[0].get_texts()]
    assert sorted(labels) == ["Edge", "lean-nerf"]  # once each, whatever the seeds
    parts = [run_of("no-hull", "mic", 0, [(1, 20)], "collapsed"), run_of("no-alpha-loss", "chair", 0, [(1, 22)])]
    mic, chair = draw_scenes(parts, {}, ChartSettings(seconds=2)).axes[1::-1]
    assert [line.get_marker() for line in mic.lines] == ["None", "x"]
    assert [len(axis.lines) for axis in (mic, chair)] == [2, 1]


# -- the command


@pytest.mark.slow
def test_the_command_writes_a_report_and_goes_on(data: Path, tmp_path: Path, edge_se: Any) -> None:
    out = tmp_path / "out"
    options = ["--output-dir", out, "--data", data.parent, "--scenes", "mic", "--seeds", 0, "--seconds", 2]
    answer = edge_se("bench", "chart", *options, "--variants", "lean", "random")
    assert answer.code == 0, answer
    assert {path.name for path in out.iterdir()} == {"result.json", "README.md", "chart.png", "scenes.png"}
    result = json.loads((out / "result.json").read_text())
    assert [run["variant"] for run in result["runs"]] == ["lean", "random"]
    assert result["errors"] == []
    assert result["settings"] == {"seconds": 2, "threads": 1, "image_size": 24, "data": data.parent.name}
    assert f"the scenes in {data.parent.name}" in (out / "README.md").read_text()
    answer = edge_se("bench", "chart", *options, "--variants", "lean", "--dry-run")
    assert answer.out.splitlines() == ["lean | mic | 0", "1 trainings, 0 of them pending"]


def test_bad_flags_are_refused(data: Path, tmp_path: Path, edge_se: Any) -> None:
    (larger,) = make_scenes(tmp_path / "data", ["drums"], size=25, num_train=1, num_val=1, num_test=1)
    (tmp_path / "data" / "mic").symlink_to(data)
    for options, message in (
        (["--variants", "best"], "'best' is none of lean"),
        (["--data", larger.parent, "--scenes", "mic", "drums"], "different sizes (mic 24, drums 25 pixels)"),
        (["--data", larger.parent, "--scenes", "chair"], "chair"),
        (["--scenes", "lego"], "'lego' is none of"),
        (["--seconds", "0"], "--seconds is 0"),
        (["--threads", "0"], "--threads is 0"),
    ):
        answer = edge_se("bench", "chart", "--output-dir", tmp_path / "o", *options)
        assert answer.code == 2, (options, answer)
        assert message in answer.err
    assert not (tmp_path / "o").exists()


def test_results_on_synthetic_scenes_go_on_and_are_not_those_of_a_folder(tmp_path: Path, edge_se: Any) -> None:
    """Of the same names, and images as large; versions before had no setting for that."""
    make_scenes(tmp_path / "own", ["mic"], size=100, num_train=1, num_val=1, num_test=1)
    folder = folder_of(tmp_path, [{"variant": "lean", "scene": "mic", "seed": 0}])
    flags = ["--output-dir", folder, "--scenes", "mic", "--seeds", 0, "--variants", "lean", "--dry-run"]
    answer = edge_se("bench", "chart", *flags)
    assert "1 trainings, 0 of them pending" in answer.out
    answer = edge_se("bench", "chart", *flags, "--data", tmp_path / "own")
    assert answer.code == 2, answer
    assert "other settings" in answer.err


def test_baselines_that_cannot_be_compared_are_refused_before_training(tmp_path: Path, edge_se: Any) -> None:
    folder = folder_of(tmp_path, [], baseline([("bricks", 0, [[1, 20.0]])]))
    answer = edge_se("bench", "chart", "--output-dir", folder, "--threads", "2")
    assert answer.code == 2, answer
    assert "threads is 1, that of the result beside it 2" in answer.err
