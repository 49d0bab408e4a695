"""Runs and results that earlier versions wrote are read, continued, and then in today's format."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from format_runs import RUNS, SETTINGS, STEPS, write_scene

from edge_se_sampler.bench.results import VERSION, read_result, write_result
from edge_se_sampler.engine.run_folder import FORMAT, OLDEST_FORMAT, RunFolder
from edge_se_sampler.methods import method_configs

RESULTS = Path(__file__).parent.parent / "configs"


def metrics_of(path: Path) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    return [{key: value for key, value in line.items() if key not in ("seconds", "crc32")} for line in lines]


@pytest.mark.parametrize("method", SETTINGS)
@pytest.mark.parametrize("number", range(OLDEST_FORMAT, FORMAT + 1))
def test_a_run_of_a_format_is_continued(
    number: int, method: str, tmp_path: Path, edge_se, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Path(shutil.copytree(RUNS / f"format-{number}" / method, tmp_path / "run"))
    assert json.loads((run / "config.json").read_text()).get("format", 2) == number
    write_scene(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert edge_se("eval", run).code == 0
    answer = edge_se("resume", run)
    assert answer.code == 0, answer.err
    assert f"{STEPS} of {STEPS} iterations" in answer.out
    found, expected = metrics_of(run / "metrics.jsonl"), metrics_of(run / "whole.jsonl")
    for key in ("step", "strategy"):
        assert [line.get(key) for line in found] == [line.get(key) for line in expected]
    for key in ("loss", "learning_rate", "val_psnr"):  # another machine rounds differently
        whole = [line[key] for line in expected if key in line]
        assert [line[key] for line in found if key in line] == pytest.approx(whole, rel=0.02)
    assert json.loads((run / "config.json").read_text())["format"] == FORMAT
    config = RunFolder(run).config(method_configs())
    assert (config.patience, config.steps_per_eval_image) == (None, 5)
    assert len(RunFolder(run).metrics()) == len(expected)


def test_every_format_has_its_runs() -> None:
    assert {path.name for path in RUNS.iterdir()} == {f"format-{n}" for n in range(OLDEST_FORMAT, FORMAT + 1)}


def test_results_of_the_version_before_are_read_and_written_as_todays(tmp_path: Path) -> None:
    committed = read_result(RESULTS / "stability" / "result.json")
    assert committed["version"] in (VERSION - 1, VERSION)
    old = tmp_path / "result.json"
    old.write_text(json.dumps({**committed, "version": VERSION - 1}))
    write_result(old, read_result(old))
    assert json.loads(old.read_text())["version"] == VERSION
    assert read_result(old) == {**committed, "version": VERSION}
