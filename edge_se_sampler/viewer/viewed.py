"""A run that is looked at, finished or in training, and what there is to see of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Condition
from typing import Any

import numpy as np
import torch

from edge_se_sampler.data.cameras import Cameras
from edge_se_sampler.engine.checkpoint import latest_checkpoint
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.files import to_uint8
from edge_se_sampler.engine.metrics import composite_on
from edge_se_sampler.engine.pipeline import Pipeline, build_model, load_weights, saved_grid
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.saved_state import load_plan, load_sampler
from edge_se_sampler.engine.session import choose_device, load_state, read_train_views
from edge_se_sampler.engine.show import probability_map
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.engine.trajectories import find_up
from edge_se_sampler.occupancy.bricks import BrickGrid
from edge_se_sampler.sampling.edges import unit_float
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.pixel_sampler import ImportantPixels
from edge_se_sampler.sampling.random_streams import Stream, stream
from edge_se_sampler.sampling.ranking import error_ranks
from edge_se_sampler.sampling.strategies import RankedError

MAX_POINTS = 60_000
"""Cells that are drawn; of more, so many at random."""


class Turns:
    """A lock that goes to who has waited longest: training, which asks again at once, must not keep it to itself."""

    def __init__(self) -> None:
        self._changed = Condition()
        self._waiting: deque[object] = deque()  # the first has its turn

    def __enter__(self) -> None:
        with self._changed:
            me = object()
            self._waiting.append(me)
            try:
                self._changed.wait_for(lambda: self._waiting[0] is me)
            except BaseException:  # Ctrl-C: others must not wait for who has gone
                self._waiting.remove(me)
                self._changed.notify_all()
                raise

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._waiting.popleft()
            self._changed.notify_all()


class Viewed:
    """A trainer whose model is shown. Whoever uses the model or the sampler does so in `turns`, as training does."""

    def __init__(self, trainer: Trainer) -> None:
        self.trainer = trainer
        self.turns = trainer.turns = Turns()
        self._newest: Path | None = None  # checkpoint that was looked at, whole or not

    @classmethod
    def load(cls, run: RunFolder, config: TrainerConfig) -> Viewed:
        """A run at its last checkpoint; nothing is written. InputError for a bad run or data."""
        newest = latest_checkpoint(run.checkpoints)
        _, state = load_state(run, config)
        device, views = choose_device(config.machine.device_type, of_run=True), read_train_views(config, trains=False)
        grid = saved_grid(state["model"])
        pipeline = Pipeline.build(config, views, device, grid, changed_data=True)  # which rendering does not mind
        load_weights(pipeline.model, state["model"])
        viewed = cls(config.setup(run=run, pipeline=pipeline, preview=None))
        viewed._take(state, pipeline.model)
        viewed._newest = newest
        return viewed

    def reload(self) -> None:
        """Show a newer checkpoint if another process has written one; InputError if it cannot be read."""
        trainer = self.trainer
        newest = latest_checkpoint(trainer.run.checkpoints)
        if newest != self._newest:
            self._newest = newest
            _, state = load_state(trainer.run, trainer.config)
            model = build_model(trainer.config, str(trainer.pipeline.model.device), saved_grid(state["model"]))
            load_weights(model, state["model"])
            self._take(state, model)

    def _take(self, state: dict[str, Any], model: Any) -> None:
        """Show a checkpoint's model, and its sampler, which remembers nothing of images that have changed since."""
        trainer, manager = self.trainer, self.trainer.pipeline.datamanager
        with self.turns:
            if trainer.pipeline.has_data_of(state):
                load_sampler(manager, state["sampler"])
            load_plan(trainer.plan, state["plan"])
            trainer.pipeline, trainer.next_step = replace(trainer.pipeline, model=model), state["step"] + 1
            if isinstance(manager.train_pixel_sampler, ImportantPixels):
                manager.train_pixel_sampler.set_step(state["step"])

    @property
    def model(self) -> Any:
        return self.trainer.pipeline.model

    @property
    def strategy(self) -> str | None:
        """Name of the current strategy of drawing pixels; None: the pixel sampler is not one of ours."""
        return getattr(self.trainer.pipeline.datamanager.train_pixel_sampler, "strategy", None)

    @property
    def cameras(self) -> Cameras:
        """Those of the training views."""
        return self.trainer.pipeline.datamanager.cameras

    @property
    def masks(self) -> list[np.ndarray] | None:
        """(H, W) bool of each training view: the pixels that may be trained on; None: all."""
        masks = self.trainer.pipeline.datamanager.image_batch.get("mask")
        return None if masks is None else [mask[..., 0].numpy() for mask in masks]

    @property
    def up(self) -> np.ndarray:
        """(3,) unit vector: the scene's vertical."""
        return find_up(self.cameras.to("cpu").to(dtype=torch.float64))

    def image(self, k: int, stride: int = 1) -> np.ndarray:
        """Every so many pixels, both ways, of the kth training image on the model's background, (H, W, 3) uint8."""
        image = self.trainer.pipeline.datamanager.image_batch["image"][k][::stride, ::stride]
        return to_uint8(composite_on(unit_float(image.numpy()), self.model.config.background_level))

    def probability(self, k: int, squared_error: Callable[[], np.ndarray | None]) -> np.ndarray | None:
        """Probability of every pixel of the kth view under the current strategy, relative to uniform, (H, W); where
        squared errors rank the pixels, the cached ones do or else (H, W) rendered ones. None: the pixel sampler is not
        one of ours, or there are no errors."""
        manager = self.trainer.pipeline.datamanager
        sampler = manager.train_pixel_sampler
        if not isinstance(sampler, ImportantPixels):
            return None
        use_mask, background = not sampler.config.ignore_mask, sampler.background_color
        batch = ImageBatch.of(manager.image_batch, use_mask=use_mask, background_color=background)
        distribution, selector = sampler.strategies[sampler.strategy]
        with self.turns:  # training changes what a distribution has learnt
            p = probability_map(distribution, batch, k)
        if isinstance(selector, RankedError):
            errors = self._cached_errors(selector, batch, k)
            errors = squared_error() if errors is None else errors
            if errors is None:
                return None
            drawn = p > 0  # candidates are no others
            p[drawn] *= error_ranks(errors[drawn], stream(0, 0, Stream.SELECTION))
        return p * p.size / max(p.sum(), 1e-30)

    def _cached_errors(self, selector: RankedError, batch: ImageBatch, k: int) -> np.ndarray | None:
        """(H, W) squared errors of the kth view that training remembers; None: it remembers none."""
        number, (height, width) = int(batch.numbers[k]), batch.sizes[k]
        count = self.trainer.pipeline.datamanager.train_pixel_sampler.num_rays_per_batch
        with self.turns:
            if selector.error_map is None or number not in selector.error_map.sizes:
                return None
            pixels = torch.cartesian_prod(torch.tensor([number]), torch.arange(height), torch.arange(width)).numpy()
            return selector.error_map.lookup(pixels, self.trainer.next_step, count).reshape(height, width)

    def occupied_cells(self) -> tuple[np.ndarray, float] | None:
        """Centers (m, 3) of cells that are occupied now, world units, and the size of a cell; None: there are none."""
        grid: BrickGrid | None = self.model.grid
        if grid is None:
            return None
        with self.turns:
            cells = grid.coordinates(torch.nonzero(grid.occupied.reshape(-1))[:, 0]).cpu()
            centers = grid.aabb_min + (cells + 0.5) * grid.cell_size
        return _some(centers.numpy()), float(grid.cell_size)

    def hull_cells(self) -> tuple[np.ndarray, float] | None:
        """As `occupied_cells`, of those with which training began."""
        hull = self.trainer.pipeline.hull
        if hull is None:
            return None
        return _some(hull.aabb_min + (np.argwhere(hull.cells) + 0.5) * hull.cell_size), hull.cell_size


def _some(points: np.ndarray) -> np.ndarray:
    """At most MAX_POINTS of points (m, 3), at random."""
    if len(points) <= MAX_POINTS:
        return points
    return points[stream(0, 0, Stream.PROBE).choice(len(points), MAX_POINTS, replace=False)]
