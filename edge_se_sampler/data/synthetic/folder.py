"""Synthetic scenes as folders in the layout of NeRF's Blender scenes, each written whole or not at all."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing.synchronize import Event
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
from numpy.typing import NDArray

from edge_se_sampler.data.new_folder import appearing, check_free
from edge_se_sampler.data.synthetic.cameras import Camera, Framing, Placement, Split, framing, poses
from edge_se_sampler.data.synthetic.catalogue import ANALOG_OF, SCENE_NAMES, check_name, synthetic_scene
from edge_se_sampler.data.synthetic.render import render
from edge_se_sampler.errors import InputError

_VIEWS_PER_TASK = 5
_MOST_PROCESSES = 61  # Windows waits for no more

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class _View:
    """One picture to be made."""

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
    progress: Progress | None = None,
) -> list[Path]:
    """Renders scenes into out/<name>, folders that any loader of NeRF's Blender scenes reads; returns their paths.

    `names` are from SCENE_NAMES. A picture is size x size pixels, RGBA, 8 bits, straight alpha; pixels are the same
    on every machine, and view i of a split does not depend on how many views the split has. `seed` (0 to 2**31 - 1)
    draws the cameras of train and val; those of test are fixed. Each json also says whose `analog_of` a scene is.

    `placement` puts the object `offset` (right, down; shares of `size`) from the middle: "centered" ignores the
    offset; "shifted" shows the centred picture of a smaller frame, pasted whole pixels away, and says so by `cx`
    and `cy` (pixels) in the json; "padded" pastes that picture in the middle, so that only the place differs;
    "rotated" turns the cameras until the world's origin is at the same pixel, which every loader reads, but
    perspective stretches the object.

    `progress(done, total)` counts views. More than a few views render in os.cpu_count() fresh processes, so a script
    that calls this needs the usual `if __name__ == "__main__":` guard.

    All folders appear together at the end: an error or Ctrl-C leaves nothing behind.

    Raises InputError, before rendering anything, for an unknown or repeated name, a number out of range, an offset
    that leaves the object fewer than 8 pixels, an `out` that cannot be written, or an out/<name> that is there and
    not empty; and while rendering, if a turned camera has the object reach out of the image.
    """
    counts: dict[Split, int] = {"train": num_train, "val": num_val, "test": num_test}
    _check_names(names)
    _check_numbers(counts, seed)
    frame = framing(size, placement, offset)
    targets = [Path(out) / name for name in names]
    check_free(Path(out), targets)

    cameras: dict[Split, list[Camera]] = {
        split: [frame.camera(pose) for pose in poses(split, count, seed)] for split, count in counts.items()
    }
    with appearing(Path(out), targets) as workspace:
        views = [view for name in names for view in _lay_out(workspace, name, frame, cameras)]
        _render_all(views, workspace, progress or (lambda done, total: None))
    return targets


def _check_names(names: Sequence[str]) -> None:
    if not names:
        raise InputError(f"names is empty: give at least one of {', '.join(SCENE_NAMES)}")
    for name in names:
        check_name(name)
    if len(set(names)) < len(names):
        raise InputError(f"names has a scene twice ({', '.join(names)}): give each once")


def _check_numbers(counts: Mapping[Split, int], seed: int) -> None:
    for split, count in counts.items():
        least = 1 if split == "train" else 0
        if count < least:
            raise InputError(f"num_{split} is {count}: give at least {least}")
    if not 0 <= seed < 2**31:
        raise InputError(f"seed is {seed}: give a number from 0 to {2**31 - 1}")


def _lay_out(workspace: Path, name: str, frame: Framing, cameras: Mapping[Split, Sequence[Camera]]) -> list[_View]:
    """Writes everything of a scene but the pictures; returns the views to fill in."""
    views = []
    for split, of_split in cameras.items():
        if not of_split:
            continue  # a split without frames is refused when it is read
        (workspace / name / split).mkdir(parents=True)
        files = [f"{split}/r_{index}" for index in range(len(of_split))]
        document = {
            **frame.intrinsics,
            "analog_of": ANALOG_OF[name],
            "made_by": "edge_se_sampler",
            "frames": [
                {"file_path": f"./{file}", "rotation": 0.0, "transform_matrix": camera.to_world.tolist()}
                for file, camera in zip(files, of_split, strict=True)
            ],
        }
        (workspace / name / f"transforms_{split}.json").write_text(json.dumps(document, indent=4), encoding="utf-8")
        may_clip = frame.placement == "rotated"  # otherwise the ball that holds the scene is in view
        views += [_View(name, file, camera, may_clip) for file, camera in zip(files, of_split, strict=True)]
    return views


def _render_all(views: Sequence[_View], workspace: Path, progress: Progress) -> None:
    """Renders every view into its file, in this process if they are few, else in as many as there are CPUs."""
    tasks = [views[start : start + _VIEWS_PER_TASK] for start in range(0, len(views), _VIEWS_PER_TASK)]
    processes = min(os.cpu_count() or 1, len(tasks), _MOST_PROCESSES)
    if processes == 1:
        for done, view in enumerate(views, start=1):
            _write(workspace, view, _picture(view))
            progress(done, len(views))
        return

    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    pool = ProcessPoolExecutor(processes, mp_context=context, initializer=_start_worker, initargs=(stop,))
    try:
        with _interrupts_held():
            task_of = {pool.submit(_pictures, task): task for task in tasks}
        done = 0
        for future in as_completed(task_of):
            for view, png in zip(task_of[future], future.result(), strict=True):
                _write(workspace, view, png)
            done += len(task_of[future])
            progress(done, len(views))
    except BaseException:
        stop.set()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _write(workspace: Path, view: _View, png: bytes) -> None:
    (workspace / view.scene / f"{view.file}.png").write_bytes(png)


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Ctrl-C is heard only afterwards, and never by processes started meanwhile: stopping is their parent's call."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows: `_start_worker` alone must do
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_stop: Event | None = None  # in a worker: set when its parent gives up


def _start_worker(stop: Event) -> None:
    global _stop
    _stop = stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _pictures(views: Sequence[_View]) -> list[bytes]:
    """In a worker: the PNG files of some views; fewer of them once the parent has given up."""
    pictures = []
    for view in views:
        if _stop is not None and _stop.is_set():
            break
        pictures.append(_picture(view))
    return pictures


def _picture(view: _View) -> bytes:
    """The PNG file of one view."""
    scene = synthetic_scene(view.scene)
    if view.may_clip:
        picture = _uncropped(render(scene, _one_pixel_wider(view.camera)), view)
    else:
        picture = render(scene, view.camera)
    png = imageio.imwrite("<bytes>", picture, extension=".png")
    assert png is not None
    return png


def _one_pixel_wider(camera: Camera) -> Camera:
    """The same view with one pixel more on each side; the pixels they share are the same."""
    x, y = camera.principal
    return replace(camera, principal=(x + 1, y + 1), width=camera.width + 2, height=camera.height + 2)


def _uncropped(wider: NDArray[np.uint8], view: _View) -> NDArray[np.uint8]:
    """The picture without its outermost pixels, once it is sure that they are empty."""
    picture = wider[1:-1, 1:-1]
    if np.count_nonzero(wider[..., 3]) > np.count_nonzero(picture[..., 3]):
        raise InputError(f"offset turns {view.scene} out of the image in view {view.file}: give one nearer to zero")
    return picture
