"""The trainings of the paper's tables and of ours: a table, a scene, a strategy and a seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

from edge_se_sampler.bench.paper.published import LABELS, REAL_SCENES, SCENES
from edge_se_sampler.bench.results import Run
from edge_se_sampler.bench.train import cached_scene, offcenter_copies, train_and_measure
from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.data.frames import LoadSettings
from edge_se_sampler.engine.config import MANAGER, MODEL, SAMPLER, MachineConfig, TrainerConfig, override
from edge_se_sampler.engine.files import write_image
from edge_se_sampler.methods import method_configs
from edge_se_sampler.sampling.edges import unit_float


@dataclass(frozen=True)
class Table:
    """What the trainings of a table have in common."""

    title: str
    method: Literal["nerf", "info-nerf"] = "nerf"
    placement: Literal["centered", "padded", "shifted"] = "centered"
    strategies: tuple[str, ...] = tuple(LABELS)
    steps: float = 1.0
    """Iterations, as a share of the settings'."""
    changes: dict[str, Any] = field(default_factory=dict)
    """What differs from the paper's NeRF with all views, as `override` takes it."""


# The share of the iterations that costs SE as much time as all of them cost Random. A late step of SE scores twice the
# rays without gradients: 5 units of work instead of 3; with InfoNeRF's rays of unseen poses, 8 instead of 6.
EQUAL_TIME = {"nerf": 1 / (0.1 + 0.9 * 5 / 3), "info-nerf": 1 / (0.1 + 0.9 * 8 / 6)}
RANDOM, LATE_SE = ("vanilla-nerf",), ("se-nerf", "precrop-se-nerf", "edge-se-nerf")
FEW_VIEWS = {"num_views": 10}
TORCH_WEIGHTS = {f"{MODEL}.initialization": "torch"}
REINIT_DEAD = {**TORCH_WEIGHTS, "reinit_dead": True}
SOFTPLUS = {f"{MODEL}.density_activation": "softplus"}

PAPER_TABLES: dict[int, Table] = {
    1: Table("NeRF, all views, centred"),
    2: Table("NeRF, all views, off centre", placement="shifted"),
    3: Table("InfoNeRF, 10 views, centred", "info-nerf", changes=FEW_VIEWS),
    4: Table("InfoNeRF, 10 views, off centre", "info-nerf", "shifted", changes=FEW_VIEWS),
}
TABLES: dict[int, Table] = {
    **PAPER_TABLES,
    5: Table("NeRF, 10 views, centred", changes=FEW_VIEWS),
    6: Table("NeRF, 10 views, off centre", placement="shifted", changes=FEW_VIEWS),
    7: Table("as 1, torch's initial weights", changes=TORCH_WEIGHTS),
    8: Table("as 2, torch's initial weights", placement="shifted", changes=TORCH_WEIGHTS),
    **{
        n + 8: replace(table, title=f"as {n}, in Random's time", strategies=LATE_SE, steps=EQUAL_TIME[table.method])
        for n, table in PAPER_TABLES.items()
    },
    13: Table("as 1, Laplacian edges", strategies=("edge-nerf",), changes={f"{SAMPLER}.edge_filter": "laplacian"}),
    14: Table("as 1, softplus density", strategies=RANDOM, changes=SOFTPLUS),
    15: Table("as 2, softplus density", "nerf", "shifted", RANDOM, changes=SOFTPLUS),
    16: Table("as 2, as small but centred", "nerf", "padded", ("vanilla-nerf", "precrop-nerf", "edge-nerf")),
    17: Table("as 7, dead networks reinitialised", strategies=RANDOM, changes=REINIT_DEAD),
    18: Table("as 8, dead networks reinitialised", "nerf", "shifted", RANDOM, changes=REINIT_DEAD),
}
"""The paper's four, and ours."""


@dataclass(frozen=True)
class Settings:
    """How large the experiment is: small enough for a CPU. The paper (section 4.1) trains 200,000 iterations, 50,000 of
    InfoNeRF, of 1024 rays."""

    size: Literal["paper", "small", "tiny"] = "tiny"
    iterations: int = 1000
    info_iterations: int = 600
    rays: int = 64
    samples: tuple[int, int] = (16, 16)
    """Coarse and importance samples of a ray."""
    image_size: int = 64
    """Rows and columns of the images."""
    num_train: int = 50
    num_test: int = 4


REAL_DOWNSCALE = 12
"""Of the real scenes' images, 800 pixels wide and high: about as large as `Settings.image_size`."""


@dataclass(frozen=True)
class Trial:
    """One training."""

    table: int
    scene: str
    strategy: str
    seed: int

    @property
    def name(self) -> str:
        """Of its run folder and its rendering."""
        return f"table-{self.table}-{self.scene}-{self.strategy}-{self.seed}"

    @property
    def downscale(self) -> int:
        """Every so many pixels of its scene's images, along both axes, become one."""
        return REAL_DOWNSCALE if self.scene in REAL_SCENES else 1


def runs_by_trial(runs: list[Run]) -> dict[Trial, Run]:
    return {Trial(run["table"], run["scene"], run["strategy"], run["seed"]): run for run in runs}


def list_trials(
    tables: Sequence[int], scenes: Sequence[str], strategies: Sequence[str], seeds: Sequence[int]
) -> list[Trial]:
    """All chosen trainings (no tables or strategies: all; no scenes: the synthetic ones): the paper's seed by seed,
    then ours, so that an unfinished experiment is a smaller one."""
    trials = [
        Trial(table, scene, strategy, seed)
        for seed, table, scene in product(seeds, tables or TABLES, scenes or SCENES)
        for strategy in TABLES[table].strategies
        if not strategies or strategy in strategies
    ]
    return sorted(trials, key=lambda trial: trial.table not in PAPER_TABLES)


def build_config(trial: Trial, settings: Settings, data: Path, output_dir: Path) -> TrainerConfig:
    """What a trial trains: every sample of every ray, no empty space skipped, as the paper does."""
    table, methods = TABLES[trial.table], method_configs()
    strategy = methods[trial.strategy]
    iterations = round(table.steps * (settings.info_iterations if table.method == "info-nerf" else settings.iterations))
    changes = {
        "data": data,
        "downscale": trial.downscale,
        "output_dir": output_dir,
        "experiment_name": trial.name,
        "max_num_iterations": iterations,
        "steps_per_save": iterations,
        "steps_per_eval_image": iterations,
        "machine": MachineConfig(seed=trial.seed, device_type="auto"),
        MANAGER: strategy.pipeline.datamanager,
        f"{MANAGER}.train_num_rays_per_batch": settings.rays,
        f"{MODEL}.size": settings.size,
        f"{MODEL}.num_coarse_samples": settings.samples[0],
        f"{MODEL}.num_importance_samples": settings.samples[1],
        **table.changes,
    }
    return override(methods["info-nerf"] if table.method == "info-nerf" else strategy, changes)


def run_trial(trial: Trial, settings: Settings, data: Path, workplace: Path) -> Run:
    """Train a trial and measure it. Its rendering of the first test view goes to workplace/paper/views, and the scene's
    first training and test view, where they are not there yet."""
    views = workplace / "paper" / "views"
    for split in ("train", "test"):
        path = views / f"{TABLES[trial.table].placement}-{trial.scene}-{split}.png"
        if not path.exists():
            views.mkdir(parents=True, exist_ok=True)
            write_image(path, unit_float(read_blender(data, split, LoadSettings(downscale=trial.downscale)).images[0]))
    return train_and_measure(build_config(trial, settings, data, workplace / "runs"), views / f"{trial.name}.png")


def placed_copy(table: int, folder: Path, workplace: Path) -> Path:
    """A real scene's folder as a table's trials see it: itself, or a copy, made where it is missing."""
    copies = {"padded": "centered", "shifted": "shifted"}
    copy = copies.get(TABLES[table].placement)
    return folder if copy is None else offcenter_copies(folder, workplace) / copy


def synthetic_scene(table: int, scene: str, settings: Settings, workplace: Path) -> Path:
    """The folder of a synthetic scene as a table's trials see it, rendered where it is missing."""
    counts = {"num_train": settings.num_train, "num_val": 1, "num_test": settings.num_test}
    return cached_scene(workplace, scene, size=settings.image_size, placement=TABLES[table].placement, **counts)
