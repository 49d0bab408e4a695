"""A host's batch of images, stacked or in lists, read alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.sampling.edges import WHITE


@dataclass(frozen=True)
class ImageBatch:
    """A batch of k images, which may differ in size, and whatever else it holds for each pixel."""

    numbers: Tensor
    """(k,) int64: absolute image numbers."""
    sizes: list[tuple[int, int]]  # rows and columns
    per_pixel: dict[str, Any]
    """Key -> k tensors (H, W, ...), stacked or in a list; "image" among them."""
    mask: Any
    """k tensors (H, W, 1), non-zero where a pixel may be drawn; None: everywhere."""
    background_color: tuple[float, float, float] = WHITE
    """RGB in [0, 1] behind transparent pixels."""

    @classmethod
    def of(
        cls, image_batch: dict[str, Any], *, use_mask: bool, background_color: tuple[float, float, float] = WHITE
    ) -> ImageBatch:
        """Read a host's batch, see the protocol's `PixelSampler.sample`. ValueError: a key that is neither stacked (k,
        H, W, ...) nor a list of k (H, W, ...), or another number of image numbers."""
        per_pixel = {key: value for key, value in image_batch.items() if key != "image_idx" and value is not None}
        sizes = _sizes(image_batch["image"])
        if len(image_batch["image_idx"]) != len(sizes):
            raise ValueError(f"image batch: {len(image_batch['image_idx'])} image_idx for {len(sizes)} images")
        for key, value in per_pixel.items():
            if _sizes(value) != sizes:
                raise ValueError(f"image batch: {key!r} has not one (H, W, ...) tensor for each image")
        mask = per_pixel.get("mask") if use_mask else None
        return cls(image_batch["image_idx"], sizes, per_pixel, mask, background_color)

    @property
    def sizes_by_number(self) -> dict[int, tuple[int, int]]:
        """Image number -> rows, columns."""
        return dict(zip(self.numbers.tolist(), self.sizes, strict=True))

    @property
    def device(self) -> torch.device:
        """Where the images are."""
        return self.per_pixel["image"][0].device

    def image(self, k: int) -> np.ndarray:
        """Image at position k, (H, W, 3|4), as it is stored."""
        return self.per_pixel["image"][k].cpu().numpy()

    def valid(self, k: int) -> Tensor:
        """(H, W) bool on the CPU: the pixels at position k that may be drawn."""
        return self.mask[k].reshape(self.sizes[k]).bool().cpu()

    def gather(self, drawn: Tensor) -> dict[str, Any]:
        """Every per-pixel key at drawn pixels, and `indices` (n, 3) int64: absolute image number, row, column.

        Args:
            drawn: (n, 3) int64: position in the batch, row, column.
        """
        pixels = {key: self._pick(value, drawn.to(value[0].device)) for key, value in self.per_pixel.items()}
        pixels["indices"] = self.indices(drawn).to(self.device)
        return pixels

    def indices(self, drawn: Tensor) -> Tensor:
        """(n, 3) int64 absolute image number, row, column of pixels (n, 3): position in the batch, row, column."""
        return torch.cat((self.numbers.to(drawn.device)[drawn[:, :1]], drawn[:, 1:]), dim=1)

    @staticmethod
    def _pick(value: Any, drawn: Tensor) -> Tensor:
        position, row, column = drawn.unbind(1)
        if isinstance(value, Tensor) and value.is_contiguous():  # a third of the time of three indices
            _, height, width, *_ = value.shape
            return value.flatten(0, 2).index_select(0, (position * height + row) * width + column)
        if isinstance(value, Tensor):
            return value[position, row, column]
        picked = value[0].new_empty((len(drawn), *value[0].shape[2:]))
        for k in torch.unique(position).tolist():  # ragged: image by image
            here = position == k
            picked[here] = value[k][row[here], column[here]]
        return picked


def unit_interval(image: Tensor) -> Tensor:
    """Pixels as float in [0, 1]; uint8 is divided by 255, which rounds otherwise than the product in `unit_float`."""
    return image.float() / 255 if image.dtype == torch.uint8 else image


def _sizes(images: Any) -> list[tuple[int, int]]:
    """Rows and columns of k images, stacked or in a list; nothing for what holds no images."""
    if isinstance(images, Tensor):
        return [(images.shape[1], images.shape[2])] * len(images) if images.ndim >= 3 else []
    if not isinstance(images, list) or not all(isinstance(image, Tensor) and image.ndim >= 2 for image in images):
        return []
    return [(image.shape[0], image.shape[1]) for image in images]
