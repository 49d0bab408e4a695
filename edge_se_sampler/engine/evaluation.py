"""How good a model is: pictures of held-out views and their measures.

mse   mean squared error over pixels and channels, colours in [0, 1]
PSNR  -10 log10(mse), in dB; a table's PSNR is the mean over its images
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch

from edge_se_sampler.data.blender import Views
from edge_se_sampler.data.cameras import RayBundle, RayGenerator
from edge_se_sampler.data.datamanager import cameras_of
from edge_se_sampler.models.ray_model import RayModel, target_colors
from edge_se_sampler.sampling.edges import edge_strength, unit_float

EDGE_BAND_SHARE = 0.1
"""The edge band: the share of pixels with the strongest Sobel response, and their neighbours."""


@dataclass(frozen=True)
class Picture:
    """A view that a model is compared with."""

    name: str
    image: np.ndarray
    """(H, W, 3|4) float32 in [0, 1], straight alpha."""
    generator: RayGenerator
    camera: int

    def rays(self, device: torch.device) -> RayBundle:
        """Its H * W rays."""
        return RayGenerator(self.generator.cameras.to(device)).image(self.camera)


def pictures_of(views: Views) -> list[Picture]:
    """All views of a split."""
    generator = RayGenerator(cameras_of(views))
    names = enumerate(views.names)
    return [Picture(name, unit_float(views.images[i]), generator, i) for i, name in names]


def get_background_color(model: RayModel) -> float:
    """The background that a model is evaluated on."""
    return 0.0 if model.config.background_color == "black" else 1.0


def render_rays(model: RayModel, rays: RayBundle, key: str = "rgb_fine") -> torch.Tensor:
    """An output of all rays, on the CPU, without gradients and in evaluation mode."""
    was_training = model.training
    model.eval()
    with torch.no_grad():
        rendered = [model(rays[rows])[key].cpu() for rows in model.chunks(len(rays))]
    model.train(was_training)
    return torch.cat(rendered)


def target_image(picture: Picture, shade: float) -> np.ndarray:
    """What the picture shows in front of its background, (H, W, 3)."""
    image = torch.from_numpy(picture.image).reshape(-1, picture.image.shape[2])
    return target_colors(image, torch.full((3,), shade)).numpy().reshape(*picture.image.shape[:2], 3)


def render_view(model: RayModel, picture: Picture) -> tuple[np.ndarray, float]:
    """A view's rendering (H, W, 3) in [0, 1] and its PSNR.

    Raises:
        FloatingPointError: the model renders values that are not finite.
    """
    height, width = picture.image.shape[:2]
    rendered = render_rays(model, picture.rays(model.device)).reshape(height, width, 3).clamp(0, 1).numpy()
    if not np.isfinite(rendered).all():
        raise FloatingPointError("the model's colours are not finite: training diverged; try a lower --optimizer.lr")
    error = (rendered.astype(np.float64) - target_image(picture, get_background_color(model))) ** 2
    return rendered, psnr(error.mean())


def psnr(mse: float) -> float:
    """Mean squared error -> dB; an exact match counts as 100 dB, so that results stay valid json."""
    return 100.0 if mse <= 1e-10 else -10 * math.log10(mse)


def ssim(first: np.ndarray, second: np.ndarray) -> float | None:
    """Structural similarity (Wang et al. 2004) of two (H, W, 3) pictures in [0, 1], by OpenCV's quality module.

    OpenCV mirrors the borders where Wang et al. leave them out: on small pictures with plain borders it answers
    higher (0.955 for 0.944 at 100 x 100), so compare values of one size only. None where this OpenCV has no such module
    (the plain package lacks it).
    """
    if not hasattr(cv2, "quality"):
        return None
    scaled = [np.rint(picture * 255).astype(np.uint8) for picture in (first, second)]
    score, _ = cv2.quality.QualitySSIM_compute(scaled[0], scaled[1])  # pyright: ignore[reportAttributeAccessIssue]
    return float(np.mean(score[:3]))


def edge_band(image: np.ndarray) -> np.ndarray:
    """Where an image (H, W, 3) has its strongest edges and their neighbours, (H, W) bool."""
    edges = edge_strength(image)
    band = edges >= max(float(np.quantile(edges, 1 - EDGE_BAND_SHARE)), 1e-6)
    return cv2.dilate(band.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def measures(rendered: np.ndarray, picture: Picture, shade: float) -> dict[str, float | None]:
    """All measures of one view; None where there is nothing to measure (no alpha, no foreground).

    Returns:
        mse, psnr, ssim, foreground_psnr (alpha > 0), edge_band_psnr, background_mse (alpha = 0).
    """
    target = target_image(picture, shade)
    error = ((rendered.astype(np.float64) - target) ** 2).mean(axis=2)
    band = edge_band(target)
    result = {
        "mse": float(error.mean()),
        "psnr": psnr(error.mean()),
        "ssim": ssim(rendered, target),
        "foreground_psnr": None,
        "edge_band_psnr": psnr(error[band].mean()) if band.any() else None,
        "background_mse": None,
    }
    if picture.image.shape[2] == 4:
        inside = picture.image[..., 3] > 0
        if inside.any():
            result["foreground_psnr"] = psnr(error[inside].mean())
        if not inside.all():
            result["background_mse"] = float(error[~inside].mean())
    return result


def evaluate(
    model: RayModel, pictures: list[Picture], each: Callable[[int, Picture, np.ndarray], None] | None = None
) -> dict[str, Any]:
    """Render every picture and measure all of its pixels, masked ones too.

    Args:
        each: called with the number, picture and rendering of every view.

    Returns:
        the mean of every measure over the views, psnr_std, psnr_pooled (of the mean mse), num_images, and
        `images`, the measures of each. lpips is None: its weights are not part of this package.
    """
    rows = []
    for i, picture in enumerate(pictures):
        rendered, _ = render_view(model, picture)
        rows.append({"name": picture.name, **measures(rendered, picture, get_background_color(model))})
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
