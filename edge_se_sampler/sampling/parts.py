"""The parts of a pixel sampler: a distribution draws candidates, a selector keeps some of them.

p/u  density ratio of a pixel: its probability as it was drawn over that under uniform sampling
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.errors import InputError
from edge_se_sampler.sampling.cells import CellTable
from edge_se_sampler.sampling.distribution import PixelTable, UniformPixels, in_threads
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.random_streams import Stream, stream
from edge_se_sampler.sampling.region_table import RegionTable
from edge_se_sampler.sampling.settings import SamplingSettings

PixelSource = UniformPixels | PixelTable | CellTable | RegionTable


@dataclass(frozen=True)
class TrainingStep:
    """What the draws of a step depend on besides the images."""

    number: int = 0  # 0, 1, 2, ...
    seed: int = 0
    rank: int = 0
    """This process among `world` of a distributed run. They share one draw, each taking every world-th pixel."""
    world: int = 1
    squared_error: Callable[[PixelBatch], Tensor] | None = None
    """The model's current squared errors at drawn pixels, (n,); None: there is no model to ask."""


@dataclass(frozen=True)
class PixelBatch:
    """Pixels drawn from a batch of images."""

    batch: ImageBatch
    pixels: Tensor
    """(n, 3) int64 on the CPU: position in the batch, row, column."""
    distribution: Distribution  # what drew them
    kept_ratio: Tensor | None = None
    """(n,) how much likelier than the average candidate each was kept by a selector; None: all were kept."""
    drawn_ratio: Tensor | None = None
    """(n,) p/u, of a distribution that will have changed when it is asked for."""
    loss_weight: Tensor | None = None
    """(n,) float32 loss weights that belong to the distribution's rule."""

    @cached_property
    def values(self) -> dict[str, Any]:
        """What `ImageBatch.gather` returns at these pixels."""
        return self.batch.gather(self.pixels)

    def density_ratio(self, rows: slice = slice(None)) -> Tensor:
        """(n,) p/u of these pixels, or of some rows of them."""
        known, pixels = self.drawn_ratio, self.pixels[rows]
        ratio = self.distribution.density_ratio(self.batch, pixels) if known is None else known[rows]
        return ratio if self.kept_ratio is None else ratio.float() * self.kept_ratio[rows]

    def take(self, rows: Tensor, kept_ratio: Tensor) -> PixelBatch:
        """Only the pixels of some rows."""
        taken = PixelBatch(self.batch, self.pixels[rows.cpu()], self.distribution, kept_ratio.cpu())
        if "values" in vars(self):  # they are gathered already
            vars(taken)["values"] = {key: value[rows.to(value.device)] for key, value in self.values.items()}
        return taken


class SamplerPart:
    """Part of a pixel sampler: it may learn from squared errors, and then has a state that belongs in checkpoints."""

    needs_errors: bool = False
    """Whether it is to be updated."""

    def update(self, drawn: PixelBatch, squared_error: Tensor, step: TrainingStep) -> None:
        """Learn from squared errors (n,) found at the drawn pixels of a step."""

    def state_dict(self) -> dict[str, Any]:
        """What was learnt, in what a checkpoint may hold: tensors, numbers, texts, None, lists and dicts of these."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""


class Distribution(SamplerPart):
    """Draws pixels in proportion to their strength, image first, pixel second. An image's table is built when it is
    first met, and kept: its pixels and its mask are taken to stay the same. A subclass defines `strength`, or draws
    from `tables` of its own."""

    name: ClassVar[str]
    new_table: ClassVar[type[PixelTable | RegionTable]] = PixelTable
    """What its pixels are drawn from."""

    def __init__(self, settings: SamplingSettings) -> None:
        self.settings = settings
        self.clear()

    def strength(self, image: np.ndarray, background_color: tuple[float, float, float]) -> np.ndarray:
        """Strength of every pixel: (H, W) float, finite, >= 0; 0 is never drawn.

        Args:
            image: (H, W, 3|4), uint8 or float in [0, 1].
            background_color: RGB in [0, 1] behind transparent pixels.
        """
        raise NotImplementedError

    def draw(self, batch: ImageBatch, count: int, step: TrainingStep) -> PixelBatch:
        """Draw `count` pixels with replacement, from one image or from all; raises as `drawable`. If it learns, their
        p/u is kept."""
        rng = stream(step.seed, step.number, Stream.PIXELS)
        source, table_index, drawable = self.drawable(batch)
        if self.settings.images_per_step == "one":
            drawable = drawable[rng.integers(len(drawable), size=1)]
        # strided: a table's draws come ordered by image
        pixels = source.draw(table_index[drawable], count * step.world, rng)[step.rank :: step.world]
        pixels[:, 0] = drawable[pixels[:, 0]]
        drawn_ratio = self.density_ratio(batch, pixels) if self.needs_errors else None
        return PixelBatch(batch, pixels, self, drawn_ratio=drawn_ratio)

    def density_ratio(self, batch: ImageBatch, pixels: Tensor) -> Tensor:
        """p/u (n,) of pixels (n, 3): position in the batch, row, column."""
        source, table_index = self.tables(batch)
        return source.density_ratio(table_index, pixels)

    def clear(self) -> None:
        """Give back the memory of the tables."""
        self._table, self._table_index = type(self).new_table(), dict[int, int]()

    def tables(self, batch: ImageBatch) -> tuple[PixelSource, Tensor]:
        """What is drawn from, and the index of each image of the batch in it, (k,) int64. InputError: an image has no
        strengths."""
        numbers = batch.numbers.tolist()
        new = [k for k, number in enumerate(numbers) if number not in self._table_index]
        if new:
            try:
                self._table.add(in_threads(lambda k: self._named_strength(batch, k), new))
            except ValueError as problem:
                raise InputError(str(problem)) from problem
            start = len(self._table_index)
            self._table_index.update({numbers[k]: start + i for i, k in enumerate(new)})
        return self._table, torch.tensor([self._table_index[number] for number in numbers])

    def _named_strength(self, batch: ImageBatch, k: int) -> Tensor:
        """What `_valid_strength` returns; InputError, naming the image, for its ValueError."""
        try:
            return self._valid_strength(batch, k)
        except ValueError as problem:
            raise InputError(f"image {int(batch.numbers[k])}: {problem}") from problem

    def _valid_strength(self, batch: ImageBatch, k: int) -> Tensor:
        """(H, W) strengths of the image at position k, 0 where it is masked; raises as `strength`, and ValueError where
        there are not as many as pixels."""
        image = batch.image(k)
        strength = torch.from_numpy(self.strength(image, batch.background_color))
        if strength.shape != image.shape[:2]:
            raise ValueError(f"its strengths are {tuple(strength.shape)}, and its pixels {image.shape[:2]}")
        return strength if batch.mask is None else strength * batch.valid(k)

    def drawable(self, batch: ImageBatch) -> tuple[PixelSource, Tensor, Tensor]:
        """What `tables` returns, and the positions of images with a pixel to draw, by ascending image number: hosts
        collate images in any order, and a draw should not depend on it. InputError: there is no pixel to draw, or an
        image has no strengths."""
        source, table_index = self.tables(batch)
        drawable = torch.nonzero(source.drawable(table_index))[:, 0]
        drawable = drawable[torch.argsort(batch.numbers.cpu()[drawable])]
        if not len(drawable):
            raise InputError(f"strategy {self.name!r}: every pixel that it could draw is masked in all images")
        return source, table_index, drawable


class Selector(SamplerPart):
    """Chooses the pixels to train on among candidates that a distribution has drawn; this one keeps them all."""

    candidates_per_pixel: int = 1
    """Candidates to draw for each pixel that is trained on."""

    def __init__(self, settings: SamplingSettings) -> None:
        self.settings = settings

    def select(self, candidates: PixelBatch, count: int, step: TrainingStep) -> PixelBatch:
        """`count` of the candidates. Raises FloatingPointError if a squared error is not finite."""
        return candidates
