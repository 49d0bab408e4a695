"""The scenes of the trials: synthetic ones, or a NeRF-synthetic folder and its off-centre counterparts."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from edge_se_sampler.data.blender import has_split, read_blender
from edge_se_sampler.data.offcenter import offcenter
from edge_se_sampler.data.synthetic import ANALOG_OF
from edge_se_sampler.engine.files import write_image
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.errors import InputError
from edge_se_sampler.sampling.edges import unit_float


def check_data(data: Path, scenes: Iterable[str]) -> None:
    """Refuse a NeRF-synthetic folder that lacks a scene.

    Raises:
        InputError: a scene's training or test split is not there.
    """
    for scene in scenes:
        for split in ("train", "test"):
            if not has_split(data / ANALOG_OF[scene], split):
                raise InputError(
                    f"--data {data}: {ANALOG_OF[scene]}/transforms_{split}.json is missing; a NeRF-synthetic folder "
                    "has one folder a scene (chair, drums, ficus, hotdog, lego, materials, mic); fewer: name --scenes"
                )


def real_scene(data: Path, scene: str, placement: str, workplace: Path) -> Path:
    """A scene of a NeRF-synthetic folder; padded or shifted, it is written to workplace/scenes/offcenter at first.

    Raises:
        InputError: bad data.
    """
    if placement == "centered":
        return data / ANALOG_OF[scene]
    counterparts = workplace / "scenes" / "offcenter" / scene
    if not counterparts.exists():
        with Progress(0, f"moving {scene} off the centre") as progress:
            offcenter(data / ANALOG_OF[scene], counterparts, progress=progress.update)
    return counterparts / {"padded": "centered", "shifted": "shifted"}[placement]


def save_examples(data: Path, views: Path, name: str) -> None:
    """Write a scene's first training and test view to views/NAME-{train,test}.png, where they are not there yet."""
    for split in ("train", "test"):
        path = views / f"{name}-{split}.png"
        if not path.exists():
            views.mkdir(parents=True, exist_ok=True)
            write_image(path, unit_float(read_blender(data, split).images[0]))
