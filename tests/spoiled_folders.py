"""Good runs, captures and results, each spoiled at random for a case and mended again."""

from __future__ import annotations

import contextlib
import io
import json
import random
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import torch
from capture_folder import HEIGHT, NAMES, WIDTH, bounds, colmap_files, picture, poses, transforms
from changes import change_bytes, change_value
from strangers import memory_bound, replace_payload

from edge_se_sampler.engine.checkpoint import latest_checkpoint
from edge_se_sampler.engine.run_folder import RunFolder, config_digest
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import method_configs

FORMATS = "blender", "transforms", "colmap", "text", "llff"
CONFIGS = Path(__file__).parent.parent / "configs"


def camera_path() -> dict[str, Any]:
    """Two cameras of nerfstudio's viewer, at different places."""
    cameras = [{"camera_to_world": pose.ravel().tolist(), "fov": 60.0, "aspect": 1.5} for pose in poses()[:2]]
    return {"camera_type": "perspective", "render_height": 4, "render_width": 6, "fps": 24, "camera_path": cameras}


def dump(value: Any) -> bytes:
    return json.dumps(value).encode()


class Folders:
    """Good runs and captures, and what a case reads: each is spoiled in a folder of its own, and mended again."""

    def __init__(self, folder: Path, runs: dict[str, Path]) -> None:
        self.folder = folder
        self.runs = [Path(shutil.copytree(run, folder / "runs" / name)) for name, run in runs.items()]
        shutil.copytree(next(iter(runs.values())).parents[3] / "data" / "mic", folder / "blender")
        for name in FORMATS[1:]:
            self.write_images(folder / name / "images")
        (folder / "transforms" / "transforms.json").write_bytes(dump(transforms()))
        for text, name in ((False, "colmap"), (True, "text")):
            (folder / name / "sparse").mkdir()
            for file, data in colmap_files(text=text).items():
                (folder / name / "sparse" / file).write_bytes(data)
        np.save(folder / "llff" / "poses_bounds.npy", bounds())
        (folder / "paths").mkdir()
        (folder / "paths" / "camera_path.json").write_bytes(dump(camera_path()))
        (folder / "paths" / "dataparser_transforms.json").write_bytes(
            dump({"transform": poses()[0, :3].tolist(), "scale": 0.25})
        )
        self.results = []
        for name in ("lean-ten-seeds", "schedule", "stability", "real", "paper", "micro", "nerfstudio"):
            shutil.copytree(CONFIGS / name, folder / "results" / name)
            self.results += (folder / "results" / name).rglob("*.json")

    def write_images(self, folder: Path) -> None:
        """Squares in front of a white wall."""
        folder.mkdir(parents=True)
        for i, name in enumerate(NAMES):
            image = np.full((HEIGHT, WIDTH, 3), 255, dtype=np.uint8)
            image[9:27, 12:36] = picture(i)[9:27, 12:36]
            iio.imwrite(folder / name, image)

    def config(self, rng: random.Random, use: Callable[[Path], object]) -> None:
        """Settings of a run."""
        run = rng.choice(self.runs)
        path = run / "config.json"
        with kept(path) as good:
            value = json.loads(good)
            del value["checksum"]
            change_value(value, rng)
            path.write_bytes(dump(value) if rng.random() < 0.8 else change_bytes(good, rng))
            self.sign(run)
            use(run)

    def sign(self, run: Path) -> None:
        """Make the checkpoint one of the settings, if these are any."""
        with contextlib.suppress(InputError):
            digest = config_digest(RunFolder(run).config(method_configs()))
            self.write_state(run, self.state(run) | {"config_digest": digest})

    def state(self, run: Path) -> dict[str, Any]:
        content = latest_checkpoint(run / "checkpoints").read_bytes()
        return torch.load(io.BytesIO(content.partition(b"\n")[2]), weights_only=True)

    def write_state(self, run: Path, state: dict[str, Any]) -> None:
        payload = io.BytesIO()
        torch.save(state, payload)
        replace_payload(run, payload.getvalue())

    def checkpoint(self, rng: random.Random, use: Callable[[Path], object]) -> None:
        """What a checkpoint holds, its checksum right."""
        run = rng.choice(self.runs)
        with kept(latest_checkpoint(run / "checkpoints")) as good:
            if rng.random() < 0.2:
                replace_payload(run, change_bytes(good.partition(b"\n")[2], rng))
            else:
                state = self.state(run)
                group = rng.choice([state, *[state[k] for k in state if isinstance(state[k], dict) and state[k]]])
                for _ in range(rng.randint(1, 2)):
                    change_value(group, rng)
                self.write_state(run, state)
            use(run)

    def metrics(self, rng: random.Random) -> None:
        """Lines of a run's metrics."""
        run = rng.choice(self.runs)
        with kept(run / "metrics.jsonl") as good:
            (run / "metrics.jsonl").write_bytes(change_bytes(good, rng))
            RunFolder(run).metrics()

    def capture(self, rng: random.Random, use: Callable[[Path], object], formats: Sequence[str] = FORMATS) -> None:
        """A file of cameras, or an image."""
        folder = self.folder / rng.choice(formats)
        images = sorted(folder.rglob("*.png"))
        cameras = [path for path in sorted(folder.rglob("*")) if path.is_file() and path not in images]
        with spoiled(rng.choice(images if rng.random() < 0.2 else cameras), rng):
            use(folder)

    def path(self, rng: random.Random, use: Callable[[Path], object]) -> None:
        """A camera path, or the file that says what nerfstudio did with its data."""
        with spoiled(rng.choice(sorted((self.folder / "paths").iterdir())), rng):
            use(self.folder / "paths")

    def result(self, rng: random.Random, use: Callable[[Path], object]) -> None:
        """A result.json."""
        path = rng.choice(self.results)
        with kept(path) as good:
            value = json.loads(good)
            group = rng.choice((value, value, *value.get("runs", ())[:5]))
            change_value(group, rng)
            path.write_bytes(dump(value))
            use(self.folder / "results" / path.relative_to(self.folder / "results").parts[0])


@contextlib.contextmanager
def spoiled(path: Path, rng: random.Random) -> Iterator[None]:
    """Another value in a json, other bytes in any file; mended at the end."""
    with kept(path) as good:
        if path.suffix == ".json" and rng.random() < 0.8:
            value = json.loads(good)
            change_value(value, rng)
            path.write_bytes(dump(value))
        else:
            size = 128 if path.suffix == ".npy" and rng.random() < 0.5 else len(good)  # its header
            path.write_bytes(change_bytes(good[:size], rng) + good[size:])
        yield


@contextlib.contextmanager
def kept(path: Path) -> Iterator[bytes]:
    """A file's content, written again at the end."""
    good = path.read_bytes()
    state = {other: other.read_bytes() for other in path.parent.glob("checkpoints/*.ckpt")}
    try:
        yield good
    finally:
        for other, content in {path: good, **state}.items():
            other.write_bytes(content)


def attack(case: Callable[[random.Random], None], seed: int) -> str:
    """A case is used, or refused in one line, which is returned; other exceptions are raised."""
    message = ""
    try:
        with memory_bound(2**31):
            case(random.Random(seed))
    except (InputError, FloatingPointError) as problem:
        message = str(problem)
    except Exception as problem:
        raise AssertionError(f"seed {seed} of {case}") from problem
    assert "\n" not in message
    assert len(message) < 3000
    return message
