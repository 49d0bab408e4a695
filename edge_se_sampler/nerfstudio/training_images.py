"""nerfstudio's training images as lean-nerf needs them: with their alpha, and as pinholes would have seen them."""
# pyright: reportMissingImports=false
# nerfstudio's pins rule out the environment that is linted; here its classes count as unknown

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.data.lens import Intrinsics, Lens, find_pinhole, find_sources, undistort
from edge_se_sampler.data.views import Views
from edge_se_sampler.errors import InputError

REMEDY = "undistort the images first (COLMAP's image_undistorter), or take another method"


class TrainingImages(InputDataset):
    """nerfstudio's images, their lens distortion undone: so a silhouette's projection is right, and rays need no search
    for where a lens bent them. Among RGBA images RGB ones get opaque alpha.

    Raises:
        InputError: a camera that is no perspective one, or distorts by a fourth radial coefficient.
    """

    def __init__(self, dataparser_outputs: Any, scale_factor: float = 1.0) -> None:
        super().__init__(dataparser_outputs, scale_factor)
        self.mask_color = None  # it would be painted where nothing is trained on
        self.hit_pixels: list[np.ndarray] | None = None
        """(H, W) bool of each image: the pixels that are worth training on; others count as masked."""
        self._lenses = _read_lenses(self.cameras)
        sizes = zip(self.cameras.width.flatten().tolist(), self.cameras.height.flatten().tolist(), strict=True)
        pinholes = [find_pinhole(camera, *size) for camera, size in zip(self._lenses, sizes, strict=True)]
        self.cameras.fx, self.cameras.fy = (
            torch.tensor([[getattr(camera, name)] for camera in pinholes]) for name in ("fx", "fy")
        )
        self.cameras.distortion_params = None

    def get_numpy_image(self, image_idx: int) -> np.ndarray:
        """(H, W, 3|4) uint8, alpha straight."""
        image = super().get_numpy_image(image_idx)
        if self._some_have_alpha and image.shape[2] == 3:
            image = np.concatenate((image, np.full_like(image[:, :, :1], 255)), axis=2)
        return self._undistort(image, image_idx)

    @cached_property
    def _some_have_alpha(self) -> bool:
        return any(_has_alpha(path) for path in self.image_filenames)

    def keep_alpha(self) -> None:
        """From now on give images with their alpha, as training wants them, instead of composited on a color."""
        self._dataparser_outputs = replace(self._dataparser_outputs, alpha_color=None)

    def get_metadata(self, data: dict[str, Any]) -> dict[str, Any]:
        """The mask, if there is one, as a pinhole would have seen it: where all of a pixel may be trained on."""
        masks = [] if self.hit_pixels is None else [self.hit_pixels[data["image_idx"]]]
        if "mask" in data:
            mask = data["mask"][..., 0].numpy().astype(np.uint8) * 255
            masks.append(self._undistort(mask, data["image_idx"]) == 255)
        return {"mask": torch.from_numpy(np.all(masks, axis=0))[..., None]} if masks else {}

    def read_views(self) -> Views:
        """All images with what the scene's cells are derived from: cameras, masks, and points if the data parser has
        any; else the middles of its scene box's faces, unless alpha tells more, or cameras are in the box, which see
        beyond it."""
        with ThreadPoolExecutor() as pool:
            data = list(pool.map(lambda i: self.get_data(i, "uint8"), range(len(self))))
        images = tuple(entry["image"].numpy() for entry in data)
        masks = tuple(entry["mask"][..., 0].numpy() for entry in data) if "mask" in data[0] else None
        intrinsics = {name: getattr(self.cameras, name)[:, 0].numpy() for name in ("fx", "fy", "cx", "cy")}
        size = {name: getattr(self.cameras, name)[:, 0].numpy() for name in ("width", "height")}
        cameras = Cameras.of(self.cameras.camera_to_worlds.numpy(), **intrinsics, **size)
        points = None
        if "points3D_xyz" in self.metadata:
            points = _seen(cameras, self.metadata["points3D_xyz"].double())
        elif all(image.shape[2] == 3 for image in images):
            low, high = self.scene_box.aabb.double()
            if not self.scene_box.within(cameras.camera_to_worlds[:, :, 3]).any():
                faces = (low + high) / 2 + torch.cat((torch.eye(3), -torch.eye(3))) * (high - low) / 2
                points = (faces.numpy(),) * len(images)
        names = tuple(path.name for path in self.image_filenames)
        return Views(names, images, masks, cameras, points, depths=None)

    def _undistort(self, values: np.ndarray, image_idx: int) -> np.ndarray:
        camera = self._lenses[image_idx]
        if camera.lens is None:
            return values
        sources, inside = _sources(camera, *values.shape[1::-1])
        if not inside.all():
            raise InputError(f"{self.image_filenames[image_idx]}: no pinhole shows what its lens does; {REMEDY}")
        return undistort(values, sources, inside)


@lru_cache(maxsize=4)
def _sources(camera: Intrinsics, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    return find_sources(camera, find_pinhole(camera, width, height), width, height)


def _has_alpha(path: Path) -> bool:
    with Image.open(path) as image:
        return image.mode == "RGBA"


def _read_lenses(cameras: Any) -> list[Intrinsics]:
    """The cameras of nerfstudio as ours."""
    if not (cameras.camera_type == CameraType.PERSPECTIVE.value).all():
        raise InputError(f"lean-nerf needs perspective cameras to find the scene's cells; {REMEDY}")
    distortion = torch.zeros(6) if cameras.distortion_params is None else cameras.distortion_params
    terms = torch.cat((cameras.fx, cameras.fy, cameras.cx, cameras.cy, distortion.expand(len(cameras), 6)), dim=1)
    found = []
    for fx, fy, cx, cy, k1, k2, k3, k4, p1, p2 in terms.tolist():
        if k4:
            raise InputError(f"the cameras have a fourth radial coefficient, k4, which cannot be undone; {REMEDY}")
        lens = Lens(False, (k1, k2, p1, p2, k3))
        found.append(Intrinsics(fx, fy, cx, cy, lens if any(lens.coefficients) else None))
    return found


def _seen(cameras: Cameras, points: torch.Tensor) -> tuple[np.ndarray, ...]:
    """(m_i, 3) of the points (m, 3), for each camera those that its image shows."""
    found = []
    for i in range(len(cameras)):
        coords, depth = cameras.project(i, points)
        size = torch.cat((cameras.height[i], cameras.width[i]))
        found.append(points[(depth > 0) & ((coords >= 0) & (coords <= size)).all(dim=1)].numpy())
    return tuple(found)
