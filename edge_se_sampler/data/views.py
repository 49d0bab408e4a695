"""One split of a scene, as every reader of a format returns it."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from edge_se_sampler.data.cameras import Cameras, find_far

NERF_SYNTHETIC_DEPTHS, NERF_SYNTHETIC_DISTANCES = (2.0, 6.0), (3.5, 4.5)
"""Between them lie NeRF's Blender scenes, and how far their cameras are from the origin, world units."""


@dataclass(frozen=True)
class Views:
    """n images and the cameras that took them."""

    names: tuple[str, ...]  # of each view, its file as the scene lists it
    images: tuple[np.ndarray, ...]  # view i: (H_i, W_i, 3|4) uint8, sRGB, straight alpha
    masks: tuple[np.ndarray, ...] | None  # view i: (H_i, W_i) bool, True where it may be trained on; None: everywhere
    cameras: Cameras  # n, float64: poses as the scene gives them, not moved or scaled
    points: tuple[np.ndarray, ...] | None = None  # view i: (m_i, 3) points of the scene that it sees, world units
    depths: tuple[float, float] | None = NERF_SYNTHETIC_DEPTHS  # near and far by the format; None: it has none
    data_format: str | None = None  # None: made in memory
    eval_every: int | None = None  # every how many images one is held out; None: the data has a split
    memory: str = ""  # what training on them takes of memory, as estimated before they were read; "": it was not

    @property
    def longest_side(self) -> int:
        """Of all images, in pixels."""
        return max(max(image.shape[:2]) for image in self.images)

    def subset(self, indices: Sequence[int]) -> Views:
        """The views of these indices, in this order."""
        masks, points = (v if v is None else tuple(v[i] for i in indices) for v in (self.masks, self.points))
        names, images = zip(*((self.names[i], self.images[i]) for i in indices), strict=True)
        cameras = self.cameras[list(indices)]
        return replace(self, names=names, images=images, masks=masks, cameras=cameras, points=points)

    def find_near(self) -> list[int]:
        """Indices of the views but those of cameras that are far from all others: they do not tell where the scene
        is."""
        far, _ = find_far(self.cameras.camera_to_worlds[:, :, 3].numpy())
        return np.flatnonzero(~far).tolist()

    def leave_out_far(self) -> Views:
        """The views of `find_near`."""
        near = self.find_near()
        return self if len(near) == len(self.names) else self.subset(near)

    def with_masks(self, masks: Sequence[np.ndarray]) -> Views:
        """The same views, to be trained on only where both `masks` and the views' own, if any, are True."""
        if self.masks is not None:
            masks = [mask & own for mask, own in zip(masks, self.masks, strict=True)]
        return replace(self, masks=tuple(masks))

    def digest(self) -> str:
        """A hash of images, masks and cameras, the latter as single precision holds them."""
        digest = hashlib.sha256()
        for array in (*self.images, *(self.masks or ())):
            digest.update(f"{array.shape}".encode())
            digest.update(np.ascontiguousarray(array).data)
        for values in vars(self.cameras).values():
            digest.update(values.float().numpy().tobytes())
        return digest.hexdigest()

    def describe(self) -> str:
        """How many views of which sizes there are, and what their alpha and masks mean, in a line."""
        sizes = " and ".join(f"{w} x {h}" for w, h in sorted({image.shape[1::-1] for image in self.images}))
        alpha = any(image.shape[2] == 4 for image in self.images)
        meanings = ["alpha (transparent is background)"] * alpha
        meanings += ["masks (outside is unknown, and not trained on)"] * (self.masks is not None)
        ordinal = {2: "nd", 3: "rd"}.get(self.eval_every or 0, "th")
        held_out = f", every {self.eval_every}{ordinal} image held out" if self.eval_every else ""
        source = f"{self.data_format}: " if self.data_format else ""
        return f"{source}{len(self.images)} views of {sizes}{held_out}; {' and '.join(meanings) or 'no masks'}"
