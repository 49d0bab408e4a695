"""How good a model is: held-out views rendered and measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from edge_se_sampler.data.cameras import Cameras, RayBundle
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.metrics import composite_on, compute_metrics, psnr
from edge_se_sampler.models.ray_model import RayModel
from edge_se_sampler.sampling.edges import unit_float


@dataclass(frozen=True)
class Picture:
    """A view that a model is compared with."""

    name: str
    image: np.ndarray
    """(H, W, 3|4) float32 in [0, 1], straight alpha."""
    camera: Cameras
    """The one that took it."""

    def rays(self, device: torch.device) -> RayBundle:
        """Its H * W rays."""
        return self.camera.to(device, torch.float32).image_rays(0)


def pictures_of(views: Views) -> list[Picture]:
    """All views of a split."""
    return [Picture(name, unit_float(views.images[i]), views.cameras[[i]]) for i, name in enumerate(views.names)]


def get_background_color(model: RayModel) -> float:
    """The grey level in [0, 1] of the background that a model is evaluated on."""
    return model.config.background_level


def render_rays(model: RayModel, rays: RayBundle, key: str = "rgb_fine") -> torch.Tensor:
    """An output of all rays, on the CPU, without gradients and in evaluation mode."""
    was_training = model.training
    model.eval()
    with torch.no_grad():
        rendered = [model(rays[rows])[key].cpu() for rows in model.chunks(len(rays))]
    model.train(was_training)
    return torch.cat(rendered)


def render_view(model: RayModel, picture: Picture) -> tuple[np.ndarray, float]:
    """A view's rendering (H, W, 3) in [0, 1] and its PSNR.

    Raises:
        FloatingPointError: the model renders values that are not finite.
    """
    height, width = picture.image.shape[:2]
    rendered = render_rays(model, picture.rays(model.device)).reshape(height, width, 3).clamp(0, 1).numpy()
    if not np.isfinite(rendered).all():
        raise FloatingPointError("the model's colours are not finite: training diverged; try a lower --optimizer.lr")
    error = (rendered.astype(np.float64) - composite_on(picture.image, get_background_color(model))) ** 2
    return rendered, psnr(error.mean())


def evaluate(
    model: RayModel, pictures: list[Picture], each: Callable[[int, Picture, np.ndarray], None] | None = None
) -> dict[str, Any]:
    """Render every picture and measure all of its pixels, masked ones too. PSNR is the mean over images, as in tables.

    Args:
        each: called with the number, picture and rendering of every view.

    Returns:
        the mean of every measure over the views, psnr_std, psnr_pooled (of the mean mse), num_images, and
        `images`, the measures of each. lpips is None: its weights are not part of this package.
    """
    rows = []
    for i, picture in enumerate(pictures):
        rendered, _ = render_view(model, picture)
        rows.append({"name": picture.name, **compute_metrics(rendered, picture.image, get_background_color(model))})
        if each is not None:
            each(i, picture, rendered)
    result: dict[str, Any] = {}
    for key in rows[0]:
        values = [row[key] for row in rows if row[key] is not None]
        if key not in ("name", "mse"):
            result[key] = float(np.mean(values)) if values else None
    result["psnr_std"] = float(np.std([row["psnr"] for row in rows]))
    result["psnr_pooled"] = psnr(float(np.mean([row["mse"] for row in rows])))
    return result | {"lpips": None, "num_images": len(rows), "images": rows}
