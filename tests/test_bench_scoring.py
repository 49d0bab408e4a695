"""`bench scoring`, a small run: what each source of squared errors costs, and how it ranks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from edge_se_sampler.bench.micro import scoring


@pytest.mark.slow
def test_the_command_compares_the_three_error_sources(
    scene: Path, tmp_path: Path, edge_se: Any, monkeypatch: Any
) -> None:
    monkeypatch.setattr(scoring, "cached_scene", lambda *_: scene)
    flags = ["--scene", "mic", "--size", "tiny", "--rays", 64, "--rounds", 2, "--iterations", 12]
    answer = edge_se("bench", "scoring", "--output-dir", tmp_path / "new", *flags)
    assert answer.code == 0, answer
    result = json.loads((tmp_path / "new" / "scoring-tiny.json").read_text())
    assert set(result["milliseconds"]) == {"random", "fine", "coarse", "cached"}
    assert all(0.2 < ratio < 10 for ratio in result["memory_against_random"].values())
    assert 0.3 < result["rank_correlation"]["coarse"] <= 1
    assert f"{result['rank_correlation']['coarse']:.2f} |" in (tmp_path / "new" / "README.md").read_text()


def test_values_without_meaning_are_refused(tmp_path: Path, edge_se: Any) -> None:
    for flags in (("--rounds", 0), ("--scene", "lego", "--workplace", tmp_path)):
        assert edge_se("bench", "scoring", "--output-dir", tmp_path / "new", *flags).code == 2
