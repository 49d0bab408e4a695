"""Synthetic scenes of the experiments, rendered once into a folder and found there afterwards."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.progress import Progress


def cached_scene(workplace: Path, name: str, **options: Any) -> Path:
    """The Blender folder of one of the seven synthetic scenes in workplace/scenes, rendered if it is not there.

    Args:
        options: of `make_scenes`: size, placement, num_train, ...; scenes of other options lie in other folders.

    Raises:
        InputError: an unknown scene or option value, or a folder that cannot be written.
    """
    words = [f"{key}-{value}" for key, value in sorted(options.items())]
    folder = workplace / "scenes" / ("_".join(words) or "default")
    if not (folder / name).exists():
        with Progress(0, f"rendering {name}") as progress:
            make_scenes(folder, [name], progress=progress.update, **options)
    return folder / name
