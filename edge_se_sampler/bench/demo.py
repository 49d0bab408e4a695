"""`edge-se demo`: Random against Edge + SE on an off-centre, mostly white scene, from the same initial weights."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from edge_se_sampler.bench.machine import machine
from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.config import MachineConfig
from edge_se_sampler.engine.evaluation import evaluate
from edge_se_sampler.engine.figures import require_pyplot, save_figure
from edge_se_sampler.engine.files import make_folder, write_json
from edge_se_sampler.engine.metrics import composite_on, psnr
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.rendering import Picture, to_pictures
from edge_se_sampler.engine.run_folder import config_to_json
from edge_se_sampler.engine.session import prepare, read_test_views
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.methods import method_configs

SCENE = "mic"
OFFSET = (0.2, 0.15)
SIZE = 100
ITERATIONS = 600
METHODS = {"vanilla-nerf": "Random", "edge-se-nerf": "Edge + SE"}
COLORS = {"vanilla-nerf": "#7f7f7f", "edge-se-nerf": "#d62728"}


@dataclass(frozen=True)
class Outcome:
    """One method's training."""

    method: str
    seconds: float
    loss: list[dict[str, Any]]
    validation: list[dict[str, Any]]
    results: dict[str, Any]
    picture: np.ndarray


def demo(output_dir: Path, seed: int) -> list[Outcome]:
    """Make the scene, train both methods, and leave demo.png and demo.json in output_dir, the runs in demo/.

    Raises:
        InputError: output_dir cannot be written, or matplotlib is missing.
    """
    require_pyplot()
    make_folder(output_dir, "--output-dir")
    began = time.monotonic()
    workplace = output_dir / "demo"
    scene = workplace / f"{SCENE}-off-centre"
    if not scene.exists():
        make_demo_scene(workplace / "scenes-tmp").rename(scene)
        (workplace / "scenes-tmp").rmdir()
    outcomes = [_train(method, scene, workplace, seed) for method in METHODS]
    test, validation = to_pictures(read_blender(scene, "test")), to_pictures(read_blender(scene, "val"))
    background = float(np.mean([_background_psnr(picture) for picture in test]))
    _write_json(output_dir / "demo.json", outcomes, background, seed, time.monotonic() - began)
    _draw(output_dir / "demo.png", outcomes, composite_on(test[0].image), _background_psnr(validation[0]))
    return outcomes


def make_demo_scene(folder: Path) -> Path:
    """The demo's Blender folder, made in `folder`."""
    with Progress(0, f"rendering {SCENE}, off center") as progress:
        (scene,) = make_scenes(
            folder, [SCENE], size=SIZE, num_train=50, num_val=1, num_test=10, placement="shifted", offset=OFFSET,
            progress=progress.update,
        )  # fmt: skip
    return scene


def demo_trainer(method: str, scene: Path, output_dir: Path, seed: int) -> Trainer:
    """What trains one of the demo's methods, its run in output_dir."""
    return prepare(
        replace(
            method_configs()[method],
            data=scene,
            output_dir=output_dir,
            max_num_iterations=ITERATIONS,
            steps_per_eval_image=ITERATIONS // 20,
            machine=MachineConfig(seed=seed, device_type="cpu"),
        )
    )


def _train(method: str, scene: Path, workplace: Path, seed: int) -> Outcome:
    trainer = demo_trainer(method, scene, workplace / "runs", seed)
    trainer.train()
    if trainer.stop_requested:
        raise KeyboardInterrupt
    metrics = trainer.run.metrics()
    first: list[np.ndarray] = []
    results = evaluate(
        trainer.pipeline.model,
        to_pictures(read_test_views(trainer.config)),
        lambda _, __, rendered: first.append(rendered),
    )
    return Outcome(
        method,
        trainer.elapsed,
        [line for line in metrics if "loss" in line],
        [line for line in metrics if "val_psnr" in line],
        results | {"config": config_to_json(replace(trainer.config, data=Path(scene.name), output_dir=Path("runs")))},
        first[0],
    )


def _background_psnr(picture: Picture) -> float:
    """PSNR of answering with the white background alone."""
    return psnr(float(((composite_on(picture.image) - 1.0) ** 2).mean()))


def _write_json(path: Path, outcomes: list[Outcome], background: float, seed: int, seconds: float) -> None:
    methods = {
        outcome.method: {
            "training_seconds": round(outcome.seconds, 2),
            "results": outcome.results,
            "loss": outcome.loss,
            "validation": outcome.validation,
        }
        for outcome in outcomes
    }
    content = {
        "command": f"edge-se demo --seed {seed}",
        "scene": {"name": SCENE, "placement": "shifted", "offset": OFFSET, "size": SIZE},
        "seed": seed,
        "iterations": ITERATIONS,
        "background_psnr": background,
        "total_seconds": round(seconds, 1),
        "machine": machine(),
        "methods": methods,
    }
    write_json(path, content)


def _draw(path: Path, outcomes: list[Outcome], target: np.ndarray, background: float) -> None:
    figure = require_pyplot().figure(figsize=(10.5, 7.0))
    top = figure.add_gridspec(1, 3, left=0.03, right=0.97, top=0.88, bottom=0.47, wspace=0.06)
    titles = ["ground truth"]
    titles += [f"{METHODS[outcome.method]}: {outcome.results['psnr']:.2f} dB" for outcome in outcomes]
    pictures = [target, *(outcome.picture for outcome in outcomes)]
    for i, (title, picture) in enumerate(zip(titles, pictures, strict=True)):
        axis = figure.add_subplot(top[0, i])
        axis.imshow(picture, interpolation="nearest")
        axis.set_title(title)
        axis.set(xticks=[], yticks=[])
    bottom = figure.add_gridspec(1, 2, left=0.07, right=0.97, top=0.38, bottom=0.08, wspace=0.12)
    curves = figure.add_subplot(bottom[0, 0]), figure.add_subplot(bottom[0, 1])
    for outcome in outcomes:
        name, color = METHODS[outcome.method], COLORS[outcome.method]
        measured = [line["val_psnr"] for line in outcome.validation]
        for axis, x in zip(curves, ("step", "seconds"), strict=True):
            axis.plot([line[x] for line in outcome.validation], measured, color=color, label=name)
    for axis, label in zip(curves, ("iterations", "seconds of training"), strict=True):
        axis.axhline(background, color="black", ls=":", lw=1, label="background alone")
        axis.set(xlabel=label)
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    curves[0].set_ylabel("PSNR of a validation view [dB]")
    curves[1].legend(frameon=False, loc="center right")
    figure.suptitle("The same network, the same initial weights, the same number of iterations", y=0.97)
    save_figure(figure, path)
