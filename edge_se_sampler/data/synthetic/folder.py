"""Synthetic scenes as folders in the layout of NeRF's Blender scenes, each written whole or not at all."""

from __future__ import annotations

import json
import math
import os
import signal
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import imageio.v3 as imageio

from edge_se_sampler.data.new_folder import staged_folders
from edge_se_sampler.data.synthetic.cameras import Camera, Framing, Placement, Split, framing, poses
from edge_se_sampler.data.synthetic.catalogue import ANALOG_OF, SCENE_NAMES, check_name, synthetic_scene
from edge_se_sampler.data.synthetic.render import render
from edge_se_sampler.errors import InputError
from edge_se_sampler.interrupts import interrupts_blocked, interrupts_delayed

MAX_VIEWS = 10**6
"""Of a split."""


@dataclass(frozen=True)
class _View:
    scene: str
    file: str  # inside the scene's folder, no suffix: train/r_0
    camera: Camera
    may_clip: bool


def make_scenes(
    out: Path,
    names: Sequence[str],
    *,
    size: int = 100,
    num_train: int = 50,
    num_val: int = 5,
    num_test: int = 10,
    placement: Placement = "centered",
    offset: tuple[float, float] = (0.2, 0.15),
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Path]:
    """Renders scenes into out/<name>, folders that any loader of NeRF's Blender scenes reads, shifted ones only if it
    heeds `cx` and `cy`; returns their paths.

    A picture is size x size pixels, RGBA, 8 bits, straight alpha; pixels are the same on every machine, and view i of
    a split does not depend on how many views the split has. Each json also says which of NeRF's scenes it is the
    `analog_of`. All folders appear together at the end: an error or Ctrl-C leaves nothing behind. More than a few views
    render in fresh processes: a script that calls this needs the usual `if __name__ == "__main__":` guard.

    Args:
        placement: where the object is seen, see `framing`; for "shifted" the json states `cx` and `cy` (pixels).
        offset: of the object from the middle: right, down, as fractions of `size`.
        seed: 0 to 2**31 - 1; draws the cameras of train and val. Those of test are fixed.

    Raises:
        InputError: an unknown or repeated name, a number out of range, an offset that leaves the object fewer than 8
            pixels, an `out` that cannot be written, an out/<name> that is there and not empty, or an object that
            reaches the edge of a rotated camera's image.
    """
    counts: dict[Split, int] = {"train": num_train, "val": num_val, "test": num_test}
    if not names:
        raise InputError(f"names is empty: give at least one of {', '.join(SCENE_NAMES)}")
    for name in names:
        check_name(name)
    if len(set(names)) < len(names):
        raise InputError(f"names has a scene twice ({', '.join(names)}): give each once")
    for split, count in counts.items():
        if not (minimum := int(split == "train")) <= count <= MAX_VIEWS:
            raise InputError(f"num_{split} is {count}: give at least {minimum}, at most {MAX_VIEWS}")
    if not 0 <= seed < 2**31:
        raise InputError(f"seed is {seed}: give a number from 0 to {2**31 - 1}")
    frame = framing(size, placement, offset)
    targets = [Path(out) / name for name in names]
    cameras: dict[Split, list[Camera]] = {
        split: [frame.camera(pose) for pose in poses(split, count, seed)] for split, count in counts.items()
    }
    with staged_folders(Path(out), targets) as workspace:
        views = [view for name in names for view in _lay_out(workspace, name, frame, cameras)]
        _render_all(views, workspace, progress)
    return targets


def _lay_out(workspace: Path, name: str, frame: Framing, cameras: Mapping[Split, Sequence[Camera]]) -> list[_View]:
    """Writes the json files and folders of a scene; returns the views to render."""
    views = []
    for split, split_cameras in cameras.items():
        if not split_cameras:
            continue
        (workspace / name / split).mkdir(parents=True)
        files = [f"{split}/r_{index}" for index in range(len(split_cameras))]
        origin = {"analog_of": ANALOG_OF[name], "generated_by": "edge_se_sampler"}
        frames = [
            {"file_path": f"./{file}", "rotation": 0.0, "transform_matrix": camera.to_world.tolist()}
            for file, camera in zip(files, split_cameras, strict=True)
        ]
        document = frame.intrinsics | origin | {"frames": frames}
        (workspace / name / f"transforms_{split}.json").write_text(json.dumps(document, indent=4), encoding="utf-8")
        may_clip = frame.placement == "rotated"  # otherwise the ball that holds the scene is in view
        views += [_View(name, file, camera, may_clip) for file, camera in zip(files, split_cameras, strict=True)]
    return views


def _render_all(views: Sequence[_View], workspace: Path, progress: Callable[[int, int], None]) -> None:
    """Renders every view into its file, in this process if they are few, else in as many as there are CPUs."""
    # starting a process takes as long as rendering a few views; Windows waits for no more than 61
    processes = min(os.cpu_count() or 1, math.ceil(len(views) / 5), 61)
    with ExitStack() as stack:
        pictures = map(_render_png, views)
        if processes > 1:
            with interrupts_delayed():
                # a pool's first semaphore starts multiprocessing's tracker, which unblocks the signal: not blocked yet
                pool = ProcessPoolExecutor(
                    processes, get_context("spawn"), signal.signal, (signal.SIGINT, signal.SIG_IGN)
                )
                stack.callback(pool.shutdown, cancel_futures=True)
                with interrupts_blocked():
                    pictures = pool.map(_render_png, views)
        try:
            for done, (view, png) in enumerate(zip(views, pictures, strict=True), start=1):
                (workspace / view.scene / f"{view.file}.png").write_bytes(png)
                progress(done, len(views))
        except (BrokenExecutor, MemoryError) as problem:
            killed = "a process that rendered was killed, as where memory is too little"
            raise InputError(f"{killed}: give a smaller --size") from problem


def _render_png(view: _View) -> bytes:
    picture = render(synthetic_scene(view.scene), view.camera)
    border = (picture[0], picture[-1], picture[:, 0], picture[:, -1])
    if view.may_clip and any(pixels[:, 3].any() for pixels in border):
        problem = f"offset rotates {view.scene} to the edge of the image in view {view.file}"
        raise InputError(f"{problem}: give one nearer to zero")
    return imageio.imwrite("<bytes>", picture, extension=".png")
