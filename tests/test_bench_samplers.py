"""`bench samplers` at small sizes: what it reports of tables and draws."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from edge_se_sampler.bench.micro.samplers import build_tables
from edge_se_sampler.sampling.distribution import B


def test_tables_take_as_many_bytes_as_their_docstring_says() -> None:
    """4 + 4/B + 8/B^2 bytes per pixel, and a few per image; eight noise images repeat."""
    table, building = build_tables(11, 128)
    assert len(table) == 11
    assert building["bytes_per_pixel"] == pytest.approx(4 + 4 / B + 8 / B**2, abs=0.01)
    assert building["build_seconds"] > 0
    torch.testing.assert_close(table.probability(0), table.probability(8))
    assert not torch.allclose(table.probability(0), table.probability(1))


def test_the_command_writes_every_time(tmp_path: Path, edge_se: Any) -> None:
    flags = ["--images", 3, "--size", 32, "--draws", 64, "--rounds", 3]
    answer = edge_se("bench", "samplers", "--output-dir", tmp_path / "out", *flags)
    assert answer.code == 0, answer
    result = json.loads((tmp_path / "out" / "samplers.json").read_text())
    assert result["settings"] == {"images": 3, "size": 32, "draws": 64, "rounds": 3}
    assert result["strategies"]["regions"]["bytes_per_pixel"] <= 5
    assert result["strategies"]["error-map"]["bytes_per_pixel"] >= 8  # a cell is a pixel here
    readme = (tmp_path / "out" / "README.md").read_text()
    for milliseconds in result["milliseconds"].values():
        assert f"| {milliseconds:.2f} ms |" in readme
    result["milliseconds"] |= {"Edge, of all images": 0.0}
    (tmp_path / "out" / "samplers.json").write_text(json.dumps(result))
    answer = edge_se("bench", "report", tmp_path / "out")
    assert answer.code == 2
    assert "checksum" in answer.err
