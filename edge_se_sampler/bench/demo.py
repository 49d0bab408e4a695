"""`edge-se demo`: Random, Edge + SE and lean-nerf on the same images of an off-center, mostly white scene."""

from __future__ import annotations

import base64
import html
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from string import Template
from typing import Any

import imageio.v3 as iio
import numpy as np
import torch

from edge_se_sampler.bench.report import describe_machine
from edge_se_sampler.bench.results import new_result
from edge_se_sampler.bench.train import cached_scene
from edge_se_sampler.engine.config import override
from edge_se_sampler.engine.evaluation import evaluate
from edge_se_sampler.engine.figures import require_pyplot, save_figure
from edge_se_sampler.engine.files import check_output, make_folder, to_uint8, write_atomically, write_json
from edge_se_sampler.engine.frames import render_frame
from edge_se_sampler.engine.metrics import composite_on, psnr
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.rendering import Picture, to_pictures
from edge_se_sampler.engine.session import describe_run, prepare, read_test_views, read_train_views
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.engine.trajectories import spiral
from edge_se_sampler.engine.video import write_video
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models.voxel_backend import compiled_ops
from edge_se_sampler.sampling.registry import PIXEL_STRATEGIES

SCENE: dict[str, Any] = {"name": "mic", "placement": "shifted", "offset": (0.2, 0.15), "size": 200}
SPLITS: dict[str, Any] = {"num_train": 50, "num_val": 1, "num_test": 4}
ITERATIONS = 320
TIME_BUDGET = "20"  # seconds, of lean-nerf
METHODS = {"vanilla-nerf": "Random", "edge-se-nerf": "Edge + SE", "lean-nerf": "lean-nerf"}
TURN = 48  # frames


def run_demo(output_dir: Path, seed: int) -> dict[str, Any]:
    """Render the scene, train the methods, and leave demo.html, demo.png, demo.gif and demo.json in output_dir, scene
    and runs in demo/; the content of demo.json is returned. InputError: output_dir cannot be written, or matplotlib is
    missing."""
    require_pyplot()
    make_folder(output_dir, "--output-dir")
    for suffix in (".html", ".png", ".gif", ".json"):
        check_output(output_dir / f"demo{suffix}", suffix, flag="--output-dir")
    settings = {"scene": SCENE, **SPLITS, "seed": seed, "iterations": ITERATIONS, "time_budget": TIME_BUDGET}
    head = new_result("demo", settings)
    began = time.monotonic()
    scene = cached_scene(output_dir / "demo", **SCENE, **SPLITS)
    trainers, methods, views = {}, {}, {}
    for method in METHODS:
        trainer = trainers[method] = build_trainer(method, scene, output_dir / "demo" / "runs", seed)
        methods[method], views[method] = _train(trainer)
    test = to_pictures(read_test_views(trainers["lean-nerf"].config))
    write_video(output_dir / "demo.gif", _turntable(trainers["lean-nerf"]), 16)
    result = {
        **head,
        "numba": compiled_ops() is not None,
        "background_psnr": float(np.mean([_background_psnr(picture) for picture in test])),
        "seconds": round(time.monotonic() - began, 1),
        "methods": methods,
    }
    pictures = {"truth": composite_on(test[0].image), **views}
    box = _object_box(test[0])
    write_json(output_dir / "demo.json", result)
    _draw(output_dir / "demo.png", result, pictures, box)
    write_atomically(output_dir / "demo.html", _page(output_dir / "demo.gif", result, pictures, box).encode())
    return result


def build_trainer(method: str, scene: Path, runs: Path, seed: int) -> Trainer:
    """What trains one of the demo's methods, its run below a folder."""
    changes = {"data": scene, "output_dir": runs, "machine.seed": seed, "machine.device_type": "cpu"}
    if method == "lean-nerf":
        changes |= {"time_budget": TIME_BUDGET}
    else:  # tiny, so that it takes a minute; one preview, at the end
        changes |= {"max_num_iterations": ITERATIONS, "steps_per_eval_image": ITERATIONS, "pipeline.model.size": "tiny"}
    return prepare(override(method_configs()[method], changes))


def _train(trainer: Trainer) -> tuple[dict[str, Any], np.ndarray]:
    """What was measured of a training, and the first test view as the model renders it."""
    cpu_began = time.process_time()
    trainer.train()
    if trainer.stop_requested:
        raise KeyboardInterrupt
    cpu_seconds = time.process_time() - cpu_began
    views: list[np.ndarray] = []
    pictures = to_pictures(read_test_views(trainer.config))
    results = evaluate(trainer.pipeline.model, pictures, lambda _, __, rendered: views.append(rendered))
    described = dict(line.split(maxsplit=1) for line in describe_run(trainer).splitlines())
    sampler: Any = trainer.pipeline.datamanager.config.pixel_sampler
    early, late = (PIXEL_STRATEGIES[name].description for name in (sampler.early, sampler.late))
    measured = {
        "model": described["model"],
        "pixels": late if early == late else f"{early} for {sampler.early_fraction:.0%} of the training, then {late}",
        "steps": trainer.next_step,
        "rays_per_step": trainer.config.preset.rays,
        "training_seconds": round(trainer.setup_seconds + trainer.elapsed, 1),
        "training_cpu_seconds": round(cpu_seconds, 1),
        "results": results,
        "loss": [line for line in trainer.run.metrics() if "loss" in line],
    }
    return measured, views[0]


def _background_psnr(picture: Picture) -> float:
    """PSNR of the white background alone."""
    return psnr(float(((composite_on(picture.image) - 1.0) ** 2).mean()))


def _object_box(picture: Picture) -> tuple[slice, slice]:
    """Rows and columns of a square around what a picture shows."""
    corners = np.argwhere(picture.image[..., 3] > 0)
    low, high = corners.min(axis=0), corners.max(axis=0) + 1
    side = min(int((high - low).max() * 1.1), *picture.image.shape[:2])
    first = ((low + high - side) // 2).clip(0, np.array(picture.image.shape[:2]) - side).tolist()
    return slice(first[0], first[0] + side), slice(first[1], first[1] + side)


def _turntable(trainer: Trainer) -> Iterator[np.ndarray]:
    """Frames of a turn around the object, which fills them: of cameras that look straight at it."""
    config, size = trainer.config, 240
    cameras = spiral(read_train_views(config, trains=False), config.pipeline.model.depths, TURN)
    frame = 1 - 2 * max(SCENE["offset"])  # the part of the image that the object was given
    middle = {key: torch.full_like(cameras.cx, size / 2) for key in ("cx", "cy")}
    sides = {key: torch.full_like(cameras.width, size) for key in ("width", "height")}
    focal = {key: getattr(cameras, key) * size / (SCENE["size"] * frame) for key in ("fx", "fy")}
    cameras = replace(cameras, **middle, **sides, **focal)
    with Progress(TURN, "rendering a turn") as progress:
        for i in range(TURN):
            yield render_frame(trainer.pipeline.model, cameras, i, ["rgb"], 1.0)["rgb"]
            progress.update(i + 1)


def _captions(result: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """A title and a line below it for the truth and each method."""
    found = {"truth": ("Ground truth", f"a test view, {SCENE['size']} x {SCENE['size']} px")}
    for method, measured in result["methods"].items():
        seconds, decibel = measured["training_seconds"], measured["results"]["psnr"]
        found[method] = (METHODS[method], f"{decibel:.2f} dB, {seconds:.0f} s of training")
    return found


def _draw(path: Path, result: Mapping[str, Any], pictures: Mapping[str, np.ndarray], box: tuple[slice, slice]) -> None:
    """The truth and the renderings of a test view; below, the same enlarged around the object."""
    layout: Any = [list(pictures), [f"{name} enlarged" for name in pictures]]
    figure, axes = require_pyplot().subplot_mosaic(layout, figsize=(12, 6.9), layout="constrained")
    (top, bottom), (left, right) = ((side.start - 0.5, side.stop - 0.5) for side in box)
    for name, (title, line) in _captions(result).items():
        axes[name].set_title(f"{title}\n{line}", fontsize=11)
        axes[name].imshow(pictures[name], interpolation="nearest")
        axes[name].plot([left, right, right, left, left], [top, top, bottom, bottom, top], color="#1f77b4", lw=1)
        axes[f"{name} enlarged"].imshow(pictures[name][box], interpolation="nearest")
    for axis in axes.values():
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_color("#cccccc")
    line = f"The same {SPLITS['num_train']} images; PSNR over {SPLITS['num_test']} test views"
    figure.suptitle(f"{line}; Random and Edge + SE train the same network, lean-nerf is another model", fontsize=12)
    save_figure(figure, path)


def _page(gif: Path, result: Mapping[str, Any], pictures: Mapping[str, np.ndarray], box: tuple[slice, slice]) -> str:
    """demo.html, with everything in it."""

    def image(content: bytes, kind: str, alt: str) -> str:
        return f'<img alt="{alt}" src="data:image/{kind};base64,{base64.b64encode(content).decode()}">'

    def png(pixels: np.ndarray, alt: str) -> str:
        return image(iio.imwrite("<bytes>", to_uint8(pixels), extension=".png"), "png", alt)

    cards = [
        f"<figure>{png(pictures[name][box], title)}{png(pictures[name], title)}"
        f"<figcaption><b>{title}</b><br>{line}</figcaption></figure>"
        for name, (title, line) in _captions(result).items()
    ]
    rows = []
    for method, measured in result["methods"].items():
        cells = (
            f"<b>{METHODS[method]}</b> ({method})",
            measured["model"],
            measured["pixels"],
            f"{measured['steps']:,} of {measured['rays_per_step']:,} rays",
            f"{measured['training_seconds']:.1f} s",
            f"{measured['results']['psnr']:.2f} dB",
            f"{measured['results']['foreground_psnr']:.2f} dB",
        )
        rows.append("".join(f"<td>{cell}</td>" for cell in cells))
    template = Path(__file__).with_name("demo.html").read_text(encoding="utf-8")
    return Template(template).substitute(
        cards="\n".join(cards),
        turn=image(gif.read_bytes(), "gif", "a turn around the microphone"),
        rows="\n".join(f"<tr>{row}</tr>" for row in rows),
        lean_seconds=f"{result['methods']['lean-nerf']['training_seconds']:.0f}",
        background=f"{result['background_psnr']:.2f}",
        numba=""
        if result["numba"]
        else "<p><b>numba is not installed</b> (the extra [fast]): lean-nerf ran in plain "
        "torch, several times slower, and got less far in its time.</p>",
        **{key: result["settings"][key] for key in ("seed", "iterations", "num_train", "num_test", "time_budget")},
        size=SCENE["size"],
        command=html.escape(result["command"]),
        seconds=f"{result['seconds']:.0f}",
        machine=html.escape(describe_machine(result["machine"])),
    )
