"""The runner of experiments: what is trained, and what was before; shards of an experiment."""

from __future__ import annotations

import json
import sys
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from toy_experiment import TRIALS, ToyTrial, one_thread, toy_experiment, train

from edge_se_sampler.bench.command import ExperimentCommand
from edge_se_sampler.bench.results import Run, read_result, write_result
from edge_se_sampler.bench.runner import Experiment, Shard, list_trials, run_experiment
from edge_se_sampler.errors import InputError


def test_a_later_call_trains_only_what_is_pending(tmp_path: Path) -> None:
    trained = []

    def count(trial: ToyTrial) -> Run:
        trained.append(trial)
        return train(trial)

    run_experiment(toy_experiment(count, lambda _: TRIALS[:1]), tmp_path, one_thread)
    run_experiment(toy_experiment(count, lambda _: [*TRIALS, *TRIALS]), tmp_path, one_thread)
    assert trained == TRIALS


def test_later_trials_may_depend_on_earlier_runs(tmp_path: Path) -> None:
    def trials(runs: list[Run]) -> list[ToyTrial]:
        best = max((run["seed"] for run in runs if run["scene"] == "mic"), default=None)
        return TRIALS if best is None else [*TRIALS, ToyTrial("chair", best)]

    result = run_experiment(toy_experiment(trials=trials), tmp_path, one_thread)
    assert [(run["scene"], run["seed"]) for run in result["runs"]] == [("chair", 2), ("mic", 0), ("mic", 1), ("mic", 2)]


def test_what_trainings_need_is_made_before_any_begins(tmp_path: Path) -> None:
    """A training that ended meanwhile could be lost."""
    order: list[str] = []

    def arguments(trial: ToyTrial) -> tuple[object, ...]:
        order.append(f"made for {trial.seed}")
        return ()

    def begin() -> Executor:
        order.append("begins")
        return one_thread()

    run_experiment(replace(toy_experiment(), arguments=arguments), tmp_path, begin)
    assert order == ["made for 0", "made for 1", "made for 2", "begins"]


def test_a_failing_trial_is_reported_stops_no_other_and_is_tried_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail_once(trial: ToyTrial) -> Run:
        if trial.seed == 1 and not (tmp_path / "failed").exists():
            (tmp_path / "failed").touch()
            raise FloatingPointError("the loss is not finite at step 3")
        return train(trial)

    result = run_experiment(toy_experiment(fail_once), tmp_path, one_thread)
    assert [run["seed"] for run in result["runs"]] == [0, 2]
    assert result["errors"] == [
        {"scene": "mic", "seed": 1, "error": "FloatingPointError: the loss is not finite at step 3"}
    ]
    assert "mic, 1, FloatingPointError: the loss is not finite at step 3" in capsys.readouterr().out
    list_trials(toy_experiment(), tmp_path)
    assert "3 trainings, 1 of them pending" in capsys.readouterr().out
    again = run_experiment(toy_experiment(fail_once), tmp_path, one_thread)
    assert [run["seed"] for run in again["runs"]] == [0, 1, 2]
    assert again["errors"] == []


@dataclass(frozen=True, kw_only=True)
class ToyCommand(ExperimentCommand):
    failing: int | None

    def experiment(self) -> Experiment:
        def fail(trial: ToyTrial) -> Run:
            if trial.seed == self.failing:
                raise FloatingPointError("the loss is not finite")
            return train(trial)

        return toy_experiment(fail)


@pytest.mark.parametrize("failing", [None, 0])
def test_an_experiment_of_which_a_training_failed_ends_with_exit_code_1(
    failing: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("edge_se_sampler.bench.command.executor_factory", lambda *_: one_thread)
    command = ToyCommand(output_dir=tmp_path, shard="1/2", failing=failing)
    with nullcontext() if failing is None else pytest.raises(SystemExit) as ended:
        command.run()
    assert ended is None or ended.value.code == 1
    assert ("1 failed" in capsys.readouterr().err) == (failing is not None)


def test_listing_trials_trains_and_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_experiment(toy_experiment(trials=lambda _: TRIALS[:1]), tmp_path, one_thread)
    before = (tmp_path / "result.json").read_bytes()
    list_trials(toy_experiment(lambda _: pytest.fail("trained")), tmp_path)
    assert capsys.readouterr().out.endswith("mic | 0\nmic | 1\nmic | 2\n3 trainings, 2 of them pending\n")
    assert (tmp_path / "result.json").read_bytes() == before
    list_trials(toy_experiment(), tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_flags_that_choose_nothing_are_refused(tmp_path: Path) -> None:
    run_experiment(toy_experiment(), tmp_path / "old", one_thread, Shard(1, 2))
    for folder in (tmp_path / "old", tmp_path / "new"):
        for call in (list_trials, lambda experiment, folder: run_experiment(experiment, folder, one_thread)):
            with pytest.raises(InputError, match="bench toy: there is no training"):
                call(toy_experiment(trials=lambda _: []), folder)
    assert not (tmp_path / "new").exists()
    assert not (tmp_path / "old" / "result.json").exists()


def test_what_is_chosen_twice_is_one_training(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    experiment = toy_experiment(trials=lambda _: [*TRIALS, *TRIALS])
    list_trials(experiment, tmp_path)
    assert capsys.readouterr().out.endswith("mic | 2\n3 trainings, 3 of them pending\n")
    shards = [run_experiment(experiment, tmp_path, one_thread, Shard(number, 2))["runs"] for number in (1, 2)]
    assert [[run["seed"] for run in runs] for runs in shards] == [[0, 2], [0, 1, 2]]


# -- shards


def test_shards_train_each_trial_once_and_are_put_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained = []

    def count(trial: ToyTrial) -> Run:
        trained.append(trial)
        return train(trial)

    for name, expected in (("1/2", [0, 2]), ("2/2", [1]), ("1/2", [])):
        trained.clear()
        monkeypatch.setattr(sys, "argv", ["edge-se", "bench", "toy", "--shard", name])
        run_experiment(toy_experiment(count), tmp_path, one_thread, Shard.parse(name))
        assert [trial.seed for trial in trained] == expected
    assert not (tmp_path / "result.json").exists()
    (tmp_path / "shards" / "1-of-2.json").rename(tmp_path / "shards" / "of_another_machine.json")
    for path in (tmp_path / "shards").iterdir():
        shard = read_result(path)
        write_result(path, shard | {"machine": shard["machine"] | {"processor": "another"}})
    monkeypatch.setattr(sys, "argv", ["edge-se", "bench", "toy"])
    result = run_experiment(toy_experiment(lambda _: pytest.fail("trained")), tmp_path, one_thread)
    assert read_result(tmp_path / "result.json") == json.loads(json.dumps(result))
    assert [run["psnr"] for run in result["runs"]] == [20.0, 21.0, 22.0]
    assert result["machine"]["processor"] == "another"
    commands = ["edge-se bench toy --shard 1/2", "edge-se bench toy --shard 2/2", "edge-se bench toy"]
    assert sorted(result["command"].splitlines()) == sorted(commands)


def test_what_a_killed_shard_lacks_is_trained_by_the_call_that_puts_together(tmp_path: Path) -> None:
    run_experiment(toy_experiment(), tmp_path, one_thread, Shard(2, 3))
    trained = []
    run_experiment(toy_experiment(lambda trial: trained.append(trial.seed) or train(trial)), tmp_path, one_thread)
    assert trained == [0, 2]


@pytest.mark.parametrize("text", ["0/2", "3/2", "1/0", "2", "a/b", "-1/2"])
def test_a_shard_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="--shard"):
        Shard.parse(text)


def test_a_shard_of_other_settings_is_refused(tmp_path: Path) -> None:
    run_experiment(toy_experiment(steps=4), tmp_path, one_thread, Shard(1, 2))
    with pytest.raises(InputError, match="of another experiment or other settings"):
        run_experiment(toy_experiment(), tmp_path, one_thread)
