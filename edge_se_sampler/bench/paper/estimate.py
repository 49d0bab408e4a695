"""What an experiment will cost on this machine, before it is begun."""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
import torch

from edge_se_sampler.bench.paper.trials import LATE_SE, RANDOMS_TIME, TABLES, Cell, Preset, config_of, iterations_of
from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.engine.trainer import choose_device
from edge_se_sampler.models.config import apply_preset


def plan_of(cells: list[Cell], done: int, preset: Preset, workers: int) -> str:
    """The cells table by table, with the hours that training them takes, from steps timed now.

    Args:
        done: how many of them earlier calls have finished.
    """
    seconds = {kind: _step_seconds(kind, preset) for kind in sorted({_kind(cell) for cell in cells})}
    lines = []
    total = 0.0
    for number in sorted({cell.table for cell in cells}):
        mine = [cell for cell in cells if cell.table == number]
        cost = sum(iterations_of(cell, preset) * seconds[_kind(cell)] * _price(cell) for cell in mine)
        total += cost
        lines.append(
            f"table {number:2}: {len(mine):4} cells of {iterations_of(mine[0], preset):,} steps, "
            f"{_duration(cost / workers):>12}  {TABLES[number].title}"
        )
    lines.append(
        f"{len(cells)} cells, {done} done before; all of them train for about {_duration(total / workers)} "
        f"with {workers} at once, scenes and evaluation not counted"
    )
    return "\n".join(lines)


def _kind(cell: Cell) -> str:
    return TABLES[cell.table].method


def _price(cell: Cell) -> float:
    """Of a step, against Random's."""
    return 1 / RANDOMS_TIME[_kind(cell)] if cell.strategy in LATE_SE else 1.0


def _step_seconds(method: str, preset: Preset) -> float:
    """Seconds of one of Random's steps: forward and backward of some rays, as many as a step has."""
    table = next(number for number, table in TABLES.items() if table.method == method)
    config = config_of(Cell(table, "chair", "vanilla-nerf", 0), preset, Path(), Path())
    device = choose_device("auto")
    model_config = apply_preset(config.pipeline.model, preset.size, preset.rays)
    model = model_config.setup(rng=np.random.default_rng(0)).to(device)
    tried = min(preset.rays, 64)
    rays = RayBundle(
        torch.zeros((tried, 3), device=device),
        torch.nn.functional.normalize(torch.ones((tried, 3), device=device), dim=1),
        torch.zeros((tried, 1), dtype=torch.int64, device=device),
        {"directions_norm": torch.ones((tried, 1), device=device)},
    )
    times, threads = [], torch.get_num_threads()
    torch.set_num_threads(1)  # as a cell has
    for _ in range(5):
        began = time.perf_counter()
        loss, _ = model.loss(model(rays), {"image": torch.zeros((tried, 3), device=device)})
        loss.mean().backward()
        times.append(time.perf_counter() - began)
    torch.set_num_threads(threads)
    return min(times) * preset.rays / tried * (2 if method == "info-nerf" else 1)


def _duration(seconds: float) -> str:
    for unit, length in (("years", 365 * 86400), ("days", 86400), ("hours", 3600), ("minutes", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{math.ceil(seconds)} seconds"
