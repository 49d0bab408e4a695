"""How good a model is: held-out views rendered and measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edge_se_sampler.data.scene_file import read_json
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.files import check_output, make_folder, write_image, write_json
from edge_se_sampler.engine.metrics import composite_on, compute_metrics, psnr
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.rendering import Picture, render_view, to_pictures
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.session import load_ensemble, read_test_views
from edge_se_sampler.errors import InputError
from edge_se_sampler.models.ray_model import RayModel


def evaluate(
    model: RayModel, pictures: list[Picture], on_view: Callable[[int, Picture, np.ndarray], None] | None = None
) -> dict[str, Any]:
    """Render every picture and compare all of its pixels that are known; on_view gets index, picture and rendering
    (H, W, 3). Returns the mean of every metric over the views, psnr_std, psnr_pooled (of the mean mse),
    num_images, and `images`, the metrics of each. lpips is None: its weights are not part of this package."""
    rows = []
    for i, picture in enumerate(pictures):
        rendered = render_view(model, picture)
        metrics = compute_metrics(rendered, picture.image, model.config.background_level, picture.mask)
        rows.append({"name": picture.name, **metrics})
        if on_view is not None:
            on_view(i, picture, rendered)
    columns = {key: [row[key] for row in rows if row[key] is not None] for key in rows[0]}
    averaged = [key for key in columns if key not in ("name", "mse")]
    return {key: float(np.mean(columns[key])) if columns[key] else None for key in averaged} | {
        "psnr_std": float(np.std(columns["psnr"])),
        "psnr_pooled": psnr(float(np.mean(columns["mse"]))),
        "lpips": None,
        "num_images": len(rows),
        "images": rows,
    }


def evaluate_run(
    runs: Sequence[tuple[RunFolder, TrainerConfig]], output_path: Path, render_output_path: Path | None
) -> dict[str, Any]:
    """Evaluate the last checkpoint of a run, or of several in the mean, on the first one's held-out views, and write a
    json with the keys of nerfstudio's eval. InputError if a file is there that is no such json."""
    check_output(output_path, ".json")
    if output_path.exists() and not _is_evaluation(output_path):
        raise InputError(f"--output-path {output_path}: is no evaluation, and would be replaced by one; name another")
    model, checkpoints = load_ensemble(runs)
    config = runs[0][1]
    pictures = to_pictures(read_test_views(config))
    if render_output_path is not None:
        make_folder(render_output_path, "--render-output-path")

    def report(i: int, picture: Picture, rendered: np.ndarray) -> None:
        progress.update(i + 1)
        if render_output_path is not None:
            pair = np.concatenate((composite_on(picture.image, model.config.background_level), rendered), axis=1)
            write_image(render_output_path / f"{i:04d}.png", pair)

    with Progress(len(pictures), "evaluating") as progress:
        results = evaluate(model, pictures, report)
    names = {"experiment_name": config.experiment_name, "method_name": config.method_name}
    others = {"averaged_with": [str(path) for path in checkpoints[1:]]} if len(checkpoints) > 1 else {}
    write_json(output_path, names | {"checkpoint": str(checkpoints[0]), **others, "results": results})
    return results


def _is_evaluation(path: Path) -> bool:
    try:
        return "results" in read_json(path).object()
    except InputError:
        return False
