"""The scenes that cells are trained on: made ones, or a NeRF-synthetic folder and its off-centre counterparts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.paper.published import SCENES
from edge_se_sampler.bench.paper.trials import TABLES, Cell, Placement, Preset
from edge_se_sampler.data.blender import has_split
from edge_se_sampler.data.offcenter import offcenter
from edge_se_sampler.data.synthetic.catalogue import ANALOG_OF
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.errors import InputError

DataOf = Callable[[Any], Path]
"""A cell, of this bench or any that has a table and a scene -> its Blender folder."""


def synthetic_scenes(preset: Preset, cells: Sequence[Any], workplace: Path) -> DataOf:
    """Make what the cells need and workplace/scenes does not have; where each cell's lies."""
    placements: list[Placement] = sorted({TABLES[cell.table].placement for cell in cells})
    for placement in placements:
        folder = workplace / "scenes" / placement
        wanted = {cell.scene for cell in cells if TABLES[cell.table].placement == placement}
        missing = sorted(name for name in wanted if not (folder / name).exists())
        if missing:
            progress = Progress(len(missing) * (preset.num_train + 1 + preset.num_test), f"making {placement} scenes")
            make_scenes(
                folder, missing, size=preset.image_size or 800, num_train=preset.num_train, num_val=1,
                num_test=preset.num_test, placement=placement, progress=lambda done, _, bar=progress: bar.update(done),
            )  # fmt: skip
            progress.close()
    return lambda cell: workplace / "scenes" / TABLES[cell.table].placement / cell.scene


def check_real(data: Path, cells: list[Cell]) -> None:
    """Raises InputError where a scene that the cells need is not there."""
    for scene in sorted({cell.scene for cell in cells}, key=SCENES.index):
        for split in ("train", "test"):
            if not has_split(data / ANALOG_OF[scene], split):
                raise InputError(
                    f"--data {data}: {ANALOG_OF[scene]}/transforms_{split}.json is missing; a NeRF-synthetic folder "
                    "has one folder a scene (chair, drums, ficus, hotdog, lego, materials, mic); fewer: name --scenes"
                )


def real_scenes(data: Path, cells: list[Cell], workplace: Path) -> DataOf:
    """A NeRF-synthetic folder's scenes; the padded and the shifted ones of `offcenter`, kept in workplace/scenes.

    Raises:
        InputError: bad data.
    """
    moved = workplace / "scenes" / "offcenter"
    for scene in sorted({cell.scene for cell in cells if TABLES[cell.table].placement != "centered"}):
        if not (moved / scene).exists():
            progress = Progress(0, f"moving {scene} off the centre")

            def show(done: int, total: int, bar: Progress = progress) -> None:
                bar.total = total
                bar.update(done)

            offcenter(data / ANALOG_OF[scene], moved / scene, progress=show)
            progress.close()
    places = {"padded": "centered", "shifted": "shifted"}

    def data_of(cell: Cell) -> Path:
        placement = TABLES[cell.table].placement
        if placement == "centered":
            return data / ANALOG_OF[cell.scene]
        return moved / cell.scene / places[placement]

    return data_of
