"""`edge-se bench quality`: how good a synthetic scene gets in a few minutes of training, and the curve on the way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.machine import machine
from edge_se_sampler.bench.micro.scoring import scene_in
from edge_se_sampler.engine.config import MachineConfig
from edge_se_sampler.engine.evaluation import evaluate
from edge_se_sampler.engine.figures import require_pyplot, save_figure
from edge_se_sampler.engine.files import make_folder, write_json
from edge_se_sampler.engine.resolve import check_seconds
from edge_se_sampler.engine.run_folder import config_to_json
from edge_se_sampler.engine.session import prepare, test_pictures
from edge_se_sampler.methods import method_configs


def bench_quality(
    output_dir: Path, workplace: Path, method: str, scene: str, seconds: float, seed: int
) -> dict[str, Any]:
    """Train a method on a synthetic scene under its default plan, and leave result.json and curve.png.

    Args:
        output_dir: of the result.
        workplace: where the scene and the run are kept.
        seconds: at most; the training time in the result leaves out looking at validation views.

    Raises:
        InputError: a folder that cannot be written, an unknown scene, or matplotlib missing.
    """
    require_pyplot()
    check_seconds(seconds, "--seconds")
    make_folder(output_dir, "--output-dir")
    data = scene_in(workplace, scene)
    config = method_configs()[method]
    trainer = prepare(
        replace(
            config,
            data=data,
            output_dir=workplace / "runs",
            max_seconds=seconds,
            machine=MachineConfig(seed=seed, device_type="cpu"),
        )
    )
    trainer.train()
    if trainer.stop_requested:
        raise KeyboardInterrupt
    result = {
        "command": f"edge-se bench quality --method {method} --scene {scene} --seconds {seconds:g} --seed {seed}",
        "scene": scene,
        "seed": seed,
        "steps": trainer.next_step,
        "seconds": trainer.elapsed,
        "results": evaluate(trainer.pipeline.model, test_pictures(trainer.config)),
        "curve": [line for line in trainer.run.metrics() if "val_psnr" in line],
        "machine": machine(),
        "config": config_to_json(replace(trainer.config, data=Path(scene), output_dir=Path("runs"))),
    }
    write_json(output_dir / "result.json", result)
    _draw(output_dir / "curve.png", result)
    return result


def _draw(path: Path, result: dict[str, Any]) -> None:
    figure, axis = require_pyplot().subplots(figsize=(6.4, 3.8))
    curve = result["curve"]
    axis.plot([line["seconds"] for line in curve], [line["val_psnr"] for line in curve], "o-", color="#d62728", ms=4)
    axis.axhline(result["results"]["psnr"], color="black", ls=":", lw=1)
    axis.margins(y=0.1)
    # under its line, on the left, where the curve is still low: above it there may be the title
    label = f"{result['results']['num_images']} test views at the end: {result['results']['psnr']:.2f} dB"
    axis.annotate(
        label, (0.02, result["results"]["psnr"]), xycoords=("axes fraction", "data"), xytext=(0, -4),
        textcoords="offset points", va="top", fontsize=9,
    )  # fmt: skip
    title = f"{result['config']['method_name']} on {result['scene']}, {result['machine']['cores']} CPU cores"
    axis.set(xlabel="seconds of training", ylabel="PSNR of a validation view [dB]", title=title)
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    save_figure(figure, path)
