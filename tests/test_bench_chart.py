"""The chart: what a variant trains, what its numbers mean, and that the committed one is what it says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_se_sampler.bench.baselines.results import read_external
from edge_se_sampler.bench.chart import train as train_module
from edge_se_sampler.bench.chart.draw import draw_chart, draw_scenes
from edge_se_sampler.bench.chart.summary import (
    at,
    beside,
    comparable,
    dominating,
    front,
    over_scenes,
    rows_of,
    rows_of_others,
    rows_of_scenes,
    table,
)
from edge_se_sampler.bench.chart.train import Scale, iterations_within, run_cell
from edge_se_sampler.bench.chart.variants import VARIANTS, Cell, cells, changed, config_of
from edge_se_sampler.bench.experiment import alone
from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.data.synthetic import make_scenes
from edge_se_sampler.engine.resolve import resolve_config
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scenes(tmp_path_factory.mktemp("chart"), ["mic"], size=24, num_train=4, num_val=1, num_test=1)[0]


# -- variants


@pytest.mark.parametrize("name", VARIANTS)
def test_a_variant_is_a_method_with_its_changes_and_can_be_planned(name: str, made: Path, tmp_path: Path) -> None:
    variant = VARIANTS[name]
    config = config_of(Cell(name, "mic", 5), made, tmp_path)
    plain = method_configs()[variant.method]
    assert config.machine.seed == 5
    for path, value in variant.changes.items():
        found, before = config, plain
        for part in path.split("."):
            found, before = getattr(found, part), getattr(before, part)
        assert found == value
        assert before != value  # it changes something
    if not variant.changes:
        assert config.pipeline == plain.pipeline
    resolve_config(config, read_blender(made, "train"))


def test_changing_a_field_leaves_the_others_and_the_original() -> None:
    config = method_configs()["lean-nerf"]
    other = changed(config, "pipeline.model.width", 7)
    assert (config.pipeline.model.width, other.pipeline.model.width) == (None, 7)
    assert replace(other, pipeline=config.pipeline) == config


def test_what_is_compared_is_trained_side_by_side() -> None:
    assert [cell.name for cell in cells(("lean", "edge"), ("mic", "chair"), (0, 1))][:3] == [
        "lean-mic-0", "edge-mic-0", "lean-chair-0",
    ]  # fmt: skip
    assert len(cells((), ("mic",), (0,))) == len(VARIANTS)


# -- a training


def test_a_run_is_planned_to_fill_its_time_and_is_looked_at_on_the_way(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train_module, "LOOKS", (0.2, 0.4, 1.0, 1.5))
    run = run_cell(Cell("lean", "mic", 1), Scale(seconds=2.5), made)
    assert (run["variant"], run["scene"], run["seed"]) == ("lean", "mic", 1)
    curve = np.array(run["curve"])
    assert (np.diff(curve[:, :3], axis=0) > 0).all()  # seconds, steps, evaluations
    assert len(curve) >= 2
    assert curve[-1].tolist() == [run["seconds"], run["steps"], run["evaluations"], round(run["psnr"], 3)]
    assert run["steps"] <= run["planned_steps"]
    assert 0.2 < run["seconds"] < 10  # on a busy machine too
    assert 0 < run["ready_seconds"] < run["curve"][0][0]
    assert json.loads(json.dumps(run)) == run


def test_memory_is_a_trainings_own(made: Path) -> None:
    run = alone(run_cell, Cell("lean", "mic", 1), Scale(seconds=1), made)  # a process has one peak in its life
    assert run["peak_bytes"] > 2**22  # of the trial of its steps too


@pytest.mark.parametrize("guess", [10, 100_000])
def test_a_plan_far_from_its_time_is_made_anew(guess: int, made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train_module, "iterations_within", lambda config, scale: guess)
    run = run_cell(Cell("lean", "mic", 1), Scale(seconds=1.5), made)
    assert 20 < run["planned_steps"] < 10_000
    assert 0.5 < run["steps"] / run["planned_steps"] <= 1
    assert 0.5 < run["seconds"] < 3  # neither cut early nor after ten steps


def test_a_plan_grows_with_its_time(made: Path, tmp_path: Path) -> None:
    config = config_of(Cell("lean", "mic", 0), made, tmp_path)
    short, long = (iterations_within(config, Scale(seconds)) for seconds in (2, 20))
    assert 3 * short < long


# -- what the runs say


def run_of(variant: str, scene: str, seed: int, curve: list[tuple[float, float]], outcome: str = "learnt") -> Any:
    points = [[seconds, 10 * seconds, 1000 * seconds, psnr] for seconds, psnr in curve]
    return {
        "variant": variant, "scene": scene, "seed": seed, "outcome": outcome, "curve": points, "psnr": curve[-1][1],
        "seconds": curve[-1][0], "steps": 10 * curve[-1][0], "evaluations": 1000 * curve[-1][0], "ready_seconds": 0.0,
        "peak_bytes": 2**20,
    }  # fmt: skip


def test_between_looks_the_logarithm_of_time_counts() -> None:
    curve = [[1, 0, 0, 20.0], [4, 0, 0, 24.0]]
    assert at(curve, 2) == pytest.approx(22)
    assert at(curve, 0.5) is None
    assert at(curve, 9) == 24.0


def test_medians_over_seeds_then_means_over_scenes() -> None:
    runs = [run_of("lean", "mic", s, [(1, p), (3, p + 1)]) for s, p in enumerate((20, 30, 22))]
    runs += [run_of("lean", "chair", 0, [(2, 10), (3, 12)])]
    assert over_scenes(runs, 3) == pytest.approx((23 + 12) / 2)
    assert over_scenes(runs, 1) is None  # one scene has nothing to show yet


def test_the_front_names_the_best_at_every_look_and_how_far_the_recommended_one_is() -> None:
    runs = [run_of("lean", "mic", 0, [(1, 20), (60, 30)]), run_of("edge", "mic", 0, [(1, 25), (60, 28)])]
    told = {row["seconds"]: row for row in front(runs)}
    assert (told[1]["best"], told[1]["recommended_behind"]) == ("edge", 5)
    assert (told[60]["best"], told[60]["recommended_behind"]) == ("lean", 0)


def test_who_is_better_all_the_time_keeps_the_recommended_one_off_the_front() -> None:
    mine = run_of("lean", "mic", 0, [(1, 20), (7, 25), (60, 30)])
    for psnrs, expected in (
        ((21, 26, 31), ["edge"]),
        ((21, 26, 30), []),
        ((21, 24, 31), []),
        ((20.1, 25.1, 30.1), ["edge"]),
    ):
        theirs = run_of("edge", "mic", 0, list(zip((1, 7, 60), psnrs, strict=True)))
        assert dominating([mine, theirs]) == expected


def test_only_common_scenes_and_seeds_are_compared() -> None:
    runs = [run_of("lean", scene, 0, [(1, 20)]) for scene in ("mic", "chair")] + [run_of("edge", "mic", 0, [(1, 9)])]
    assert {run["scene"] for mine in comparable(runs).values() for run in mine} == {"mic"}
    runs += [run_of("lean", "mic", 1, [(1, 20)]), run_of("rays-128", "chair", 0, [(1, 20)])]
    assert {name: [run["seed"] for run in mine] for name, mine in comparable(runs, ("methods",)).items()} == {
        "lean": [0], "edge": [0],
    }  # fmt: skip
    assert {run["scene"] for run in comparable(runs, ("size",))["lean"]} == {"chair"}
    assert comparable(runs) == comparable([]) == {}  # nothing in common, or nothing at all


def test_the_table_counts_failures() -> None:
    runs = [run_of("random", "mic", s, [(1, 15), (7.5, 16)], "background" if s else "learnt") for s in range(3)]
    line = next(line for line in table(runs, []).splitlines() if line.startswith("| Random"))
    assert line.split(" | ")[3:5] == ["16.00", "2 of 3"]
    assert "100.0 | 100 | 1 MiB |" in line


def test_methods_are_tabled_where_what_scores_them_was_trained_and_scene_by_scene() -> None:
    runs = [run_of("edge-se-coarse", "mic", 0, [(1, 12)]), run_of("edge", "mic", 1, [(1, 30)])]
    for k, scene in enumerate(("chair", "mic")):
        runs += [
            run_of("lean", scene, 0, [(1, 20 + k)]),
            run_of("edge", scene, 0, [(1, 10 + k)], ("background", "learnt")[k]),
        ]
    _, rows = rows_of(runs)
    assert {row[0]: row[1] for row in rows["methods"]} == {"lean-nerf": "21.00", "Edge": "11.00"}
    assert {row[0]: row[1] for row in rows["scorings"]} == {"lean-nerf": "21.00", "Edge + SE, coarse": "12.00"}
    assert rows_of_scenes(runs) == (
        ["", "chair", "mic"], [["lean-nerf", "20.00", "21.00"], ["Edge", "(10.00)", "11.00"]],
    )  # fmt: skip
    assert "| Edge | (10.00) | 11.00 |" in table(runs, [])
    both = [{"scene": s, "seed": 0, "curve": [[1, 5.0], [60, p]]} for s, p in (("mic", 24), ("chair", 23), ("ship", 1))]
    others = [GOOD, {**GOOD, "runs": both}, {**GOOD, "runs": [{**run, "seed": 1} for run in both]}]
    assert rows_of_scenes(runs, others)[1][2:] == [["theirs", "23.00", "24.00"]]
    assert "| theirs | 23.00 | 24.00 |" in table(runs, others)
    assert "Every scene" not in table([run for run in runs if run["scene"] == "mic"], [])


def test_other_programs_are_shown_at_the_same_looks() -> None:
    runs = [run_of("lean", "mic", 0, [(1, 15), (21.5, 16)])]
    (row,) = rows_of_others(runs, [{**GOOD, "command": "train --fast"}])
    assert row == ["theirs", "1", "train --fast", "21.00", "21.00", "21.00", "21.00"]
    lines = table(runs, [GOOD]).splitlines()
    assert "|  | version | flags | 3 s | 7 s | 20 s | end |" in lines
    assert "| theirs | 1 | train | 21.00 | 21.00 | 21.00 | 21.00 |" in lines


# -- other programs


GOOD = {
    "name": "theirs", "version": "1", "command": "train", "machine": "this one",
    "runs": [{"scene": "mic", "seed": 0, "curve": [[1, 20.0], [2, 21.0]]}],
}  # fmt: skip


def test_other_programs_come_in_as_a_file(tmp_path: Path) -> None:
    path = tmp_path / "theirs.json"
    path.write_text(json.dumps(GOOD))
    assert read_external(path, "--external", Scale()) == GOOD


@pytest.mark.parametrize(
    "bad",
    [
        "{", "[]", {**GOOD, "runs": 3}, {key: value for key, value in GOOD.items() if key != "version"},
        {**GOOD, "runs": [{"scene": "mic", "seed": 0, "curve": [[2, 20.0], [1, 21.0]]}]},
        {**GOOD, "runs": [{"scene": "mic", "seed": 0, "curve": []}]},
        {**GOOD, "runs": [{"scene": "mic", "seed": 0, "curve": [[1, "much"]]}]},
    ],
)  # fmt: skip
def test_a_bad_file_is_refused_in_one_line(bad: Any, tmp_path: Path) -> None:
    path = tmp_path / "theirs.json"
    path.write_text(bad if isinstance(bad, str) else json.dumps(bad))
    with pytest.raises(InputError, match=r"^--external .*theirs.json: not a result"):
        read_external(path, "--external", Scale())


@pytest.mark.parametrize("other", [{"threads": 2}, {"pixels": 400}])
def test_seconds_of_another_kind_are_refused(other: dict[str, int], tmp_path: Path) -> None:
    path = tmp_path / "theirs.json"
    path.write_text(json.dumps(GOOD | other))
    assert read_external(path, "--external", Scale(**other)) == GOOD | other
    ((kind, value),) = other.items()
    with pytest.raises(InputError, match=rf"theirs.json: made with {value} {kind}, not 1"):
        read_external(path, "--external", Scale())


def test_a_program_stands_beside_us_only_on_our_scenes() -> None:
    runs = [run_of("lean", scene, 0, [(1, 20), (3, 25)]) for scene in ("mic", "chair")]
    (told,) = comparable(runs).values()
    assert beside(GOOD, {"lean": told}) == []  # it has mic alone
    both = {**GOOD, "runs": [{"scene": s, "seed": 0, "curve": [[1, 20.0]]} for s in ("mic", "chair", "ship")]}
    assert [run["scene"] for run in beside(both, {"lean": told})] == ["mic", "chair"]
    assert rows_of_others(runs, [GOOD])[0][3:] == ["–"]


def test_curves_of_a_single_look_are_drawn() -> None:
    runs = [run_of(name, "mic", s, [(1 + s, 20 + s)]) for name in ("lean", "edge") for s in (1, 2)]
    figure = draw_chart(runs, [], Scale(seconds=2))
    drawn = [line for line in figure.axes[0].lines if "lean" in str(line.get_label())]
    np.testing.assert_array_equal(drawn[0].get_xydata(), [[3, 21.5]])
    labels = [text.get_text() for text in draw_scenes(runs, [], Scale(seconds=2)).legends[0].get_texts()]
    assert sorted(labels) == ["Edge", "lean-nerf"]  # once each, whatever the seeds
    parts = [run_of("no-hull", "mic", 0, [(1, 20)], "background"), run_of("rays-128", "chair", 0, [(1, 22)])]
    mic, chair = draw_scenes([*parts], [], Scale(seconds=2)).axes[1::-1]
    assert [line.get_marker() for line in mic.lines] == ["None", "x"]
    assert [len(axis.lines) for axis in (mic, chair)] == [2, 1]  # no method is among them


# -- the command


def test_the_command_leaves_table_and_pictures_and_goes_on(made: Path, tmp_path: Path, edge_se: Any) -> None:
    theirs, out = tmp_path / "theirs.json", tmp_path / "out"
    theirs.write_text(json.dumps(GOOD))
    flags = ["--output-dir", out, "--data", made.parent, "--scenes", "mic", "--seeds", 0, "--seconds", 2]
    answer = edge_se("bench", "chart", *flags, "--variants", "lean", "random", "--external", theirs)
    assert answer.code == 0, answer
    assert {path.name for path in out.iterdir()} == {
        "result.json", "table.md", "chart.png", "parts.png", "costs.png", "scenes.png", "chart.html",
    }  # fmt: skip
    result = json.loads((out / "result.json").read_text())
    assert [run["variant"] for run in result["runs"]] == ["lean", "random"]
    assert result["errors"] == []
    assert result["external"] == [GOOD]
    assert result["settings"] == {"seconds": 2, "threads": 1, "pixels": 24}
    answer = edge_se("bench", "chart", *flags, "--variants", "lean", "--dry-run")
    assert answer.out.splitlines()[-1] == "1 trainings of 2 s, 0 still to do"


def test_bad_flags_are_refused(made: Path, tmp_path: Path, edge_se: Any) -> None:
    (larger,) = make_scenes(tmp_path / "data", ["drums"], size=25, num_train=1, num_val=1, num_test=1)
    (tmp_path / "data" / "mic").symlink_to(made)
    for flags, word in (
        (["--variants", "best"], "'best' is none of lean"),
        (["--data", larger.parent, "--scenes", "mic", "drums"], "different sizes (mic 24, drums 25 pixels)"),
        (["--data", larger.parent, "--scenes", "chair"], "chair"),
        (["--scenes", "lego"], "'lego' is none of"),
        (["--seconds", "0"], "--seconds is 0"),
        (["--external", tmp_path / "none.json"], "none.json"),
    ):
        answer = edge_se("bench", "chart", "--output-dir", tmp_path / "o", *flags)
        assert answer.code == 2, (flags, answer)
        assert word in answer.err
    assert not (tmp_path / "o").exists()
