"""The samplers' benchmark at small sizes: what it reports of tables, draws and memory."""

from __future__ import annotations

import json
from typing import Any

import pytest
import torch

from edge_se_sampler.bench.micro import samplers
from edge_se_sampler.bench.micro.samplers import bench_samplers, build_tables, large_image_halves, table_of
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.sampling.distribution import B


def test_tables_cost_what_their_docstring_says() -> None:
    """4 + 4/B + 8/B^2 bytes a pixel, and a few for each image; noise images are numbered round in eights."""
    table, building = build_tables(11, 128, Progress(11, "test"))
    assert len(table) == 11
    assert building["pixels"] == 11 * 128 * 128
    assert building["bytes_per_pixel"] == pytest.approx(4 + 4 / B + 8 / B**2, abs=0.01)
    assert building["build_seconds"] > 0
    torch.testing.assert_close(table.probability(0), table.probability(8))
    assert not torch.allclose(table.probability(0), table.probability(1))


def test_an_image_beyond_two_to_the_24_is_drawn_right() -> None:
    halves = large_image_halves()
    assert halves["pixels"] > 2**24
    assert abs(halves["z"]) < 4.9  # two-sided alpha 1e-6
    assert halves["z"] == pytest.approx((halves["share"] - 2 / 3) / (2 / 9 / 100_000) ** 0.5)


def test_the_report_is_json_with_every_case(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = {"rays": 8, "random_bytes": 100.0, "se_bytes": 110.0, "ratio": 1.1}
    large = {"pixels": 2**24, "share": 0.66, "expected": 2 / 3, "z": -4.0}
    monkeypatch.setattr(samplers, "memory_ratio", lambda: memory)
    monkeypatch.setattr(samplers, "large_image_halves", lambda: large)
    result = bench_samplers(images=3, size=32, draws=64, repeats=3)
    json.dumps(result, allow_nan=False)
    times = result["milliseconds"]
    assert {"edge_all_images", "edge_one_image", "uniform_all_images", "se_selection"} <= set(times)
    assert all(0 < value < 1000 for value in times.values())
    assert result["training_memory"] == memory
    assert result["machine"]["torch"]
    lines = table_of(result).split("\n")
    for name in times:
        assert sum(name.replace("_", " ") in line for line in lines) == 1
    assert any("SE 1.100 x Random" in line for line in lines)


def test_medians_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """One slow round of five does not show."""
    monkeypatch.setattr(samplers, "memory_ratio", lambda: {})
    monkeypatch.setattr(samplers, "large_image_halves", lambda: {})
    clock = iter(range(10**9))
    now: list[Any] = [0.0]

    def fake() -> float:
        tick = next(clock)
        if tick % 2:  # the end of a case: round 3 takes 100 s, the others 2
            now[0] += 100.0 if (tick - 2) // 12 == 3 else 2.0
        return now[0]

    monkeypatch.setattr(samplers.time, "perf_counter", fake)
    result = bench_samplers(images=1, size=8, draws=4, repeats=5)
    assert set(result["milliseconds"].values()) == {2000.0}


def test_training_memory_is_measured_in_a_process_of_its_own() -> None:
    """What memory_ratio runs, with few rays."""
    assert 1e6 < samplers.peak_bytes("se-nerf", 64, "small", "fine") < 4e9
