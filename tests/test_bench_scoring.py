"""What scoring costs and how it ranks: the arithmetic, and a small run of the command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_se_sampler.bench.micro.scoring import spearman


def test_ranks_correlate_whatever_the_scale() -> None:
    rng = np.random.default_rng(0)
    scores = rng.random(500)
    assert spearman(scores, np.exp(5 * scores)) == pytest.approx(1)
    assert spearman(scores, -scores) == pytest.approx(-1)
    assert abs(spearman(scores, rng.random(500))) < 0.2


def test_ties_share_their_rank() -> None:
    # ranks 1, 2.5, 2.5, 4 against 1, 2, 3, 4: covariance 4.5, variances 4.5 and 5
    assert spearman(np.array([0, 1, 1, 2]), np.arange(4)) == pytest.approx(4.5 / np.sqrt(4.5 * 5))


def test_the_command_measures_all_three(scene: Path, tmp_path: Path, edge_se: Any) -> None:
    (tmp_path / "w" / "scenes").mkdir(parents=True)
    (tmp_path / "w" / "scenes" / "mic").symlink_to(scene)
    out = tmp_path / "new" / "scoring.json"
    answer = edge_se(
        "bench", "scoring", "--output-path", out, "--workplace", tmp_path / "w", "--scene", "mic", "--size", "tiny",
        "--rays", 64, "--rounds", 2, "--learning", 12,
    )  # fmt: skip
    assert answer.code == 0, answer
    told = json.loads(out.read_text())
    assert set(told["time_against_random"]) == set(told["memory_against_random"]) == {"fine", "coarse", "cached"}
    assert all(0.2 < ratio < 10 for ratio in told["time_against_random"].values())
    assert told["rank_correlation_with_exact"]["coarse"] > 0.3
    assert len(answer.out.splitlines()) == 4
    assert edge_se("bench", "scoring", "--rounds", 0).code == 2
    assert edge_se("bench", "scoring", "--scene", "lego").code == 2
