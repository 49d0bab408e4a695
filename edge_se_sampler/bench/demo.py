"""`edge-se demo`: Random against Edge + SE on an off-center, mostly white scene, from the same initial weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from edge_se_sampler.bench.runner import new_result
from edge_se_sampler.bench.train import cached_scene
from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.engine.config import override
from edge_se_sampler.engine.evaluation import evaluate
from edge_se_sampler.engine.figures import require_pyplot, save_figure, style_axes
from edge_se_sampler.engine.files import make_folder, write_json
from edge_se_sampler.engine.metrics import composite_on, psnr
from edge_se_sampler.engine.rendering import Picture, render_view, to_pictures
from edge_se_sampler.engine.session import prepare, read_test_views
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.methods import method_configs

SCENE: dict[str, Any] = {"name": "mic", "placement": "shifted", "offset": (0.2, 0.15), "size": 100}
SPLITS: dict[str, Any] = {"num_train": 50, "num_val": 1, "num_test": 10}
ITERATIONS = 600
METHODS = {"vanilla-nerf": "Random", "edge-se-nerf": "Edge + SE"}


def run_demo(output_dir: Path, seed: int) -> dict[str, Any]:
    """Render the scene, train both methods, and leave demo.png and demo.json in output_dir, scene and runs in demo/;
    the content of demo.json is returned. InputError: output_dir cannot be written, or matplotlib is missing."""
    require_pyplot()
    make_folder(output_dir, "--output-dir")
    scene = cached_scene(output_dir / "demo", **SCENE, **SPLITS)
    methods, views = {}, {}
    for method in METHODS:
        methods[method], views[method] = _train(method, scene, output_dir / "demo" / "runs", seed)
    test, validation = (to_pictures(read_blender(scene, split)) for split in ("test", "val"))
    result = {
        **new_result("demo", {"scene": SCENE, "seed": seed, "iterations": ITERATIONS}),
        "background_psnr": float(np.mean([_background_psnr(picture) for picture in test])),
        "methods": methods,
    }
    write_json(output_dir / "demo.json", result)
    _draw(output_dir / "demo.png", methods, views, composite_on(test[0].image), _background_psnr(validation[0]))
    return result


def build_trainer(method: str, scene: Path, runs: Path, seed: int) -> Trainer:
    """What trains one of the demo's methods, its run below a folder."""
    changes = {
        "data": scene,
        "output_dir": runs,
        "max_num_iterations": ITERATIONS,
        "steps_per_eval_image": ITERATIONS // 20,
        "machine.seed": seed,
        "machine.device_type": "cpu",
    }
    return prepare(override(method_configs()[method], changes))


def _train(method: str, scene: Path, runs: Path, seed: int) -> tuple[dict[str, Any], np.ndarray]:
    """What was measured of a method's training, and the first test view as it renders it."""
    trainer = build_trainer(method, scene, runs, seed)
    trainer.train()
    if trainer.stop_requested:
        raise KeyboardInterrupt
    model, pictures = trainer.pipeline.model, to_pictures(read_test_views(trainer.config))
    metrics = trainer.run.metrics()
    measured = {
        "training_seconds": round(trainer.elapsed, 2),
        "results": evaluate(model, pictures),
        "loss": [line for line in metrics if "loss" in line],
        "validation": [line for line in metrics if "val_psnr" in line],
    }
    return measured, render_view(model, pictures[0])[0]


def _background_psnr(picture: Picture) -> float:
    """PSNR of the white background alone."""
    return psnr(float(((composite_on(picture.image) - 1.0) ** 2).mean()))


def _draw(
    path: Path, methods: dict[str, dict[str, Any]], views: dict[str, np.ndarray], target: np.ndarray, background: float
) -> None:
    """A test view and its renderings; below, the PSNR of a validation view over steps and seconds of training."""
    layout: Any = [[name for name in ("truth", *METHODS) for _ in range(2)], ["step"] * 3 + ["seconds"] * 3]
    figure, axes = require_pyplot().subplot_mosaic(layout, figsize=(10.5, 7.0), layout="constrained")
    titles = {method: f"{label}: {methods[method]['results']['psnr']:.2f} dB" for method, label in METHODS.items()}
    for name, title in {"truth": "ground truth", **titles}.items():
        axes[name].imshow(views.get(name, target), interpolation="nearest")
        axes[name].set(title=title, xticks=[], yticks=[])
    for x, label in (("step", "iterations"), ("seconds", "seconds of training")):
        for method, color in zip(METHODS, ("#7f7f7f", "#d62728"), strict=True):
            lines = methods[method]["validation"]
            curve = [line["val_psnr"] for line in lines]
            axes[x].plot([line[x] for line in lines], curve, color=color, label=METHODS[method])
        axes[x].axhline(background, color="black", ls=":", lw=1, label="background alone")
        axes[x].set_xlabel(label)
    style_axes(axes["step"], axes["seconds"])
    axes["step"].set_ylabel("PSNR of a validation view [dB]")
    axes["seconds"].legend(frameon=False, loc="center right")
    figure.suptitle("The same network, the same initial weights, the same number of iterations")
    save_figure(figure, path)
