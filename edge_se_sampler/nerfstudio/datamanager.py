"""The pixel sampler in nerfstudio: by the config of its data manager, or attached to a trainer of any method."""
# pyright: reportMissingImports=false
# nerfstudio's pins rule out the environment that is linted; here its classes count as unknown

from __future__ import annotations

import copy
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, Generic, TypeVar, get_args

import torch
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.data.pixel_samplers import PixelSampler, PixelSamplerConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.utils.misc import get_orig_class

from edge_se_sampler.errors import InputError
from edge_se_sampler.nerfstudio.pixel_sampler import EdgeSEPixelSampler, EdgeSEPixelSamplerConfig
from edge_se_sampler.nerfstudio.resume import (
    restore_sampler,
    restore_schedule,
    run_progress,
    sampler_writer,
    schedule_writer,
)
from edge_se_sampler.nerfstudio.scoring import get_background_color, observe_training_errors, ray_errors
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.pixel_sampler import build_scorer
from edge_se_sampler.sampling.schedule import AdaptiveSchedule
from edge_se_sampler.sampling.settings import SamplingSettings

Dataset = TypeVar("Dataset")


class EdgeSEDataManager(VanillaDataManager[Dataset], Generic[Dataset]):
    """nerfstudio's data manager, its training sampler bound to the run. Evaluation keeps nerfstudio's own sampler.

    As with nerfstudio's, images are of a method's own dataset where that is the argument of the class."""

    @cached_property
    def dataset_type(self) -> type:
        """The argument of the class, InputDataset by default: nerfstudio finds that of its own class alone."""
        classes = (get_orig_class(self), *getattr(self, "__orig_bases__", ()))
        return next((found for c in classes for found in get_args(c) if isinstance(found, type)), InputDataset)

    def _get_pixel_sampler(self, dataset: Any, num_rays_per_batch: int) -> Any:
        """The sampler of the training or the evaluation images; the config that both share stays as it is."""
        shared = self.config.pixel_sampler
        important = isinstance(shared, SamplingSettings)
        if important and self.config.patch_size > 1:
            raise InputError(f"patch-size is {self.config.patch_size}: this sampler draws no patches")
        uniform = important and dataset is not self.train_dataset
        self.config.pixel_sampler = PixelSamplerConfig(**_shared_settings(shared)) if uniform else copy.copy(shared)
        try:
            return super()._get_pixel_sampler(dataset, num_rays_per_batch)
        finally:
            self.config.pixel_sampler = shared

    def get_training_callbacks(self, training_callback_attributes: Any) -> list[Any]:
        """nerfstudio's callbacks and the sampler's; called after a checkpoint has been loaded, if there is one."""
        callbacks = super().get_training_callbacks(training_callback_attributes)
        if isinstance(self.train_pixel_sampler, EdgeSEPixelSampler):
            callbacks += _bind_sampler(self, training_callback_attributes.trainer)
        return callbacks


@dataclass
class EdgeSEDataManagerConfig(VanillaDataManagerConfig):
    """nerfstudio's data manager with this pixel sampler, for any method whose model takes rays."""

    _target: type = field(default_factory=lambda: EdgeSEDataManager)
    pixel_sampler: EdgeSEPixelSamplerConfig = field(default_factory=EdgeSEPixelSamplerConfig)
    """Which pixels are trained on."""


def attach(trainer: Any, **settings: Any) -> None:
    """Give a trainer of any nerfstudio method this pixel sampler: after trainer.setup(), before trainer.train().

    Args:
        settings: fields of EdgeSEPixelSamplerConfig: early, late, edge_filter, ...

    Raises:
        InputError: another data manager than a VanillaDataManager, a sampler of a purpose of its own (patches, pairs),
            or settings or cameras that have no meaning here.
    """
    manager = trainer.pipeline.datamanager
    if not isinstance(manager, VanillaDataManager):
        problem, remedy = "draws no pixels", "methods that train on whole images have no use for this sampler"
        if hasattr(manager, "train_pixel_sampler"):  # a ParallelDataManager
            problem = "does not draw its pixels in this process"
            remedy = "set config.pipeline.datamanager to an EdgeSEDataManagerConfig instead of attaching"
        raise InputError(f"{type(manager).__name__} {problem}, and a VanillaDataManager is needed: {remedy}")
    sampler = manager.train_pixel_sampler
    if type(sampler) is not PixelSampler:
        raise InputError(f"the training sampler is a {type(sampler).__name__}: this sampler cannot replace it")
    config = EdgeSEPixelSamplerConfig(**(_shared_settings(sampler.config) | settings))
    manager.train_pixel_sampler = config.setup(num_rays_per_batch=sampler.num_rays_per_batch)
    trainer.callbacks += _bind_sampler(manager, trainer)


def _bind_sampler(manager: Any, trainer: Any) -> list[TrainingCallback]:
    """Bind a data manager's training sampler to the run; callbacks that set its step and write what it has learnt."""
    sampler, config = manager.train_pixel_sampler, trainer.config
    rank = config.machine.machine_rank * config.machine.num_devices + trainer.local_rank
    sampler.background_color = get_background_color(trainer.pipeline.model)
    sampler.bind(
        squared_error=build_scorer(sampler, trainer.pipeline, manager.train_ray_generator, ray_errors),
        progress=run_progress(trainer),
        seed=config.machine.seed,
        rank=rank,
        world=trainer.world_size,
    )
    callbacks = [TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], sampler.set_step)]
    if sampler.needs_errors:
        observe_training_errors(trainer.pipeline.model, sampler)
    if isinstance(sampler.schedule, AdaptiveSchedule):
        restore_schedule(trainer, sampler.schedule)
        write_schedule = schedule_writer(trainer, sampler.schedule)
        callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], write_schedule))
    if sampler.state_dict().keys() - {"schedule"}:
        restore_sampler(trainer, sampler, rank, _image_sizes(manager))
        write_sampler = sampler_writer(trainer, sampler, rank)
        callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], write_sampler))
    loader = manager.train_image_dataloader
    if loader.cache_all_images:
        sampler.check_images(loader.cached_collated_batch)
    return callbacks


def _image_sizes(manager: Any) -> dict[int, tuple[int, int]]:
    """Rows and columns of the training images by number: of its cameras, which nerfstudio may round otherwise, only
    where images are not kept."""
    loader, cameras = manager.train_image_dataloader, manager.train_dataset.cameras
    if loader.cache_all_images:
        return ImageBatch.of(loader.cached_collated_batch, use_mask=False).sizes_by_number
    sizes = torch.cat((cameras.height, cameras.width), dim=1).tolist()
    return {i: (rows, columns) for i, (rows, columns) in enumerate(sizes)}


def _shared_settings(config: PixelSamplerConfig) -> dict[str, Any]:
    """The settings that nerfstudio's sampler has too."""
    return {f.name: getattr(config, f.name) for f in fields(PixelSamplerConfig) if f.name != "_target"}
