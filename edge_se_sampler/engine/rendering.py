"""Views, and a model's renderings of them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import torch

from edge_se_sampler.data.cameras import Cameras, RayBundle
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.metrics import composite_on, psnr
from edge_se_sampler.models.ray_model import RayModel
from edge_se_sampler.models.rendering import remove_background
from edge_se_sampler.sampling.edges import unit_float


@dataclass(frozen=True)
class Picture:
    """An image that a rendering is compared with, and the camera that took it."""

    name: str
    stored: np.ndarray
    """(H, W, 3|4) uint8 or float in [0, 1], straight alpha."""
    camera: Cameras  # one
    mask: np.ndarray | None = None
    """(H, W) bool: the pixels that are known; None: all."""

    @property
    def image(self) -> np.ndarray:
        """(H, W, 3|4) float32 in [0, 1], straight alpha: of many pictures too much to be kept."""
        return unit_float(self.stored)

    def rays(self, device: torch.device) -> RayBundle:
        """The H * W rays of its pixels, row by row."""
        return self.camera.to(device, torch.float32).image_rays(0)


@dataclass(frozen=True)
class CameraRays:
    """Rays of one camera's pixels, row by row, with what a model knows of the empty space that they pass."""

    camera: Cameras
    empty_depths: torch.Tensor | None
    model: RayModel | None = None
    """Whose cells rays meet wherever they are; None: those between near and far."""

    @classmethod
    @torch.no_grad()
    def of(cls, model: RayModel, camera: Cameras, *, everything: bool = False) -> CameraRays:
        """`everything`: see `meet_all_cells`."""
        camera = camera.to(model.device, torch.float32)
        return cls(camera, model.find_empty_depths(camera), model if everything else None)

    @property
    def not_empty(self) -> torch.Tensor:
        """(m,) numbers of the pixels whose rays may pass anything, ascending."""
        if self.empty_depths is None:
            return torch.arange(int(self.camera.height) * int(self.camera.width))
        return torch.nonzero(self.empty_depths.isfinite())[:, 0]

    def __getitem__(self, pixels: slice | torch.Tensor) -> RayBundle:
        rays = self.camera.image_rays(0, pixels)
        if self.empty_depths is not None:
            rays.metadata["empty_depths"] = self.empty_depths[pixels, None]
        if self.model is not None:
            meet_all_cells(self.model, rays)
        return rays


def meet_all_cells(model: RayModel, rays: RayBundle) -> None:
    """Let rays meet all cells that a model has, also nearer or farther off than the depths of its training views. The
    dense networks, which are sampled between these, render them as ever."""
    if model.meets_all_cells and model.grid is not None:
        empty = model.grid.empty_depth(rays.origins)[:, None] * rays.metadata["directions_norm"]
        rays.metadata.update(nears=empty, fars=torch.full_like(empty, math.inf))


def to_pictures(views: Views) -> list[Picture]:
    """All views but those of which no pixel is known."""
    masks = (None,) * len(views.names) if views.masks is None else views.masks
    return [
        Picture(name, views.images[i], views.cameras[[i]], mask)
        for i, (name, mask) in enumerate(zip(views.names, masks, strict=True))
        if mask is None or mask.any()
    ]


@torch.no_grad()
def render_outputs(model: RayModel, rays: RayBundle, keys: Collection[str]) -> dict[str, torch.Tensor]:
    """Some of the model's outputs for all rays, on the CPU, without gradients and in evaluation mode."""
    was_training = model.training
    model.eval()
    chunks = []
    for rows in model.chunks(len(rays)):
        outputs = model(rays[rows])
        chunks.append({key: outputs[key].cpu() for key in keys})
    model.train(was_training)
    return {key: torch.cat([chunk[key] for chunk in chunks]) for key in keys}


def find_surfaces(outputs: Mapping[str, torch.Tensor], far: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Of n rays' outputs (on the CPU, with rgb_fine, accumulation_fine, depth_fine and background), colors (n, 3) in
    [0, 1] and distances (n, 1), world units, of what is in front of the background; of no meaning where that is
    nothing. far: (n, 1) distances at which the background counts. FloatingPointError if one is not finite."""
    opacity = outputs["accumulation_fine"]
    colors = remove_background(outputs["rgb_fine"], opacity, outputs["background"]).clamp(0, 1)
    distance = remove_background(outputs["depth_fine"], opacity, far)
    _check_finite(colors, distance)
    return colors, distance


def render_opaque(model: RayModel, rays: RayBundle) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Colors and distances of n rays as `find_surfaces`, and the accumulated opacity (n, 1)."""
    outputs = render_outputs(model, rays, ("rgb_fine", "accumulation_fine", "depth_fine", "background"))
    far = model.config.depths[1] * rays.metadata["directions_norm"].cpu()
    return *find_surfaces(outputs, far), outputs["accumulation_fine"]


def render_rays(model: RayModel, rays: RayBundle, key: str = "rgb_fine") -> torch.Tensor:
    """One of the model's outputs, as `render_outputs`."""
    return render_outputs(model, rays, [key])[key]


def render_view(model: RayModel, picture: Picture) -> np.ndarray:
    """A view's rendering (H, W, 3) in [0, 1]; FloatingPointError if a rendered value is not finite."""
    height, width = picture.stored.shape[:2]
    rays = CameraRays.of(model, picture.camera)
    some, colors = rays.not_empty, torch.full((height * width, 3), model.config.background_level)
    for chunk in model.chunks(len(some)):  # all rays of a photo would take gigabytes
        colors[some[chunk].cpu()] = render_rays(model, rays[some[chunk]]).clamp(0, 1)
    _check_finite(colors)
    return colors.reshape(height, width, 3).numpy()


def measure_psnr(rendered: np.ndarray, picture: Picture, background_color: float) -> float:
    """PSNR of a view's rendering (H, W, 3) over the pixels that are known, in front of a gray background."""
    error = (rendered.astype(np.float64) - composite_on(picture.image, background_color)) ** 2
    return psnr(float(error.mean() if picture.mask is None else error[picture.mask].mean()))


def _check_finite(*rendered: torch.Tensor) -> None:
    if not all(values.isfinite().all() for values in rendered):
        raise FloatingPointError("the model's colors are not finite: training diverged; try a lower --optimizer.lr")
