"""`edge-se demo`: Random against Edge + SE on an off-center, mostly white scene, from the same initial weights."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from edge_se_sampler.bench.overrides import override
from edge_se_sampler.bench.runner import new_result
from edge_se_sampler.bench.scenes import cached_scene
from edge_se_sampler.bench.tables import describe_machine, markdown_table
from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.engine.evaluation import evaluate
from edge_se_sampler.engine.figures import require_pyplot, save_figure
from edge_se_sampler.engine.files import make_folder, write_json
from edge_se_sampler.engine.metrics import composite_on, psnr
from edge_se_sampler.engine.rendering import Picture, to_pictures
from edge_se_sampler.engine.session import prepare, read_test_views
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.methods import method_configs

SCENE: dict[str, Any] = {"name": "mic", "placement": "shifted", "offset": (0.2, 0.15), "size": 100}
SPLITS: dict[str, Any] = {"num_train": 50, "num_val": 1, "num_test": 10}
ITERATIONS = 600
METHODS = {"vanilla-nerf": "Random", "edge-se-nerf": "Edge + SE"}
COLORS = {"vanilla-nerf": "#7f7f7f", "edge-se-nerf": "#d62728"}


def run_demo(output_dir: Path, seed: int) -> dict[str, Any]:
    """Render the scene, train both methods, and leave demo.png and demo.json in output_dir, scene and runs in demo/.

    Returns:
        the content of demo.json.

    Raises:
        InputError: output_dir cannot be written, or matplotlib is missing.
    """
    require_pyplot()
    make_folder(output_dir, "--output-dir")
    start = time.monotonic()
    scene = render_scene(output_dir / "demo")
    methods, views = {}, {}
    for method in METHODS:
        methods[method], views[method] = _train(method, scene, output_dir / "demo" / "runs", seed)
    test, validation = (to_pictures(read_blender(scene, split)) for split in ("test", "val"))
    result = {
        **new_result("demo", {"scene": SCENE, "seed": seed, "iterations": ITERATIONS}),
        "background_psnr": float(np.mean([_background_psnr(picture) for picture in test])),
        "total_seconds": round(time.monotonic() - start, 1),
        "methods": methods,
    }
    write_json(output_dir / "demo.json", result)
    _draw(output_dir / "demo.png", methods, views, composite_on(test[0].image), _background_psnr(validation[0]))
    return result


def render_scene(workplace: Path) -> Path:
    """The demo's Blender folder, kept in the workplace."""
    return cached_scene(workplace, **SCENE, **SPLITS)


def build_trainer(method: str, scene: Path, output_dir: Path, seed: int) -> Trainer:
    """What trains one of the demo's methods, its run in output_dir."""
    changes = {
        "data": scene,
        "output_dir": output_dir,
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
    views: list[np.ndarray] = []
    pictures = to_pictures(read_test_views(trainer.config))
    results = evaluate(trainer.pipeline.model, pictures, lambda _, __, rendered: views.append(rendered))
    metrics = trainer.run.metrics()
    measured = {
        "training_seconds": round(trainer.elapsed, 2),
        "results": results,
        "loss": [line for line in metrics if "loss" in line],
        "validation": [line for line in metrics if "val_psnr" in line],
    }
    return measured, views[0]


def _background_psnr(picture: Picture) -> float:
    """PSNR of the white background alone."""
    return psnr(float(((composite_on(picture.image) - 1.0) ** 2).mean()))


def _draw(
    path: Path, methods: dict[str, dict[str, Any]], views: dict[str, np.ndarray], target: np.ndarray, background: float
) -> None:
    figure = require_pyplot().figure(figsize=(10.5, 7.0))
    top = figure.add_gridspec(1, 3, left=0.03, right=0.97, top=0.88, bottom=0.47, wspace=0.06)
    pictures = {"ground truth": target}
    for method, measured in methods.items():
        pictures[f"{METHODS[method]}: {measured['results']['psnr']:.2f} dB"] = views[method]
    for i, (title, picture) in enumerate(pictures.items()):
        axis = figure.add_subplot(top[0, i])
        axis.imshow(picture, interpolation="nearest")
        axis.set_title(title)
        axis.set(xticks=[], yticks=[])
    bottom = figure.add_gridspec(1, 2, left=0.07, right=0.97, top=0.38, bottom=0.08, wspace=0.12)
    curves = figure.add_subplot(bottom[0, 0]), figure.add_subplot(bottom[0, 1])
    for axis, x, label in zip(curves, ("step", "seconds"), ("iterations", "seconds of training"), strict=True):
        for method, measured in methods.items():
            lines = measured["validation"]
            values = [line["val_psnr"] for line in lines]
            axis.plot([line[x] for line in lines], values, color=COLORS[method], label=METHODS[method])
        axis.axhline(background, color="black", ls=":", lw=1, label="background alone")
        axis.set(xlabel=label)
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    curves[0].set_ylabel("PSNR of a validation view [dB]")
    curves[1].legend(frameon=False, loc="center right")
    figure.suptitle("The same network, the same initial weights, the same number of iterations", y=0.97)
    save_figure(figure, path)


def describe(folder: Path) -> str:
    """README.md of the demos in a folder, one in a folder of its own for each seed."""
    results = {path: json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("**/demo.json"))}
    settings = next(iter(results.values()))["settings"]
    rows = [
        (
            str(result["settings"]["seed"]),
            *(f"{result['methods'][method]['results']['psnr']:.2f} dB" for method in METHODS),
            f"{result['background_psnr']:.2f} dB",
            *(f"{result['methods'][method]['training_seconds']:.0f} s" for method in METHODS),
            f"{result['total_seconds']:.0f} s",
        )
        for result in results.values()
    ]
    labels = METHODS.values()
    head = ("seed", *labels, "background alone", *(f"training, {label}" for label in labels), "the whole demo")
    pictures = [
        f"![Seed {result['settings']['seed']}: ground truth, Random, Edge + SE, and validation PSNR]"
        f"({picture.relative_to(folder)})"
        for path, result in results.items()
        if (picture := path.with_suffix(".png")).exists()
    ]
    commands = "\n".join(result["command"] for result in results.values())
    scene, size = settings["scene"]["name"], settings["scene"]["size"]
    return f"""# The demo

What `edge-se demo` shows: the same network with the same initial weights, trained with pixels drawn uniformly (Random),
and with pixels drawn by edge strength for the first tenth of the iterations, then by squared error (Edge + SE). The
scene is the synthetic `{scene}`, {size} x {size} pixels, off center in front of white, trained for
{settings["iterations"]} iterations. PSNR is a mean over the test views; *background alone* is that of white images.

{markdown_table(head, rows)}

Scene and settings were chosen with seeds from 100 upwards. Edge + SE takes more computing per iteration, because it
renders candidates to compare their errors; the pictures show PSNR over iterations and over seconds.

{chr(10).join(pictures)}

## Reproduce

```bash
{commands}
```

Measured on {describe_machine(next(iter(results.values()))["machine"])}.
"""


def draw(folder: Path, workplace: Path | None) -> None:
    """The demo itself draws its pictures, which need trained models."""


def tables(folder: Path) -> dict[str, str]:
    """No other text shows these tables."""
    return {}
