"""`bench nerfstudio`, as far as it can be tested without nerfstudio: its report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edge_se_sampler.bench.nerfstudio.report import describe
from edge_se_sampler.bench.results import write_result


def run(method: str, seed: int, psnr: float, outcome: str) -> dict[str, Any]:
    return {"method": method, "seed": seed, "psnr": psnr, "outcome": outcome}


def write_runs(folder: Path) -> None:
    result: dict[str, Any] = {
        "experiment": "nerfstudio",
        "command": "edge-se bench nerfstudio",
        "errors": [],
        "settings": {"scene": "chair", "iterations": 10, "rays": 8, "samples": 4, "nerfstudio": "1.1.5"},
        "machine": {"processor": "p", "cores": 2, "threads": 1, "python": "3", "torch": "2", "numpy": "2"},
        "runs": [
            run("vanilla-nerf", 0, 20.0, "collapsed"),
            run("vanilla-nerf", 1, 20.4, "underfit"),
            run("vanilla-nerf", 2, 20.8, "converged"),
            run("edge-se-nerf", 0, 25.0, "converged"),
        ],
    }
    write_result(folder / "result.json", result)


def test_failures_are_counted_by_method(tmp_path: Path) -> None:
    write_runs(tmp_path)
    readme = describe(tmp_path)
    assert "uniform pixels | 2 of 3 | 1 | 20.40 dB |" in readme
    assert "Edge + SE | 0 of 1 | 0 | 25.00 dB |" in readme
