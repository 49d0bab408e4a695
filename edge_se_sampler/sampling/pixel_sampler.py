"""The sampling class: edges, distributions, ranking and schedule under any host's PixelSampler.

`ImportantPixels` is a mixin: put before a host's PixelSampler it decides which pixels are drawn and gathers them;
the base contributes only its config and batch size. It is the same code under our protocol's base and under
nerfstudio's, and draws the same pixels there.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.errors import InputError
from edge_se_sampler.protocol import PixelSampler
from edge_se_sampler.sampling.background import PlainBackgrounds, summed_up
from edge_se_sampler.sampling.distribution import PixelTable, UniformPixels, in_threads
from edge_se_sampler.sampling.edges import WHITE, edge_strength
from edge_se_sampler.sampling.error_map import ErrorMap
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.random_streams import Stream, stream
from edge_se_sampler.sampling.ranking import sample_by_rank
from edge_se_sampler.sampling.schedule import AdaptiveSchedule, phase_at

SquaredError = Callable[[dict[str, Any]], Tensor]
"""Candidate batch -> (m,) squared errors of the model's current (fine) colours, without gradients."""


WATCHED = 256
"""Pixels of a step that the watch looks at, at most twice as many: they tell enough, in a third of a millisecond."""


@dataclass
class _Tables:
    """The finished tables of one way of drawing, keyed by absolute image number: an image's pixels and mask are taken
    to stay what they were when it was first seen."""

    table: PixelTable
    place: dict[int, int]


class ImportantPixels:
    """Mixin over a host's PixelSampler: Random, Precrop, Edge, then Random or squared error.

    Unbound (in evaluation, viewers, exporters) it draws uniformly. `bind` and `set_step` make it follow training;
    the data manager calls them. Masked pixels are never drawn.
    """

    config: Any  # SamplingSettings and the host's PixelSamplerConfig in one
    num_rays_per_batch: int

    def __init__(self, config: Any, **kwargs: Any) -> None:
        # hosts share one config between training and evaluation, and write into it
        super().__init__(copy.copy(config).resolve_auto(), **kwargs)  # pyright: ignore[reportCallIssue]
        self.config.check()
        # RGB that edges are taken in front of; fixed once a table of edges exists
        self.background: tuple[float, float, float] = kwargs.get("background_color") or WHITE
        self._squared_error: SquaredError | None = None
        self._early_steps = 0.0
        self._seed = 0
        self._step = 0
        self._rank, self._world = 0, 1
        self.watch: AdaptiveSchedule | None = None
        """Decides the phase under schedule "adaptive"."""
        self.pending_batch: dict[str, Any] | None = None
        """The last batch's pixels, until their errors are observed, if somebody wants to know them."""
        self.memory: ErrorMap | None = None
        """Scores candidates with error_source "cached"."""
        self._backgrounds = PlainBackgrounds()
        self._tables: dict[str, _Tables] = {}

    def bind(
        self, *, squared_error: SquaredError, planned_steps: int, seed: int, rank: int = 0, world: int = 1
    ) -> None:
        """Follow a training run.

        Args:
            squared_error: scores candidates, see `SquaredError`.
            planned_steps: length of the run as first planned; resuming does not change it.
            seed: of the draws.
            rank: of this process among `world` of a distributed run. Ranks that hold the same images take every
                world-th row of one draw of world x N pixels (of candidates, of which each then keeps its own N).
        """
        self._squared_error = squared_error
        self.watch = AdaptiveSchedule() if self.config.schedule == "adaptive" else None
        remembers = self.config.late == "se" and self.config.error_source == "cached"
        self.memory = ErrorMap() if remembers else None
        self._early_steps = self.config.early_length(planned_steps)
        self._seed = seed
        self._rank, self._world = rank, world

    def set_step(self, step: int) -> None:
        """The step about to be trained; draws depend on it alone, and so does the phase of a fixed schedule."""
        self._step = step

    def observe(self, squared_error: Tensor) -> None:
        """What training found at the pixels of the last batch: the adaptive schedule and cached errors follow from it.

        Args:
            squared_error: (n,) of the model's (fine) colours.
        """
        if self.pending_batch is None:
            return
        pixels, self.pending_batch = self.pending_batch, None
        if self.memory is not None:
            found = squared_error.detach().double().cpu().numpy()
            self.memory.note(pixels["indices"].cpu().numpy(), found, self._step)
        if self.watch is None:
            return
        rows = slice(None, None, max(1, len(squared_error) // WATCHED))
        image, numbers = pixels["image"][rows].cpu().numpy(), pixels["indices"][rows, 0].cpu().numpy()
        distance = self._backgrounds.squared_distance(image, numbers, self.background)
        relative = pixels["edges"].relative(pixels["places"], pixels["drawn"][rows]).numpy()
        error = squared_error.detach()[rows].float().cpu().numpy()
        kept = 1.0 if pixels["kept"] is None else pixels["kept"][rows].numpy()
        self.watch.observe(*summed_up(error, distance, relative, by_edge=self.strategy == "edge", kept=kept))

    def state_dict(self) -> dict[str, Any]:
        """What later draws depend on besides the step, for a checkpoint."""
        parts = {"watch": self.watch, "memory": self.memory}
        return {name: part.state() for name, part in parts.items() if part is not None}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        if self.watch is not None:
            self.watch.load(state["watch"])
        if self.memory is not None:
            self.memory.load(state["memory"])

    @property
    def is_bound(self) -> bool:
        """Whether it is bound to a run."""
        return self._squared_error is not None

    @property
    def strategy(self) -> str:
        """How the current step draws: "uniform", "precrop", "edge" or "se"."""
        if not self.is_bound:
            return "uniform"
        phase = phase_at(self._step, self._early_steps) if self.watch is None else self.watch.phase
        return self.config.early if phase == "early" else self.config.late

    def strength(self, strategy: str, image: np.ndarray) -> np.ndarray:
        """Strength of every pixel under a strategy that weighs them; a seventh way overrides this.

        Args:
            image: (H, W, 3|4), uint8 or float in [0, 1].

        Returns:
            (H, W) float32, >= 0.
        """
        if strategy == "edge":
            edges = edge_strength(
                image,
                edge_filter=self.config.edge_filter,
                source=self.config.edge_source,
                background=self.background,
            )
            return edges + np.float32(self.config.edge_epsilon)
        if strategy not in ("uniform", "precrop"):
            raise ValueError(f"strategy {strategy!r} has no strengths; known are uniform, precrop and edge")
        size = image.shape[:2]
        inside = np.zeros(size, dtype=np.float32)
        box = UniformPixels([size], self._box_side(strategy))
        (top, left), (height, width) = box.low[0].int().tolist(), box.extent[0].int().tolist()
        inside[top : top + height, left : left + width] = 1
        return inside

    def check_images(self, image_batch: dict[str, Any]) -> None:
        """Refuse images that a phase could draw nothing from, before training; its tables are built by that.

        Raises:
            InputError: as `sample`.
        """
        batch = ImageBatch.of(image_batch, use_mask=not self.config.ignore_mask)
        for strategy in {self.config.early, "uniform"}:
            self._drawable(batch, strategy)

    def sample(self, image_batch: dict[str, Any]) -> dict[str, Any]:
        """Choose the step's pixels; see the protocol's PixelSampler.sample.

        The batch also has `weight` (N,) when importance weights are asked for.

        Raises:
            InputError: every pixel of every image is masked, or alpha edges of images without alpha.
            FloatingPointError: a candidate's squared error is not finite.
        """
        batch = ImageBatch.of(image_batch, use_mask=not self.config.ignore_mask)
        strategy, count = self.strategy, self.num_rays_per_batch
        if self.memory is not None:
            self.memory.add(dict(zip(batch.numbers.tolist(), batch.sizes, strict=True)))
        if not self.is_bound:
            self._step += 1  # nobody tells an unbound sampler the step: it counts its own calls
        for over in set(self._tables) - {strategy, "uniform"} if self.watch is None else ():
            del self._tables[over]  # the early phase is over for good: give its memory back
        self.pending_batch = None
        if strategy == "se":
            pixels = self._candidates(batch, count)
        else:
            drawn, weight = self._draw(batch, strategy, count)
            pixels = batch.gather(drawn)
            self._store_pending(batch, drawn, pixels)
            if weight is not None:
                pixels["weight"] = weight
        if self.config.keep_full_image:
            pixels["full_image"] = image_batch["image"]
        return pixels

    def distribution(self, batch: ImageBatch, strategy: str) -> tuple[UniformPixels | PixelTable, Tensor]:
        """What a strategy draws from, and the place of each image of the batch in it, (k,) int64."""
        if strategy in ("uniform", "precrop") and batch.mask is None:
            return UniformPixels(batch.sizes, self._box_side(strategy)), torch.arange(len(batch.sizes))
        tables = self._tables.setdefault(strategy, _Tables(PixelTable(), {}))
        numbers = batch.numbers.tolist()
        new = [k for k, number in enumerate(numbers) if number not in tables.place]
        if new:
            try:
                tables.table.add(in_threads(lambda k: self._valid_strength(batch, strategy, k), new))
            except ValueError as problem:
                raise InputError(str(problem)) from problem
            tables.place.update({numbers[k]: len(tables.place) + i for i, k in enumerate(new)})
        return tables.table, torch.tensor([tables.place[number] for number in numbers])

    def _box_side(self, strategy: str) -> float:
        return self.config.precrop_fraction if strategy == "precrop" else 1.0

    def _valid_strength(self, batch: ImageBatch, strategy: str, k: int) -> Tensor:
        try:
            strength = torch.from_numpy(self.strength(strategy, batch.image(k)))
        except ValueError as problem:
            raise InputError(f"image {int(batch.numbers[k])}: {problem}") from problem
        return strength if batch.mask is None else strength * batch.valid(k)

    def _draw(self, batch: ImageBatch, strategy: str, count: int) -> tuple[Tensor, Tensor | None]:
        """Pixels (count, 3): position in the batch, row, column; and their loss weights, if any are asked for."""
        rng = stream(self._seed, self._step, Stream.PIXELS)
        source, places, drawable = self._drawable(batch, strategy)
        if self.config.images_per_step == "one":
            drawable = drawable[rng.integers(len(drawable), size=1)]
        # strided: a table's draws come ordered by image
        drawn = source.draw(places[drawable], count * self._world, rng)[self._rank :: self._world]
        weight = None
        if self.config.importance_weight:
            relative = source.relative(places[drawable], drawn)
            weight = (relative**-self.config.importance_weight).float().to(batch.device)
        drawn[:, 0] = drawable[drawn[:, 0]]
        return drawn, weight

    def _drawable(self, batch: ImageBatch, strategy: str) -> tuple[UniformPixels | PixelTable, Tensor, Tensor]:
        """What a strategy draws from, the images' places in it, and the positions that have a pixel to draw, by
        ascending image number: hosts collate images in any order, and a draw should not depend on it."""
        source, places = self.distribution(batch, strategy)
        drawable = torch.nonzero(source.drawable(places))[:, 0]
        drawable = drawable[torch.argsort(batch.numbers.cpu()[drawable])]
        if not len(drawable):
            raise InputError(f"strategy {strategy!r}: every pixel that it could draw is masked in all images")
        return source, places, drawable

    def _store_pending(
        self, batch: ImageBatch, drawn: Tensor, pixels: dict[str, Any], kept: Tensor | None = None
    ) -> None:
        """Keep what `observe` will need of drawn pixels, and of how likely each was kept, if not all were."""
        if self.watch is None and self.memory is None:
            return
        self.pending_batch = {
            "image": pixels["image"],
            "indices": pixels["indices"],
            "drawn": drawn.cpu(),
            "kept": kept,
        }
        if self.watch is not None:
            self._backgrounds.look_at(batch)
            edges, places = self.distribution(batch, "edge")
            self.pending_batch |= {"edges": edges, "places": places}

    def _candidates(self, batch: ImageBatch, count: int) -> dict[str, Any]:
        """Score uniform candidates and keep `count` of them by rank."""
        assert self._squared_error is not None
        drawn, _ = self._draw(batch, "uniform", self.config.se_candidates * count)
        candidates = batch.gather(drawn)
        if self.memory is not None:
            indices = candidates["indices"].cpu().numpy()
            errors = torch.from_numpy(self.memory.recall(indices, self._step, count))
        else:
            with torch.no_grad():
                errors = self._squared_error(candidates)
            if errors.shape != (len(drawn),):
                raise ValueError(f"{len(drawn)} candidates were scored by errors of shape {tuple(errors.shape)}")
            self._store_pending(batch, drawn, candidates)
            self.observe(errors)
        kept = sample_by_rank(errors, count, stream(self._seed, self._step, Stream.SELECTION, self._rank))
        pixels = {key: value[kept.rows.to(value.device)] for key, value in candidates.items()}
        relative = kept.inclusion / (count / len(drawn))  # to what it would be without ranks
        if self.memory is not None:
            self._store_pending(batch, drawn[kept.rows.cpu()], pixels, relative.cpu())
        if self.config.importance_weight:
            pixels["weight"] = relative.to(batch.device) ** -self.config.importance_weight
        return pixels


class EdgeSEPixelSampler(ImportantPixels, PixelSampler):
    """Important-pixel sampling on our own protocol's base."""
