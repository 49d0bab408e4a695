"""One cell of the paper's tables: a method, a placement, a scene, a strategy and a seed, trained and measured."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

from edge_se_sampler.bench.paper.published import SCENES, STRATEGIES
from edge_se_sampler.bench.train import trial
from edge_se_sampler.engine.config import MachineConfig, TrainerConfig
from edge_se_sampler.methods import method_configs

Method = Literal["nerf", "info-nerf"]
Placement = Literal["centered", "padded", "shifted"]
FEW_VIEWS = 10
"""InfoNeRF trains on so many."""
LATE_SE = ("se-nerf", "precrop-se-nerf", "edge-se-nerf")


@dataclass(frozen=True)
class Table:
    """What the cells of a table have in common."""

    title: str
    method: Method = "nerf"
    placement: Placement = "centered"
    strategies: tuple[str, ...] = STRATEGIES
    few_views: bool = False
    steps: float = 1.0
    """Iterations, as a share of the preset's."""
    model: dict[str, Any] = field(default_factory=dict)
    """Settings of the model that differ from the paper's."""
    sampler: dict[str, Any] = field(default_factory=dict)
    """Settings of the sampler that differ."""
    reinit_dead: bool = False
    """Dead networks begin anew."""


# A step of SE scores twice the rays without gradients: 5 units of work for 3, and with InfoNeRF's as many unseen rays
# 8 for 6. With a tenth of plain steps, so many steps cost what all steps of Random do.
RANDOMS_TIME = {"nerf": 1 / (0.1 + 0.9 * 5 / 3), "info-nerf": 1 / (0.1 + 0.9 * 8 / 6)}
PAPERS: dict[int, Table] = {
    1: Table("NeRF, all views, centred"),
    2: Table("NeRF, all views, off centre", placement="shifted"),
    3: Table("InfoNeRF, 10 views, centred", "info-nerf", few_views=True),
    4: Table("InfoNeRF, 10 views, off centre", "info-nerf", "shifted", few_views=True),
}
TABLES: dict[int, Table] = PAPERS | {
    5: Table("NeRF, 10 views, centred", few_views=True),
    6: Table("NeRF, 10 views, off centre", placement="shifted", few_views=True),
    7: Table("NeRF, all views, centred, torch's initial weights", model={"initialization": "torch"}),
    8: Table("as 7, off centre", placement="shifted", model={"initialization": "torch"}),
    **{
        number + 8: replace(
            table, title=f"as {number}, in Random's time", strategies=LATE_SE, steps=RANDOMS_TIME[table.method]
        )
        for number, table in PAPERS.items()
    },
    13: Table("as 1, Laplacian edges", strategies=("edge-nerf",), sampler={"edge_filter": "laplacian"}),
    14: Table("as 1, softplus density", strategies=("vanilla-nerf",), model={"density_activation": "softplus"}),
    15: Table("as 2, softplus density", "nerf", "shifted", ("vanilla-nerf",), model={"density_activation": "softplus"}),
    16: Table("as 2, but in the middle", "nerf", "padded", ("vanilla-nerf", "precrop-nerf", "edge-nerf")),
    17: Table(
        "as 7, dead networks begin anew",
        strategies=("vanilla-nerf",),
        model={"initialization": "torch"},
        reinit_dead=True,
    ),
    18: Table(
        "as 8, dead networks begin anew",
        "nerf",
        "shifted",
        ("vanilla-nerf",),
        model={"initialization": "torch"},
        reinit_dead=True,
    ),
}
"""The paper's four, and ours."""


@dataclass(frozen=True)
class Preset:
    """How large the experiment is."""

    size: Literal["paper", "small", "tiny"]
    iterations: int
    info_iterations: int
    rays: int
    samples: tuple[int, int] | None = None
    """Coarse and importance samples of a ray; None: the size's."""
    image_size: int | None = None
    """Of synthetic scenes; None: the data is given."""
    num_train: int = 50
    num_test: int = 4


# cpu: chosen on seed 100. Table 1 with Edge, chair / drums: 400 steps of 128 rays, 24 + 16 samples 20.96 / 20.07 dB
# in 7.9 s; 800 of 64 rays 23.38 / 21.52 in 9.2 s; 1000 of 64 rays, 16 + 16 samples 23.55 / 22.25 in 9.3 s; 2000 of 32
# rays, 16 + 16 samples drums 22.79 in 12.9 s. In all of them Random loses mic, and Precrop drums, off centre.
PRESETS = {
    "cpu": Preset("tiny", iterations=1000, info_iterations=600, rays=64, samples=(16, 16), image_size=64),
    # section 4.1 of the paper: 200,000 iterations, 50,000 for InfoNeRF, 1024 rays
    "paper": Preset("paper", iterations=200_000, info_iterations=50_000, rays=1024),
}


@dataclass(frozen=True)
class Cell:
    """Where a cell stands."""

    table: int
    scene: str
    strategy: str
    seed: int

    @property
    def name(self) -> str:
        """A name for its folder."""
        return f"table-{self.table}-{self.scene}-{self.strategy}-{self.seed}"


def cells(
    tables: tuple[int, ...], scenes: tuple[str, ...], strategies: tuple[str, ...], seeds: tuple[int, ...]
) -> list[Cell]:
    """All cells asked for: the paper's seed by seed, then ours, so that an unfinished experiment is a smaller one."""
    groups = (tuple(PAPERS), tuple(number for number in TABLES if number not in PAPERS))
    return [
        Cell(table, scene, strategy, seed)
        for group in groups
        for seed, table, scene in product(seeds, group, scenes or SCENES)
        if not tables or table in tables
        for strategy in TABLES[table].strategies
        if not strategies or strategy in strategies
    ]


def iterations_of(cell: Cell, preset: Preset) -> int:
    """The planned ones."""
    table = TABLES[cell.table]
    return round(table.steps * (preset.info_iterations if table.method == "info-nerf" else preset.iterations))


def config_of(cell: Cell, preset: Preset, data: Path, output_dir: Path) -> TrainerConfig:
    """What a cell trains: dense and faithful, nothing culled."""
    table = TABLES[cell.table]
    info = table.method == "info-nerf"
    methods = method_configs()
    config = methods["info-nerf" if info else cell.strategy]
    manager = methods[cell.strategy].pipeline.datamanager
    sampler = replace(manager.pixel_sampler, **table.sampler)
    manager = replace(manager, train_num_rays_per_batch=preset.rays, pixel_sampler=sampler)
    model = config.pipeline.model
    if preset.samples is not None:
        coarse, importance = preset.samples
        model = replace(model, num_coarse_samples=coarse, num_importance_samples=importance)
    model = replace(model, size=preset.size, **table.model)
    iterations = iterations_of(cell, preset)
    return replace(
        config,
        data=data,
        output_dir=output_dir,
        experiment_name=cell.name,
        num_views=FEW_VIEWS if table.few_views else None,
        max_num_iterations=iterations,
        steps_per_save=iterations,
        steps_per_eval_image=iterations,
        steps_per_log=max(1, iterations // 50),
        reinit_dead=table.reinit_dead,
        machine=MachineConfig(seed=cell.seed, device_type="auto"),
        pipeline=replace(config.pipeline, datamanager=manager, model=model),
    )


def run_cell(cell: Cell, preset: Preset, data: Path, output_dir: Path) -> dict[str, Any]:
    """Train a cell and measure it; runs in a process of its own.

    Returns:
        its place, and what `trial` measures.
    """
    table = TABLES[cell.table]
    measured = trial(config_of(cell, preset, data, output_dir))
    return {**asdict(cell), "method": table.method, "placement": table.placement, **measured}
