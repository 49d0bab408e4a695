"""The json of an experiment: what it holds, and what is refused as none, or as what a page could not show."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from toy_experiment import TRIALS, ToyTrial, one_thread, read, toy_experiment, train

from edge_se_sampler.bench.results import VERSION, read_result, write_result
from edge_se_sampler.bench.runner import list_trials, run_experiment
from edge_se_sampler.errors import InputError


def test_result_json_holds_the_head_and_every_run_sorted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["edge-se", "bench", "toy"])
    result = run_experiment(toy_experiment(trials=lambda _: TRIALS[::-1]), tmp_path / "new", one_thread)
    assert read_result(tmp_path / "new" / "result.json") == json.loads(json.dumps(result))
    assert result["runs"] == [{"scene": "mic", "seed": seed, "psnr": 20.0 + seed} for seed in range(3)]
    assert (result["version"], result["experiment"], result["settings"]) == (VERSION, "toy", {"steps": 3})
    assert result["command"] == "edge-se bench toy"
    assert result["errors"] == []


def test_every_command_that_trained_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for count in (1, 1, 2):
        monkeypatch.setattr(sys, "argv", ["edge-se", "bench", "toy", str(count)])
        run_experiment(toy_experiment(trials=lambda _, count=count: TRIALS[:count]), tmp_path, one_thread)
    assert read(tmp_path)["command"] == "edge-se bench toy 1\nedge-se bench toy 2"


def test_a_number_that_is_not_finite_is_an_error_of_its_trial(tmp_path: Path) -> None:
    experiment = toy_experiment(lambda trial: {"psnr": 20.0 if trial.seed else float("nan")})
    result = run_experiment(experiment, tmp_path, one_thread)
    assert [run["seed"] for run in result["runs"]] == [1, 2]
    assert [error["seed"] for error in result["errors"]] == [0]
    assert read_result(tmp_path / "result.json")["runs"] == result["runs"]


@pytest.mark.parametrize("folder", ["R&D", "a[1]", "x#1", "../up", "<b>"])
def test_any_path_that_is_text_may_be_in_the_command(
    folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["edge-se", "bench", "toy", "--output-dir", folder])
    trained = []
    for _ in range(2):  # as it is, and read again
        run_experiment(toy_experiment(lambda trial: trained.append(1) or train(trial)), tmp_path, one_thread)
        assert len(trained) == 3


@pytest.mark.parametrize(("command", "scene"), [("a`b", "mic"), ("a\nb", "mic"), ("\udcff", "mic"), ("x", "<b>mic")])
def test_what_a_page_cannot_show_is_refused_before_anything_is_trained(
    command: str, scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["edge-se", "bench", "toy", "--output-dir", command])
    experiment = toy_experiment(lambda _: pytest.fail("trained"), lambda _: [ToyTrial(scene, 0)])
    with pytest.raises(InputError, match="which a page could not show"):
        run_experiment(experiment, tmp_path / "new", one_thread)
    assert not (tmp_path / "new").exists()


EMPTY = {
    "version": 2, "experiment": "toy", "command": "", "settings": {"steps": 3}, "machine": {}, "runs": [], "errors": [],
}  # fmt: skip


@pytest.mark.parametrize(
    "change",
    [
        {"version": 1},
        {"runs": 3},
        {"runs": [7]},
        {"machine": None},
        {"experiment": "other"},
        {"settings": {"steps": 4}},
    ],
    ids=str,
)
def test_a_file_that_is_no_result_of_the_experiment_is_refused_and_kept(change: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    content = {key: value for key, value in {**EMPTY, **change}.items() if value is not None}
    for text in (json.dumps(content), json.dumps(content)[:-1], "[]"):
        path.write_text(text)
        with pytest.raises(InputError, match=r"result\.json"):
            run_experiment(toy_experiment(), tmp_path, one_thread)
        assert path.read_text() == text


@pytest.mark.parametrize("name", ["result.json", "shards/1-of-2.json"])
@pytest.mark.parametrize("run", [{}, {"scene": "mic"}, {"scene": "mic", "seed": [1]}, {"scene": "mic", "seed": "x"}])
def test_runs_that_are_of_no_trial_are_refused(run: dict[str, Any], name: str, tmp_path: Path) -> None:
    (tmp_path / "shards").mkdir()
    write_result(tmp_path / name, {**EMPTY, "runs": [{"scene": "mic", "seed": 0}, run]})
    with pytest.raises(InputError, match=rf"{name}.*none of bench toy"):
        list_trials(toy_experiment(), tmp_path)
