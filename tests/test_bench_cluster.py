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

from edge_se_sampler.bench import experiment as running
from edge_se_sampler.bench.paper.trials import PRESETS, Cell
from edge_se_sampler.errors import InputError


def kills_its_worker_once(cell: Cell, place: Path) -> dict[str, Any]:
    mark = place / "killed"
    if cell.seed == 3 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.1)
    return {**vars(cell), "psnr": 30.0, "outcome": "learnt"}


@pytest.mark.slow
def test_a_killed_worker_of_a_cluster_costs_no_cell(tmp_path: Path) -> None:
    todo = [Cell(1, "mic", "edge-nerf", seed) for seed in range(8)]
    result = running.begun(tmp_path / "result.json", PRESETS["cpu"])
    cluster: Any = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)  # pyright: ignore[reportArgumentType]
    with cluster:
        executor = running.executor_of(1, cluster.scheduler_address)
        path = tmp_path / "result.json"
        running.run_cells(todo, result, path, executor, kills_its_worker_once, lambda _: (tmp_path,))
    assert (tmp_path / "killed").exists()
    assert [run["seed"] for run in result["runs"]] == list(range(8))
    assert result["errors"] == []


def test_an_address_where_nobody_answers_is_refused() -> None:
    with pytest.raises(InputError, match=r"--scheduler tcp://127\.0\.0\.1:9: no dask scheduler answers"):
        running.executor_of(1, "tcp://127.0.0.1:9")
