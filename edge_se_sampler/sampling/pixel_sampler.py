"""The pixel sampler: an early and a late strategy, under our protocol's PixelSampler or nerfstudio's."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from edge_se_sampler.errors import InputError
from edge_se_sampler.protocol import PixelSampler
from edge_se_sampler.sampling.edges import WHITE
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.parts import Distribution, PixelBatch, SamplerPart, TrainingStep
from edge_se_sampler.sampling.schedule import AdaptiveSchedule, FixedSchedule, Progress, Schedule
from edge_se_sampler.sampling.strategies import Uniform, build_strategies

SquaredError = Callable[[dict[str, Any]], Tensor]
"""Candidate batch -> (m,) squared errors of the model's current (fine) colors, without gradients."""
RayErrors = Callable[[Any, Any, dict[str, Tensor]], Tensor]
"""Model, ray bundle (n rays), batch -> (n,) squared errors of the model's fine colors on the batch's pixels."""


class ImportantPixels:
    """Mixin over a host's PixelSampler, which contributes its config and batch size: Random, Precrop or Edge, then
    Random or squared error.

    Unbound (in evaluation, viewers, exporters) it draws uniformly. `bind` and `set_step` make it follow a training
    run; the data manager calls them. Masked pixels are never drawn.

    Args:
        config: its settings; copied.
        kwargs: the host's, and `background_color`: RGB in [0, 1] that edges are taken in front of (white).
    """

    config: Any  # SamplingSettings and the host's PixelSamplerConfig in one
    num_rays_per_batch: int

    def __init__(self, config: Any, **kwargs: Any) -> None:
        # hosts share one config between training and evaluation, and write into it
        super().__init__(copy.copy(config).resolve_auto(), **kwargs)  # pyright: ignore[reportCallIssue]
        self.config.check()
        self.background_color: tuple[float, float, float] = kwargs.get("background_color") or WHITE
        """To be changed only before anything is drawn: tables of edges stay what they are."""
        self.strategies = build_strategies(self.config)
        self.schedule: Schedule = FixedSchedule(0)
        self.pending_batch: PixelBatch | None = None
        """The last sample's pixels while their squared errors are wanted and not yet known, see `observe`."""
        self._squared_error: SquaredError | None = None
        self._over: Distribution | None = None  # what is not drawn from any more
        self._step = TrainingStep(squared_error=self._score)

    def bind(
        self, *, squared_error: SquaredError, progress: Progress, seed: int, rank: int = 0, world: int = 1
    ) -> None:
        """Follow a training run.

        Args:
            squared_error: scores candidates.
            progress: of the training, which a share of it as the early phase follows.
            rank: of this process among `world` of a distributed run, see `TrainingStep`.
        """
        self._squared_error, self._over = squared_error, None
        self._step = replace(self._step, seed=seed, rank=rank, world=world)
        if self.config.schedule == "adaptive":
            self.schedule = AdaptiveSchedule(self.strategies[self.config.early].distribution)
        elif self.config.schedule == "steps":
            self.schedule = FixedSchedule(self.config.early_steps)
        else:
            self.schedule = FixedSchedule(self.config.early_fraction, progress)

    def set_step(self, step: int) -> None:
        """The step about to be trained; draws depend on it alone, and so does the phase of a fixed schedule."""
        self._step = replace(self._step, number=step)

    @property
    def is_bound(self) -> bool:
        """Whether it follows a training run."""
        return self._squared_error is not None

    @property
    def strategy(self) -> str:
        """Name of the current step's strategy, such as "edge"."""
        if not self.is_bound:
            return Uniform.name
        return self.config.early if self.schedule.phase(self._step.number) == "early" else self.config.late

    def check_images(self, image_batch: dict[str, Any]) -> None:
        """Before training, refuse images that a phase could draw nothing from: InputError as `sample`. And strategies
        whose state cannot be saved: InputError as `state_dict`."""
        batch = self._read(image_batch)
        for name in (self.config.early, self.config.late):
            self.strategies[name].distribution.drawable(batch)
        self.state_dict()

    def sample(self, image_batch: dict[str, Any]) -> dict[str, Any]:
        """Choose the step's pixels; see the protocol's PixelSampler.sample.

        With an importance weight, or a strategy that weights the loss, the batch also has `weight` (N,), float32 loss
        weights.

        Raises:
            InputError: every pixel of every image is masked, or alpha edges of images without alpha.
            FloatingPointError: a candidate's squared error is not finite.
        """
        if not self.is_bound:  # nobody sets the step: it counts its own calls
            self.set_step(self._step.number + 1)
        batch, count = self._read(image_batch), self.num_rays_per_batch
        distribution, selector = self.strategies[self.strategy]
        self._release_tables(distribution)
        self.pending_batch, self._scored = None, False
        candidates = distribution.draw(batch, selector.candidates_per_pixel * count, self._step)
        drawn = selector.select(candidates, count, self._step)
        if self.needs_errors and not self._scored:
            self.pending_batch = drawn
        pixels = dict(drawn.values)
        if drawn.loss_weight is not None:
            pixels["weight"] = drawn.loss_weight.to(batch.device)
        elif self.config.importance_weight:
            pixels["weight"] = (drawn.density_ratio() ** -self.config.importance_weight).float().to(batch.device)
        if self.config.keep_full_image:
            pixels["full_image"] = image_batch["image"]
        return pixels

    def observe(self, squared_error: Tensor) -> None:
        """Learn the squared errors (N,) that training found at the last sample's pixels, if they are wanted."""
        if self.pending_batch is not None:
            drawn, self.pending_batch = self.pending_batch, None
            self._update(drawn, squared_error)

    @property
    def needs_errors(self) -> bool:
        """Whether training has to tell it the squared errors that it finds, by `observe`."""
        return self.is_bound and any(part.needs_errors for part in self.parts().values())

    def state_dict(self) -> dict[str, Any]:
        """What later draws depend on besides the step, for a checkpoint. InputError: that may not hold it."""
        states = {name: part.state_dict() for name, part in self.parts().items()}
        for name, state in states.items():
            _check_plain(name, state)
        return {name: state for name, state in states.items() if state}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned, once bound to a run with the same settings."""
        parts = self.parts()
        for name, part_state in state.items():
            parts[name].load_state_dict(part_state)

    def parts(self) -> dict[str, SamplerPart]:
        """Everything that may yet learn from errors, by its name in a checkpoint."""
        parts: dict[str, SamplerPart] = {"schedule": self.schedule}
        for name, strategy in self.strategies.items():
            parts |= {f"{name}.distribution": strategy.distribution, f"{name}.selector": strategy.selector}
        return {name: part for name, part in parts.items() if part is not self._over}

    def _read(self, image_batch: dict[str, Any]) -> ImageBatch:
        return ImageBatch.of(image_batch, use_mask=not self.config.ignore_mask, background_color=self.background_color)

    def _release_tables(self, needed: Distribution) -> None:
        """Give back the memory of the early phase's tables, and learn no more for it, once it is over for good."""
        early = self.strategies[self.config.early].distribution
        if not self.schedule.early_may_return and early not in (needed, self.strategies[Uniform.name].distribution):
            early.clear()
            self._over = early

    def _score(self, candidates: PixelBatch) -> Tensor:
        """The model's squared errors (m,) at candidates. They are learnt from as well, being drawn uniformly, and more
        than training will find: those of the pixels that are kept are not waited for."""
        assert self._squared_error is not None
        with torch.no_grad():
            errors = self._squared_error(candidates.values)
        count = len(candidates.pixels)
        if errors.shape != (count,):
            raise ValueError(f"{count} candidates were scored by errors of shape {tuple(errors.shape)}")
        self._scored = True
        self._update(candidates, errors)
        return errors

    def _update(self, drawn: PixelBatch, squared_error: Tensor) -> None:
        parts = [part for part in self.parts().values() if part.needs_errors]
        # what is not finite would never be forgotten; with mixed precision, nerfstudio skips such a step, too
        if parts and bool(squared_error.isfinite().all()):
            for part in parts:
                part.update(drawn, squared_error.detach(), self._step)


def _check_plain(name: str, state: Any) -> None:
    """InputError for a part's state that has more than `SamplerPart.state_dict` may return."""
    if isinstance(state, (dict, list, tuple)):
        for value in [*state, *state.values()] if isinstance(state, dict) else state:
            _check_plain(name, value)
    elif not (state is None or isinstance(state, Tensor) or type(state) in (bool, int, float, str)):
        kind = f"{type(state).__module__}.{type(state).__qualname__}"
        raise InputError(
            f"{name}: its state_dict has a {kind}, which no checkpoint may hold; make it a tensor, or plain"
        )


class EdgeSEPixelSampler(ImportantPixels, PixelSampler):
    """Important-pixel sampling on our own protocol's base."""


def build_scorer(
    sampler: ImportantPixels, pipeline: Any, ray_generator: Callable[[Tensor], Any], ray_errors: RayErrors
) -> SquaredError:
    """A function that renders a sampler's candidates and returns their squared errors, for `ImportantPixels.bind`.

    Args:
        sampler: its number of rays, which hosts may change at any time, is how many are rendered at once, so that it
            takes no more memory than training.
        pipeline: whose `model` is rendered. It must not be an attribute of a data manager: nerfstudio's is a module,
            and would count the model's weights as its own.
        ray_generator: (n, 3) indices -> ray bundle.
    """

    @torch.no_grad()
    def squared_error(candidates: dict[str, Tensor]) -> Tensor:
        errors = []
        for start in range(0, len(candidates["indices"]), sampler.num_rays_per_batch):
            rows = slice(start, start + sampler.num_rays_per_batch)
            batch = {key: candidates[key][rows] for key in ("indices", "image")}
            errors.append(ray_errors(pipeline.model, ray_generator(batch["indices"]), batch))
        return torch.cat(errors)

    return squared_error
