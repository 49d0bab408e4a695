"""How a training step's pixels are chosen: a distribution draws candidates, a selector keeps some of them.

A new strategy is one class: a `Distribution` that says how strong each pixel of an image is (or draws in a way of its
own), or a `Selector` that chooses among uniform candidates. Entered in `DISTRIBUTIONS` or `SELECTORS`, its name can
stand for `early` or `late` in the settings.

n    pixels drawn in a step; m candidates, of which n are kept
p/u  density ratio of a pixel: its probability as it was drawn over that under uniform sampling
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.errors import InputError, check_known
from edge_se_sampler.sampling.distribution import PixelTable, UniformPixels, in_threads
from edge_se_sampler.sampling.edges import edge_strength
from edge_se_sampler.sampling.error_map import ErrorMap
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.random_streams import Stream, stream
from edge_se_sampler.sampling.ranking import sample_by_rank
from edge_se_sampler.sampling.settings import SamplingSettings


@dataclass(frozen=True)
class TrainingStep:
    """What the draws of a step depend on besides the images."""

    number: int = 0
    """0, 1, 2, ..."""
    seed: int = 0
    rank: int = 0
    """This process among those of a distributed run."""
    world: int = 1
    """Processes of the run. Those that hold the same images share one draw, each taking every world-th pixel."""
    squared_error: Callable[[PixelBatch], Tensor] | None = None
    """The model's current squared errors at drawn pixels, (n,); None: there is no model to ask."""


@dataclass(frozen=True)
class PixelBatch:
    """Pixels drawn from a batch of images."""

    batch: ImageBatch
    pixels: Tensor
    """(n, 3) int64 on the CPU: position in the batch, row, column."""
    values: dict[str, Any]
    """Every per-pixel key of the batch at these pixels, and `indices` (n, 3) with absolute image numbers."""
    distribution: Distribution
    """What drew them."""
    kept_ratio: Tensor | None = None
    """(n,) how much likelier than the average candidate each was kept by a selector; None: all were kept."""

    def density_ratio(self, rows: slice = slice(None)) -> Tensor:
        """p/u of these pixels, or of some rows of them."""
        ratio = self.distribution.density_ratio(self.batch, self.pixels[rows])
        return ratio if self.kept_ratio is None else ratio.float() * self.kept_ratio[rows]

    def take(self, rows: Tensor, kept_ratio: Tensor) -> PixelBatch:
        """Only the pixels of some rows."""
        values = {key: value[rows.to(value.device)] for key, value in self.values.items()}
        return PixelBatch(self.batch, self.pixels[rows.cpu()], values, self.distribution, kept_ratio.cpu())


class SamplerPart(ABC):  # noqa: B024 (a base of three kinds of parts, each with methods of its own)
    """Part of a pixel sampler: it may learn from squared errors, and then has a state that belongs in checkpoints."""

    needs_errors: bool = False
    """Whether it is to be updated with the squared errors found at drawn pixels."""

    def update(self, drawn: PixelBatch, squared_error: Tensor, step: TrainingStep) -> None:  # noqa: B027
        """Learn from squared errors (n,) found at the drawn pixels of a step."""

    def state_dict(self) -> dict[str, Any]:
        """What was learnt."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:  # noqa: B027
        """Continue from what `state_dict` returned."""


class Distribution(SamplerPart):
    """Draws pixels in proportion to their strength, image first, pixel second.

    Tables of an image are built when it is first met, and kept: its pixels and its mask are taken to stay the same.
    """

    name: ClassVar[str]

    def __init__(self, settings: SamplingSettings) -> None:
        self.settings = settings
        self.clear()

    @abstractmethod
    def strength(self, image: np.ndarray, background_color: tuple[float, float, float]) -> np.ndarray:
        """Strength of every pixel.

        Args:
            image: (H, W, 3|4), uint8 or float in [0, 1].
            background_color: RGB in [0, 1] behind transparent pixels.

        Returns:
            (H, W) float, finite, >= 0; 0 is never drawn.
        """

    def draw(self, batch: ImageBatch, count: int, step: TrainingStep) -> PixelBatch:
        """Draw `count` pixels with replacement: from one image, or from all.

        Raises:
            InputError: there is no pixel to draw, or an image has no strengths.
        """
        rng = stream(step.seed, step.number, Stream.PIXELS)
        source, table_index, drawable = self._drawable(batch)
        if self.settings.images_per_step == "one":
            drawable = drawable[rng.integers(len(drawable), size=1)]
        # strided: a table's draws come ordered by image
        pixels = source.draw(table_index[drawable], count * step.world, rng)[step.rank :: step.world]
        pixels[:, 0] = drawable[pixels[:, 0]]
        return PixelBatch(batch, pixels, batch.gather(pixels), self)

    def density_ratio(self, batch: ImageBatch, pixels: Tensor) -> Tensor:
        """p/u (n,) of pixels (n, 3): position in the batch, row, column."""
        source, table_index = self.tables(batch)
        return source.density_ratio(table_index, pixels)

    def check_images(self, batch: ImageBatch) -> None:
        """Refuse images that nothing could be drawn from. Tables are built by that.

        Raises:
            InputError: as `draw`.
        """
        self._drawable(batch)

    def clear(self) -> None:
        """Give back the memory of the tables."""
        self._table, self._table_index = PixelTable(), dict[int, int]()

    def tables(self, batch: ImageBatch) -> tuple[UniformPixels | PixelTable, Tensor]:
        """What is drawn from, and the index of each image of the batch in it, (k,) int64.

        Raises:
            InputError: an image has no strengths.
        """
        numbers = batch.numbers.tolist()
        new = [k for k, number in enumerate(numbers) if number not in self._table_index]
        if new:
            try:
                self._table.add(in_threads(lambda k: self._valid_strength(batch, k), new))
            except ValueError as problem:
                raise InputError(str(problem)) from problem
            start = len(self._table_index)
            self._table_index.update({numbers[k]: start + i for i, k in enumerate(new)})
        return self._table, torch.tensor([self._table_index[number] for number in numbers])

    def _valid_strength(self, batch: ImageBatch, k: int) -> Tensor:
        """(H, W) strengths of the image at position k, 0 where it is masked."""
        try:
            strength = torch.from_numpy(self.strength(batch.image(k), batch.background_color))
        except ValueError as problem:
            raise InputError(f"image {int(batch.numbers[k])}: {problem}") from problem
        return strength if batch.mask is None else strength * batch.valid(k)

    def _drawable(self, batch: ImageBatch) -> tuple[UniformPixels | PixelTable, Tensor, Tensor]:
        """What `tables` returns, and the positions that have a pixel to draw, by ascending image number: hosts
        collate images in any order, and a draw should not depend on it."""
        source, table_index = self.tables(batch)
        drawable = torch.nonzero(source.drawable(table_index))[:, 0]
        drawable = drawable[torch.argsort(batch.numbers.cpu()[drawable])]
        if not len(drawable):
            raise InputError(f"strategy {self.name!r}: every pixel that it could draw is masked in all images")
        return source, table_index, drawable


class Uniform(Distribution):
    """All pixels alike (equation 2)."""

    name = "uniform"

    @property
    def box_fraction(self) -> float:
        """Side of the centred box that is drawn from, as a share of the image's side."""
        return 1.0

    def strength(self, image: np.ndarray, background_color: tuple[float, float, float]) -> np.ndarray:
        """1 inside of the box, 0 outside."""
        size = image.shape[:2]
        inside = np.zeros(size, dtype=np.float32)
        box = UniformPixels([size], self.box_fraction)
        (top, left), (height, width) = box.low[0].int().tolist(), box.extent[0].int().tolist()
        inside[top : top + height, left : left + width] = 1
        return inside

    def tables(self, batch: ImageBatch) -> tuple[UniformPixels | PixelTable, Tensor]:
        """Without masks no table is needed."""
        if batch.mask is not None:
            return super().tables(batch)
        return UniformPixels(batch.sizes, self.box_fraction), torch.arange(len(batch.sizes))

    def density_ratio(self, batch: ImageBatch, pixels: Tensor) -> Tensor:
        """1, within the box."""
        return torch.ones(len(pixels), dtype=torch.float64)


class Precrop(Uniform):
    """All pixels of the centred box alike (equation 3)."""

    name = "precrop"

    @property
    def box_fraction(self) -> float:
        """The setting."""
        return self.settings.precrop_fraction


class Edge(Distribution):
    """In proportion to edge strength + epsilon (equations 4 and 5)."""

    name = "edge"

    def strength(self, image: np.ndarray, background_color: tuple[float, float, float]) -> np.ndarray:
        """|E| + epsilon.

        Raises:
            ValueError: a malformed image, or alpha edges of an image without alpha.
        """
        settings = self.settings
        edges = edge_strength(
            image, edge_filter=settings.edge_filter, source=settings.edge_source, background=background_color
        )
        return edges + np.float32(settings.edge_epsilon)


class Selector(SamplerPart):
    """Chooses the pixels to train on among candidates that a distribution has drawn."""

    name: ClassVar[str]
    candidates_per_pixel: int = 1
    """Candidates to draw for each pixel that is trained on."""

    def __init__(self, settings: SamplingSettings) -> None:
        self.settings = settings

    @abstractmethod
    def select(self, candidates: PixelBatch, count: int, step: TrainingStep) -> PixelBatch:
        """`count` of the candidates.

        Raises:
            FloatingPointError: a candidate's squared error is not finite.
        """


class KeepAll(Selector):
    """Every candidate is trained on."""

    name = "all"

    def select(self, candidates: PixelBatch, count: int, step: TrainingStep) -> PixelBatch:
        """The candidates."""
        return candidates


class RankedError(Selector):
    """By the rank of the squared error (equations 6 and 7): the model's, rendered for this, or the error map's."""

    name = "se"

    def __init__(self, settings: SamplingSettings) -> None:
        super().__init__(settings)
        self.candidates_per_pixel = settings.se_candidates
        self.error_map = ErrorMap() if settings.error_source == "cached" else None
        self.needs_errors = self.error_map is not None

    def select(self, candidates: PixelBatch, count: int, step: TrainingStep) -> PixelBatch:
        """`count` of the candidates, without replacement, in proportion to the rank of their squared error."""
        if self.error_map is not None:
            self.error_map.add(candidates.batch.sizes_by_number)
            errors = self.error_map.lookup(candidates.values["indices"].cpu().numpy(), step.number, count)
            errors = torch.from_numpy(errors)
        else:
            assert step.squared_error is not None
            errors = step.squared_error(candidates)
        selection = sample_by_rank(errors, count, stream(step.seed, step.number, Stream.SELECTION, step.rank))
        return candidates.take(selection.rows, selection.inclusion / (count / len(errors)))

    def update(self, drawn: PixelBatch, squared_error: Tensor, step: TrainingStep) -> None:
        """Enter the errors into the map."""
        assert self.error_map is not None
        self.error_map.add(drawn.batch.sizes_by_number)
        errors = squared_error.double().cpu().numpy()
        self.error_map.update(drawn.values["indices"].cpu().numpy(), errors, step.number)

    def state_dict(self) -> dict[str, Any]:
        """The error map's."""
        return {} if self.error_map is None else self.error_map.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        if self.error_map is not None:
            self.error_map.load_state_dict(state)


DISTRIBUTIONS: dict[str, type[Distribution]] = {kind.name: kind for kind in (Uniform, Precrop, Edge)}
"""By the name that `early` and `late` give them."""
SELECTORS: dict[str, type[Selector]] = {RankedError.name: RankedError}
"""By the name that `early` and `late` give them; their candidates are uniform."""


class Strategy(NamedTuple):
    """One way of choosing pixels."""

    distribution: Distribution
    selector: Selector


def build_strategies(settings: SamplingSettings) -> dict[str, Strategy]:
    """The early and the late strategy, and the uniform one, by their names; uniform tables are shared.

    Raises:
        InputError: an unknown name.
    """
    uniform = Uniform(settings)
    strategies = {Uniform.name: Strategy(uniform, KeepAll(settings))}
    for name in (settings.early, settings.late):
        check_known("pixel-sampler", [name], (*DISTRIBUTIONS, *SELECTORS))
        if name in SELECTORS:
            strategies[name] = Strategy(uniform, SELECTORS[name](settings))
        elif name not in strategies:
            strategies[name] = Strategy(DISTRIBUTIONS[name](settings), KeepAll(settings))
    return strategies
