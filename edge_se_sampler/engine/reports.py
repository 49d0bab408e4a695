"""What eval, render and bench leave: json files, pictures, videos."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from edge_se_sampler.engine.camera_path import spiral
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.evaluation import (
    Picture,
    evaluate,
    get_background_color,
    render_rays,
)
from edge_se_sampler.engine.files import check_output, make_folder, write_image, write_json
from edge_se_sampler.engine.metrics import composite_on
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.session import load_model, read_views, test_pictures
from edge_se_sampler.engine.video import check_video, write_video
from edge_se_sampler.errors import InputError
from edge_se_sampler.sampling.edges import unit_float


def evaluate_run(
    run: RunFolder, config: TrainerConfig, output_path: Path, render_output_path: Path | None
) -> dict[str, Any]:
    """Measure a run's last checkpoint on its held-out views and write nerfstudio's eval json.

    Raises:
        InputError: a bad run, or an output that cannot be written.
    """
    check_output(output_path)
    model, checkpoint = load_model(run, config)
    pictures = test_pictures(config)
    if render_output_path is not None:
        make_folder(render_output_path, "--render-output-path")

    def report(i: int, picture: Picture, rendered: np.ndarray) -> None:
        progress.update(i + 1)
        if render_output_path is not None:
            pair = np.concatenate((composite_on(picture.image, get_background_color(model)), rendered), axis=1)
            write_image(render_output_path / f"{i:04d}.png", pair)

    with Progress(len(pictures), "evaluating") as progress:
        results = evaluate(model, pictures, report)
    content = {
        "experiment_name": config.experiment_name,
        "method_name": config.method_name,
        "checkpoint": str(checkpoint),
        "results": results,
    }
    write_json(output_path, content)
    return results


def render_run(
    run: RunFolder, config: TrainerConfig, output_path: Path, kind: str, num_frames: int, frames_per_second: int
) -> None:
    """Render a run's last checkpoint along a spiral or at its held-out cameras, as a video.

    Raises:
        InputError: a bad run, or an output that cannot be written.
    """
    check_video(output_path, frames_per_second)
    if num_frames < 1 or frames_per_second < 1:
        raise InputError("--num-frames and --frames-per-second must be at least 1")
    model, _ = load_model(run, config)
    pictures = test_pictures(config)
    if kind == "spiral":
        train = read_views(config)
        cameras = spiral(train.cameras, num_frames)
        pictures = [Picture(f"{i}", unit_float(train.images[0]), cameras[[i]]) for i in range(num_frames)]
    frames = []
    with Progress(len(pictures), "rendering") as progress:
        for i, picture in enumerate(pictures):
            rendered = render_rays(model, picture.rays(model.device))
            frames.append(rendered.reshape(*picture.image.shape[:2], 3).numpy())
            progress.update(i + 1)
    if len({frame.shape for frame in frames}) > 1:
        raise InputError("the held-out views differ in size and make no video; use --kind spiral")
    write_video(output_path, frames, frames_per_second)
