"""The paper's strategies, and how a sampler's are built by their names in the `registry`."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.errors import InputError
from edge_se_sampler.sampling.distribution import UniformPixels
from edge_se_sampler.sampling.edges import edge_strength
from edge_se_sampler.sampling.error_map import ErrorMap
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.parts import Distribution, PixelBatch, PixelSource, Selector, TrainingStep
from edge_se_sampler.sampling.random_streams import Stream, stream
from edge_se_sampler.sampling.ranking import sample_by_rank
from edge_se_sampler.sampling.registry import PIXEL_STRATEGIES
from edge_se_sampler.sampling.settings import SamplingSettings


class Uniform(Distribution):
    """All pixels alike (equation 2)."""

    name = "uniform"
    box_fraction = 1.0
    """Side of the centered box that is drawn from, as a share of the image's side."""

    def strength(self, image: np.ndarray, background_color: tuple[float, float, float]) -> np.ndarray:
        """1 inside of the box, 0 outside."""
        size = image.shape[:2]
        inside = np.zeros(size, dtype=np.float32)
        box = UniformPixels([size], self.box_fraction)
        (top, left), (height, width) = box.low[0].int().tolist(), box.extent[0].int().tolist()
        inside[top : top + height, left : left + width] = 1
        return inside

    def tables(self, batch: ImageBatch) -> tuple[PixelSource, Tensor]:
        """Without masks no table is needed."""
        if batch.mask is not None:
            return super().tables(batch)
        return UniformPixels(batch.sizes, self.box_fraction), torch.arange(len(batch.sizes))


class Precrop(Uniform):
    """All pixels of the centered box alike (equation 3)."""

    name = "precrop"

    def __init__(self, settings: SamplingSettings) -> None:
        super().__init__(settings)
        self.box_fraction = settings.precrop_fraction


class Edge(Distribution):
    """In proportion to edge strength + epsilon (equations 4 and 5)."""

    name = "edge"

    def strength(self, image: np.ndarray, background_color: tuple[float, float, float]) -> np.ndarray:
        """|E| + epsilon; raises as `edge_strength`."""
        edge_filter, source = self.settings.edge_filter, self.settings.edge_source
        edges = edge_strength(image, edge_filter=edge_filter, source=source, background=background_color)
        return edges + np.float32(self.settings.edge_epsilon)


class RankedError(Selector):
    """By the rank of the squared error (equations 6 and 7): the model's, rendered for this, or the error map's."""

    def __init__(self, settings: SamplingSettings) -> None:
        super().__init__(settings)
        self.candidates_per_pixel = settings.se_candidates
        self.error_map = ErrorMap() if settings.error_source == "cached" else None
        self.needs_errors = self.error_map is not None

    def select(self, candidates: PixelBatch, count: int, step: TrainingStep) -> PixelBatch:
        """`count` of the candidates, without replacement, in proportion to the rank of their squared error."""
        if self.error_map is not None:
            self.error_map.add(candidates.batch.sizes_by_number)
            pixels = candidates.batch.indices(candidates.pixels).numpy()
            errors = torch.from_numpy(self.error_map.lookup(pixels, step.number, count))
        else:
            assert step.squared_error is not None
            errors = step.squared_error(candidates)
        selection = sample_by_rank(errors, count, stream(step.seed, step.number, Stream.SELECTION, step.rank))
        return candidates.take(selection.rows, selection.inclusion / (count / len(errors)))

    def update(self, drawn: PixelBatch, squared_error: Tensor, step: TrainingStep) -> None:
        """Enter the errors into the map."""
        assert self.error_map is not None
        self.error_map.add(drawn.batch.sizes_by_number)
        pixels, errors = drawn.values["indices"].cpu().numpy(), squared_error.cpu().double().numpy()
        self.error_map.update(pixels, errors, step.number)

    def state_dict(self) -> dict[str, Any]:
        """The error map's."""
        return {} if self.error_map is None else self.error_map.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        if self.error_map is not None:
            self.error_map.load_state_dict(state)


class Strategy(NamedTuple):
    """One way of choosing pixels."""

    distribution: Distribution
    selector: Selector


def build_strategies(settings: SamplingSettings) -> dict[str, Strategy]:
    """The early and the late strategy, and the uniform one, by their names; uniform tables are shared. InputError: a
    class that cannot be imported, or is neither a `Distribution` nor a `Selector`."""
    uniform = Uniform(settings)
    strategies = {Uniform.name: Strategy(uniform, Selector(settings))}
    for name in (settings.early, settings.late):
        if name not in strategies:
            part = PIXEL_STRATEGIES[name].load()(settings)
            if isinstance(part, Distribution):
                strategies[name] = Strategy(part, Selector(settings))
            elif isinstance(part, Selector):
                strategies[name] = Strategy(uniform, part)
            else:
                raise InputError(f"pixel strategy {name!r}: {type(part).__name__} is no Distribution and no Selector")
    return strategies
