"""`edge-se demo`, a short one on small images, and its report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from edge_se_sampler.bench.demo import train as demo


def test_the_demo_leaves_a_picture_and_a_json_that_can_be_reported(
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
    assert edge_se("bench", "report", tmp_path).code == 0
    readme = (tmp_path / "README.md").read_text()
    psnrs = [f"{methods[method]['results']['psnr']:.2f} dB" for method in ("vanilla-nerf", "edge-se-nerf")]
    assert f"| 3 | {psnrs[0]} | {psnrs[1]} |" in readme
    assert "](seed-3/demo.png)" in readme
