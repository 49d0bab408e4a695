"""The paper's cells on a dask cluster: two local workers, of which one is killed while it works."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("distributed", reason="needs the [cluster] extra")

from distributed import LocalCluster

from edge_se_sampler.bench.paper import run as running
from edge_se_sampler.bench.paper.cell import Cell, Preset
from edge_se_sampler.errors import InputError

SMALL = Preset("tiny", iterations=2, info_iterations=2, rays=8, image_size=16, num_train=11, num_test=1)


def kills_its_worker_once(cell: Cell, preset: Preset, data: Path, output_dir: Path, threads: int) -> dict[str, Any]:
    mark = output_dir.parent / "killed"
    if cell.seed == 3 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.1)
    return {**vars(cell), "psnr": 30.0, "outcome": "learnt"}


@pytest.mark.slow
def test_a_killed_worker_of_a_cluster_costs_no_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "run_cell", kills_its_worker_once)
    todo = [Cell(1, "mic", "edge-nerf", seed) for seed in range(8)]
    for name in ("out", "w"):
        (tmp_path / name).mkdir()
    cluster: Any = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)  # pyright: ignore[reportArgumentType]
    with cluster:
        executor = running.executor_of(1, cluster.scheduler_address)
        result = running.run_cells(todo, SMALL, lambda _: tmp_path, tmp_path / "out", tmp_path / "w", executor, 1)
    assert (tmp_path / "w" / "killed").exists()
    assert [run["seed"] for run in result["runs"]] == list(range(8))
    assert result["errors"] == []


def test_an_address_where_nobody_answers_is_refused() -> None:
    with pytest.raises(InputError, match=r"--scheduler tcp://127\.0\.0\.1:9: no dask scheduler answers"):
        running.executor_of(1, "tcp://127.0.0.1:9")
