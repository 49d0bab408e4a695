"""The part of nerfstudio's interface that is used here: the same names, arguments and meanings.

A class written for nerfstudio 1.1.5's PixelSampler or VanillaDataManager finds here what it needs of its host:
`config.setup(**kwargs)`, `sample(image_batch)` returning `indices` with absolute image numbers, and training callbacks.
Torch-free at import.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from importlib import import_module
from typing import Any, ClassVar, Protocol

ADDED_LATER = {"added_later": True}
"""Metadata of a config field that runs of earlier versions lack: there its default stands for it."""


class InstantiateConfig:
    """A config that builds the object that it configures."""

    _target: ClassVar[type | str]
    """The class to build, or "module:Class", imported on `setup` only: reading configs stays cheap."""

    def setup(self, **kwargs: Any) -> Any:
        """The configured object: target(config, **kwargs)."""
        target = self._target
        if isinstance(target, str):
            module, name = target.split(":")
            target = getattr(import_module(module), name)
        return target(self, **kwargs)


@dataclass
class PixelSamplerConfig(InstantiateConfig):
    """Settings of every pixel sampler. Not frozen, as nerfstudio's is not, which may be used instead."""

    num_rays_per_batch: int = 1024
    """Pixels drawn per step; the data manager's number of rays overrides it."""
    keep_full_image: bool = False
    """Return the whole images as well, under "full_image"."""
    ignore_mask: bool = False
    """Draw from masked pixels too."""


class PixelSampler(ABC):
    """Chooses the pixels of a training step.

    Args:
        config: its settings, written into; num_rays_per_batch and keep_full_image among the kwargs override them.
    """

    config: PixelSamplerConfig

    def __init__(self, config: PixelSamplerConfig, **kwargs: Any) -> None:
        self.config = config
        self.kwargs = kwargs
        self.config.keep_full_image = kwargs.get("keep_full_image", config.keep_full_image)
        self.config.num_rays_per_batch = kwargs.get("num_rays_per_batch", config.num_rays_per_batch)
        self.set_num_rays_per_batch(self.config.num_rays_per_batch)

    def set_num_rays_per_batch(self, num_rays_per_batch: int) -> None:
        """Change how many pixels a step draws."""
        self.num_rays_per_batch = num_rays_per_batch

    @abstractmethod
    def sample(self, image_batch: dict[str, Any]) -> dict[str, Any]:
        """Choose N pixels.

        Args:
            image_batch: `image_idx` (k,) int64 absolute numbers; `image` (k, H, W, 3|4) float in [0, 1] or uint8;
                optionally `mask` (k, H, W, 1) bool and other per-pixel tensors. Lists of k tensors when sizes differ.

        Returns:
            every per-pixel key at these pixels, and `indices` (N, 3) int64: absolute image number, row, column.
        """

    def state_dict(self) -> dict[str, Any]:
        """What later draws depend on besides the step, for a checkpoint; here nothing."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:  # noqa: B027 (nothing to load by default)
        """Continue from what `state_dict` returned."""


class TrainingCallbackLocation(Enum):
    """When a callback runs, relative to a training iteration."""

    BEFORE_TRAIN_ITERATION = auto()
    AFTER_TRAIN_ITERATION = auto()


class CallbackPipeline(Protocol):
    """The part of a pipeline that callbacks use: the model being trained, and what draws its pixels."""

    @property
    def model(self) -> Any: ...

    @property
    def datamanager(self) -> Any: ...


class CallbackTrainer(Protocol):
    """The part of a trainer that callbacks use."""

    config: Any
    """The run's settings; `config.machine.seed` among them."""
    optimizer: Any
    """A torch.optim.Optimizer; what it remembers of a parameter means nothing once that has other rows."""

    def progress(self, step: int) -> float:
        """The part of the training, in [0, 1], that is done when a step begins."""
        ...

    def first_progress(self, step: int) -> float:
        """The same of the training as first planned; making it longer does not change it."""
        ...


@dataclass(frozen=True)
class TrainingCallbackAttributes:
    """What a callback may use."""

    pipeline: CallbackPipeline
    trainer: CallbackTrainer


@dataclass(frozen=True)
class TrainingCallback:
    """A function that training calls with the step: func(step=...)."""

    where_to_run: list[TrainingCallbackLocation]
    func: Callable[..., None]

    def run_callback_at_location(self, step: int, location: TrainingCallbackLocation) -> None:
        """Call the function if this is one of its locations."""
        if location in self.where_to_run:
            self.func(step=step)
