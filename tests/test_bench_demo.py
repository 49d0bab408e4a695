"""`edge-se demo`, a short one on small images."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from edge_se_sampler.bench import demo


def test_the_demo_prints_its_result_and_leaves_a_picture_and_a_json(
    tmp_path: Path, edge_se: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo, "SCENE", demo.SCENE | {"size": 24})
    monkeypatch.setattr(demo, "SPLITS", {"num_train": 3, "num_val": 1, "num_test": 2})
    monkeypatch.setattr(demo, "ITERATIONS", 20)
    answer = edge_se("demo", "--output-dir", tmp_path / "seed-3", "--seed", 3)
    assert answer.code == 0, answer
    assert {path.name for path in (tmp_path / "seed-3").iterdir()} == {"demo.png", "demo.json", "demo"}
    methods = json.loads((tmp_path / "seed-3" / "demo.json").read_text())["methods"]
    assert [len(measured["validation"]) for measured in methods.values()] == [20, 20]
    for method, label in demo.METHODS.items():
        assert f"{label}: {methods[method]['results']['psnr']:.2f} dB" in answer.out
