"""What schedule "adaptive" is put to: does any seed fail under it, and is it as good as a well chosen fixed length.

arm   Random; Edge + SE with dead networks reinitialised, under the adaptive schedule or a fixed share of the iterations
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

from edge_se_sampler.bench.paper.published import SCENES
from edge_se_sampler.bench.paper.trials import PRESETS, config_of
from edge_se_sampler.bench.paper.trials import Cell as PaperCell
from edge_se_sampler.bench.train import trial
from edge_se_sampler.engine.config import TrainerConfig

Part = Literal["failures", "lengths"]
FRACTIONS = ("0.02", "0.05", "0.1", "0.2", "0.5")
CONFIGURATIONS = (1, 2, 5, 6)
"""The paper bench's tables of NeRF: centred or off centre, all views or ten."""
LENGTHS = (300, 1000, 3000, 10_000)
OF_LENGTHS = ((1, "drums"), (1, "bricks"), (2, "chair"), (2, "mic"))
"""Table and scene; two centred, two off centre."""


@dataclass(frozen=True)
class Scale:
    """How large the experiment is; the rest is the paper bench's cpu preset."""

    iterations: int = 500
    """Of the runs that may fail."""


@dataclass(frozen=True)
class Cell:
    """One training."""

    part: Part
    table: int
    scene: str
    iterations: int
    arm: str
    seed: int

    @property
    def name(self) -> str:
        """A name for its folder."""
        return "-".join(map(str, asdict(self).values()))


def failure_cells(scale: Scale, seeds: tuple[int, ...]) -> list[Cell]:
    """Random and auto, paired: 28 configurations, seed by seed."""
    every = product(seeds, CONFIGURATIONS, SCENES, ("random", "auto"))
    return [Cell("failures", table, scene, scale.iterations, arm, seed) for seed, table, scene, arm in every]


def choice_cells(length: int) -> list[Cell]:
    """Every fixed share of a planned length, on its seeds of choice."""
    every = product(choice_seeds(length), OF_LENGTHS, FRACTIONS)
    return [Cell("lengths", table, scene, length, share, seed) for seed, (table, scene), share in every]


def length_cells(length: int, share: str, seeds: tuple[int, ...]) -> list[Cell]:
    """Auto and a fixed share of a planned length, paired."""
    every = product(seeds, OF_LENGTHS, (share, "auto"))
    return [Cell("lengths", table, scene, length, arm, seed) for seed, (table, scene), arm in every]


def choice_seeds(length: int) -> tuple[int, ...]:
    """The fixed share is chosen on these: two, but one where a training is long."""
    return (100, 101) if length < LENGTHS[-1] else (100,)


def settings_of(cell: Cell, data: Path, output_dir: Path) -> TrainerConfig:
    """What a cell trains."""
    strategy = "vanilla-nerf" if cell.arm == "random" else "edge-se-nerf"
    preset = replace(PRESETS["cpu"], iterations=cell.iterations)
    config = config_of(PaperCell(cell.table, cell.scene, strategy, cell.seed), preset, data, output_dir)
    config = replace(config, experiment_name=cell.name)
    if cell.arm == "random":
        return config
    manager = config.pipeline.datamanager
    changes: dict[str, Any] = {"schedule": "adaptive"} if cell.arm == "auto" else {"early_fraction": float(cell.arm)}
    manager = replace(manager, pixel_sampler=replace(manager.pixel_sampler, **changes))
    return replace(config, pipeline=replace(config.pipeline, datamanager=manager), reinit_dead=True)


def run_cell(cell: Cell, data: Path, output_dir: Path) -> dict[str, Any]:
    """Train a cell and measure it; runs in a process of its own."""
    measured = trial(settings_of(cell, data, output_dir))
    for bulky in ("loss", "loss_every", "view"):
        del measured[bulky]
    return asdict(cell) | measured
