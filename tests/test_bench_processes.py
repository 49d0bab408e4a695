"""`bench processes`: times of one process and of several, and from how many rays a step they pay."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from edge_se_sampler import ranks
from edge_se_sampler.bench.processes import timing
from edge_se_sampler.bench.processes.report import describe_break_even


def runs(*ratios: float) -> list[dict[str, Any]]:
    """Of 1,000, 2,000, ... rays a step."""
    return [
        {"rays": 1000 * number, "milliseconds": {"one": 20.0, "several": 20 * ratio}}
        for number, ratio in enumerate(ratios, start=1)
    ]


@pytest.mark.parametrize(
    ("ratios", "verdict"),
    [
        ((1.4, 0.8, 0.6), "from 2,000 rays a step on"),
        ((0.8, 1.1, 0.9), "from 3,000 rays a step on"),
        ((0.9, 0.9), "from 1,000 rays a step on, the fewest timed"),
        ((0.8, 0.97), "not, up to 2,000 rays a step"),
    ],
)
def test_processes_pay_from_where_no_larger_step_is_slower(ratios: tuple[float, ...], verdict: str) -> None:
    assert describe_break_even(runs(*ratios)) == verdict


@pytest.mark.slow
def test_a_call_reaches_every_rank() -> None:
    with timing.start_ranks(2, 1) as call:
        assert call(ranks.agree, 3.0) == [[3.0], [3.0]]
        assert sorted(call(rank_and_threads)) == [(0, 1), (1, 1)]


def rank_and_threads() -> tuple[int, int]:
    ranks.agree(0.0)
    return ranks.rank(), torch.get_num_threads()


@pytest.mark.slow
def test_the_command_times_both_and_reports(scene: Path, tmp_path: Path, edge_se: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(timing, "cached_scene", lambda *_, **__: scene)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    flags = ["--rays", 32, "--rounds", 1]
    answer = edge_se("bench", "processes", "--output-dir", tmp_path / "new", *flags)
    assert answer.code == 0, answer
    readme = (tmp_path / "new" / "README.md").read_text()
    rows = [line.split(" | ") for line in readme.splitlines() if line.startswith("| `")]
    assert [row[0] for row in rows] == ["| `vanilla-nerf`", "| `lean-nerf`"]
    assert all(float(time.split()[0]) > 0 for row in rows for time in row[2:4])


@pytest.mark.parametrize("flags", [("--processes", 1), ("--processes", 100000), ("--rays", 0), ("--rounds", 0)])
def test_values_without_meaning_are_refused(flags: tuple[str, int], tmp_path: Path, edge_se: Any) -> None:
    answer = edge_se("bench", "processes", "--output-dir", tmp_path / "new", *flags)
    assert answer.code == 2
    assert answer.err.startswith(f"edge-se: {flags[0]} is ")
    assert answer.err.count("\n") == 1
