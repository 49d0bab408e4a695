"""One split of a scene, as every reader of a format returns it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from edge_se_sampler.data.cameras import Cameras


@dataclass(frozen=True)
class Views:
    """n images and the cameras that took them."""

    names: tuple[str, ...]  # of each view, its file as the scene lists it
    images: tuple[np.ndarray, ...]  # view i: (H_i, W_i, 3|4) uint8, sRGB, straight alpha
    masks: tuple[np.ndarray, ...] | None  # view i: (H_i, W_i) bool, True where it may be trained on; None: everywhere
    cameras: Cameras  # n, float64: poses as the scene gives them, not moved or scaled

    def subset(self, indices: Sequence[int]) -> Views:
        """The views of these indices, in this order."""
        masks = None if self.masks is None else tuple(self.masks[i] for i in indices)
        names, images = zip(*((self.names[i], self.images[i]) for i in indices), strict=True)
        return Views(names, images, masks, self.cameras[list(indices)])

    def with_masks(self, masks: Sequence[np.ndarray]) -> Views:
        """The same views, to be trained on only where both `masks` and the views' own, if any, are True."""
        if self.masks is not None:
            masks = [mask & own for mask, own in zip(masks, self.masks, strict=True)]
        return replace(self, masks=tuple(masks))
