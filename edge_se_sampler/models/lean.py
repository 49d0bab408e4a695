"""The voxel model: density and features at the corners of sparse cells, and a small network that turns features and
direction into color. Training begins with large cells, and subdivides those that it sees something in.

The parts are known: features at the corners of sparse voxels, pruned and subdivided (NSVF, Liu et al. 2020), density
asked first and color only where it counts (DVGO, Sun et al. 2022; Plenoxels, Fridovich-Keil et al. 2022), an occupancy
grid with early termination (instant-ngp, Mueller et al. 2022), a visual hull (VaxNeRF, Kondo et al. 2021).

h      size of a cell of the finest level, world units
raw    logarithm of the optical depth across h: it can never make the density 0, so nothing can die
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from edge_se_sampler.data.cameras import Cameras, RayBundle
from edge_se_sampler.models import voxel_ops
from edge_se_sampler.models.config import RAYS_PER_CHUNK, LeanModelConfig
from edge_se_sampler.models.levels import LAST_PRUNING, UNSETTLED, find_level, find_level_end
from edge_se_sampler.models.ray_model import ParameterGroup, RayModel
from edge_se_sampler.models.ray_spans import find_spans
from edge_se_sampler.models.voxel_backend import choose_ops
from edge_se_sampler.models.voxel_ops import NUM_HARMONICS, Marching, NetworkWeights, Rendered
from edge_se_sampler.occupancy.bricks import BrickGrid, unpack_bits
from edge_se_sampler.occupancy.subdivision import subdivide
from edge_se_sampler.occupancy.visibility import find_empty_depths
from edge_se_sampler.protocol import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation

FEATURE_DIM = 16
"""Features at a corner. The compiled kernels know no other number."""
WIDTH, WIDTH_CARVED = 64, 128
"""Neurons of the hidden layer; the latter where masks carve cells close to the object. In photographs of more than an
object colors differ from image to image, which a wider one would learn by heart. Kernels want a multiple of 64."""
INITIAL_RAW_DENSITY, MAX_RAW_DENSITY = -3.0, 5.0
"""The most at first, if that is sampled, and at all: denser is as opaque, and slow to become transparent again."""
INITIAL_DEPTH, INITIAL_DEPTH_CARVED = 1.0, 8.5
"""Optical depth that the box would have at first, if cells filled it; the latter where masks carve them close to the
object: more hides what is behind, and each view would learn a picture of its own on it."""
SEEN_PER_ROW = 22
"""How many weights must have been seen since the level settled, times how much longer training goes on, for each row
that the finest level is expected to have."""
SEEN_PER_CELL = 20
"""How many weights must have been seen for each cell before the finest are left out, or all of them, which is an
error."""
SUPERSAMPLING_START, MIN_VISITS = 0.6, 4.0
"""Part of the training after which a pixel has 2 x 2 rays, and how often all of them must have been trained on before:
more rays tell more of what is smaller than a pixel, but other pixels tell more of what is not yet known."""
STEPS_PER_SAMPLED = 50
"""Steps after which cells that have become transparent are found again."""
FOG_MARGIN = 0.3
"""How much more raw density than what is sampled training begins with at least."""
TRANSPARENT_MARGIN = 0.7
"""How much less raw density than what is seen counts as transparent: until it is looked at again, it may grow."""
ROWS_PER_SEEN, ROWS_PER_PIXEL = 0.2, 1.5
"""Rows that there may be, once cells are smaller than was planned, for each weight that was seen since the level
settled, times how much longer training goes on, and for each pixel of the training images that shows something: what
is hardly seen is not learned any better in smaller cells, and with more numbers than there are in the images the model
remembers rather than learns."""
MAX_RATIO = 0.85
"""Cells that would be larger than this part of the present ones are not worth subdividing."""
MAX_STEPS = 2**24
"""Steps along rays, in cells or not, that plain torch looks at at once; each takes about 100 bytes."""
ROWS_RATIO = 4
"""How many times as many rows cells have once they are halved: surfaces are layers of them."""
BYTES_PER_ROW = 4 * (2 * (FEATURE_DIM + 1) + 4) + 1
"""Density, features, the running means of their gradients and those of squares, and what the grid keeps of a row."""


class ColorNetwork(nn.Module):
    """The weights of `voxel_ops.shade`'s network of so many neurons, or of as many as a checkpoint has. `rng` draws the
    initial ones."""

    def __init__(self, rng: np.random.Generator, width: int) -> None:
        super().__init__()

        def draw(shape: tuple[int, int], variance: float) -> nn.Parameter:
            return nn.Parameter(torch.from_numpy(rng.normal(size=shape) * math.sqrt(variance)).float())

        self.hidden = draw((FEATURE_DIM, width), 2 / FEATURE_DIM)
        self.view, self.view_bias = draw((NUM_HARMONICS, width), 0.5 / NUM_HARMONICS), nn.Parameter(torch.zeros(width))
        self.color, self.color_bias = draw((3, width), 1 / width), nn.Parameter(torch.zeros(3))

    def _load_from_state_dict(self, *arguments: Any, **options: Any) -> None:
        state, prefix = arguments[:2]
        bias = state.get(f"{prefix}view_bias")
        if bias is not None and bias.shape in ((WIDTH,), (WIDTH_CARVED,)):  # others are refused below
            for weight in (self.hidden, self.view, self.view_bias, self.color):
                weight.data = weight.data.new_zeros((*weight.shape[:-1], len(bias)))
        super()._load_from_state_dict(*arguments, **options)

    def weights(self) -> NetworkWeights:
        return NetworkWeights(self.hidden, self.view, self.view_bias, self.color, self.color_bias)


class LeanModel(RayModel):
    """Sparse cells that training prunes and subdivides. `rng` draws the initial weights."""

    config: LeanModelConfig
    grid: BrickGrid
    meets_all_cells = True
    supersampled: Tensor
    """() bool: whether a pixel's color is the mean over 2 x 2 rays through it, rather than that of one."""
    subdivides_early: Tensor
    """() bool: whether levels begin early, see `find_level`."""
    remembers_weights: bool = True
    """Whether weights are remembered, as `update_cells` decides."""

    def __init__(self, config: LeanModelConfig, rng: np.random.Generator, grid: BrickGrid) -> None:
        super().__init__(config, grid)
        self.fine = ColorNetwork(rng, WIDTH_CARVED if grid.is_carved_close else WIDTH)
        depth = INITIAL_DEPTH_CARVED if grid.is_carved_close else INITIAL_DEPTH
        thin = math.log(depth / float(grid.size.max())) - int(grid.max_level) * math.log(2)
        # samples of less would be left out
        raw = max(min(thin, INITIAL_RAW_DENSITY), self.marching.density_min + FOG_MARGIN)
        self.density = nn.Parameter(torch.full((grid.num_rows, 1), raw))
        # only a checkpoint has cells that were subdivided, and it has their features, which would take seconds to draw
        shape = grid.num_rows, FEATURE_DIM
        draws = np.zeros(shape, np.float32) if grid.level else rng.standard_normal(shape, np.float32) * np.float32(0.01)
        self.features = nn.Parameter(torch.from_numpy(draws))
        self.register_buffer("supersampled", torch.tensor(False))
        self.register_buffer("subdivides_early", torch.tensor(False))

    def _load_from_state_dict(self, *arguments: Any, **options: Any) -> None:
        state, prefix = arguments[:2]
        state.setdefault(f"{prefix}subdivides_early", torch.tensor(False))  # earlier versions had none
        super()._load_from_state_dict(*arguments, **options)

    @property
    def marching(self) -> Marching:
        """How rays are sampled in the grid's cells."""
        step = self.config.step_size_voxels
        density_scale = step * float(self.grid.cell_size / self.grid.finest_size)
        config = self.config
        thresholds = config.alpha_threshold, config.weight_threshold, config.transmittance_threshold
        return Marching(step, density_scale, *thresholds, config.visible_threshold)

    @property
    def rays_per_chunk(self) -> int:
        """Fewer where plain torch, which looks at all steps of all rays at once, renders views: a pixel has up to 4."""
        if self.training or choose_ops(self.density) is not voxel_ops:
            return RAYS_PER_CHUNK
        longest = math.hypot(*self.grid.size.tolist()) / self.config.step_size_voxels
        return max(1, min(RAYS_PER_CHUNK, int(MAX_STEPS / (4 * longest))))

    def parameter_groups(self) -> list[ParameterGroup]:
        """The network; density and features learn faster, for each sees few samples."""
        return [
            ParameterGroup(list(self.fine.parameters())),
            ParameterGroup([self.density], self.config.density_lr_scale, maximum=MAX_RAW_DENSITY),
            ParameterGroup([self.features], self.config.feature_lr_scale, total_variation=self.config.total_variation),
        ]

    def forward(self, rays: RayBundle) -> dict[str, Tensor]:
        """As `RayModel`; depth_fine in evaluation alone."""
        if "empty_depths" not in rays.metadata:
            return self.render(rays)[0]
        some = torch.nonzero(rays.metadata["empty_depths"][:, 0].isfinite())[:, 0]
        rendered, background = self.render(rays[some])[0], self.get_background(rays)
        far = self.config.depths[1] * rays.metadata["directions_norm"]
        nothing = {"rgb_fine": background.clone(), "accumulation_fine": torch.zeros_like(far), "depth_fine": far}
        outputs = {key: values.index_copy_(0, some, rendered[key]) for key, values in nothing.items()}
        return outputs | {"background": background}

    def find_empty_depths(self, camera: Cameras) -> Tensor:
        return find_empty_depths(self.grid, camera)

    def training_loss(self, rays: RayBundle, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """As `RayModel`; remembers the largest weight in each cell."""
        outputs, rendered = self.render(rays)
        self.remember(rendered)
        return self.loss(outputs, batch)

    def remember(self, rendered: Rendered) -> None:
        """Remember the largest weight in each cell of what training has rendered, while that will be looked at."""
        if self.remembers_weights:
            self.grid.update_max_weight(rendered.cells, rendered.weights)

    def loss(self, outputs: dict[str, Tensor], batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """As `RayModel`; plus, where there is alpha, the squared error of the accumulated opacity."""
        loss, error = super().loss(outputs, batch)
        if self.config.alpha_loss and batch["image"].shape[1] == 4:
            difference = outputs["accumulation_fine"][:, 0] - batch["image"][:, 3]
            loss = loss + self.config.alpha_loss / 3 * batch.get("weight", 1.0) * difference.square()
        return loss, error

    def render(self, rays: RayBundle) -> tuple[dict[str, Tensor], Rendered]:
        """Outputs of `forward`, and what they were made of."""
        size = 4 if self.supersampled else 1
        spans = find_spans(rays, size, self.grid, self.config.depths, self.config.step_size_voxels)
        jitter = self.uniform(len(rays), size).reshape(-1) if self.training else None
        weights = self.density, self.features, self.fine.weights()
        rendered = choose_ops(self.density).render(self.grid, *weights, spans, jitter, self.marching)
        of_rays = rendered.rgb, rendered.accumulation, rendered.distance
        # the sum of columns, for torch's means over few numbers are slow
        rgb, accumulation, distance = (sum(x.reshape(-1, size, x.shape[1]).unbind(dim=1)) / size for x in of_rays)
        background, transmittance = self.get_background(rays), 1 - accumulation
        outputs = {"rgb_fine": rgb + transmittance * background, "accumulation_fine": accumulation}
        if not self.training:
            depth = distance * float(self.grid.cell_size)
            outputs["depth_fine"] = depth + transmittance * self.config.depths[1] * rays.metadata["directions_norm"]
        return outputs | {"background": background}, rendered

    def get_training_callbacks(self, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:
        """Prunes and subdivides cells, by the part of the training that is done; now and then finds those that have
        become transparent. At last replaces three of four pixels of a step by more rays through the others."""
        trainer, sampler = attributes.trainer, attributes.pipeline.datamanager.train_pixel_sampler
        num_rays = trainer.config.preset.rays

        def visits(step: int) -> float:
            return step * num_rays / max(int(self.grid.num_pixels), 1)

        def update_rays(step: int) -> None:
            if trainer.progress(step) >= SUPERSAMPLING_START and visits(step) >= MIN_VISITS:
                self.supersampled.fill_(self.config.supersample)
            if self.supersampled:
                sampler.set_num_rays_per_batch(max(1, num_rays // 4))

        def update_cells(step: int) -> None:
            if step % STEPS_PER_SAMPLED == 0:
                self.update_sampled()
            if self.update_cells(trainer.progress(step - 1) if step else 0.0, trainer.progress(step)):
                for parameter in (self.density, self.features):
                    trainer.optimizer.state.pop(parameter, None)

        before = [TrainingCallbackLocation.BEFORE_TRAIN_ITERATION]
        return [TrainingCallback(before, update) for update in (update_rays, update_cells)]

    @torch.no_grad()
    def update_cells(self, before: float, now: float) -> bool:
        """Do what is due as training goes on from one part of it to the next, both in [0, 1]; tells whether cells were
        subdivided. FloatingPointError: they hold nothing."""
        grid = self.grid
        level, finest = int(grid.level), int(grid.max_level)
        if not level and before < find_level_end(0, finest, is_early=True) <= now:
            self.subdivides_early.fill_(self._will_be_seen_often((1 - now) / now))
        begin, end = find_level(level, finest, bool(self.subdivides_early))
        done, part = ((progress - begin) / (end - begin) for progress in (before, now))
        if done < UNSETTLED <= part:
            grid.reset_max_weight()
        if level == finest and done < LAST_PRUNING <= part:
            self._leave_out_unseen()
        self.remembers_weights = level < finest or UNSETTLED <= part < LAST_PRUNING
        if level < finest and before >= end and not grid.num_seen:
            raise _nothing_seen()
        # before that many weights are seen, nobody knows which cells are empty
        if level < finest and now >= end and grid.num_seen >= grid.occupied.sum():
            seen = self._find_seen()
            return bool(seen.any()) and self._subdivide(seen, (1 - now) / now)
        return False

    @torch.no_grad()
    def update_sampled(self) -> None:
        """Sample no cells in which the density is too low to be seen, nor can learn to be higher."""
        least = self.marching.density_min - TRANSPARENT_MARGIN
        self.grid.set_sampled(choose_ops(self.density).find_dense_cells(self.grid, self.density, least))

    def _will_be_seen_often(self, remaining: float) -> bool:
        """Whether weights will be seen often enough for the finest level to begin early, judged by those of this level,
        the first; remaining: as `_subdivide`."""
        expected_rows = self.grid.num_rows * ROWS_RATIO ** int(self.grid.max_level)
        return remaining * int(self.grid.num_seen) >= SEEN_PER_ROW * expected_rows

    def _find_seen(self) -> Tensor:
        """(K, 64) bool: cells that had a weight in some color. FloatingPointError: there are none, of many weights; of
        few, nothing has been learned yet."""
        grid = self.grid
        seen = grid.occupied & (grid.max_weight.view(grid.occupied.shape) > self.config.prune_weight)
        if not seen.any() and grid.num_seen >= SEEN_PER_CELL * grid.occupied.sum():
            raise _nothing_seen()
        return seen

    def _leave_out_unseen(self) -> None:
        """Leave out cells but those that were seen and those around them, if enough was seen: what surfaces let
        through at first has made some behind them opaque, which views from elsewhere would see."""
        grid = self.grid
        if grid.num_seen >= SEEN_PER_CELL * grid.occupied.sum():
            near = grid.find_corners(self._find_seen())[:, None].to(self.dtype)
            grid.occupied &= unpack_bits(choose_ops(near).find_dense_cells(grid, near, 0.0))
            self.update_sampled()

    def _subdivide(self, seen: Tensor, remaining: float) -> bool:
        """Subdivide the cells that were seen, and those around them, as far as memory and what will be seen allow;
        False: they do not allow the finest level. Without it, this one ends later.

        Args:
            remaining: how much longer than until now the training goes on, as a multiple of the time until now.
        """
        grid = self.grid
        finer = self._find_finer(grid.to_cells(seen), remaining)
        if finer is None:
            grid.max_level -= 1
            grid.reset_max_weight()
            return False
        ratio = float(finer.cell_size / grid.cell_size)
        for parameter in (self.density, self.features):
            values, parameter.grad = parameter.data, None
            # of another type, so that torch forgets the shape, which a graph that the host still holds would keep
            parameter.data = values.new_empty(0, dtype=torch.float16)
            parameter.data = choose_ops(values).resample(finer.bricks, ratio, grid.numbers, values)
        self.grid = finer
        self.update_sampled()
        return True

    def _find_finer(self, kept: Tensor, remaining: float) -> BrickGrid | None:
        """Those of the grid's cells that are kept, halved; at last smaller, if enough will be seen for more rows;
        larger, if memory is too little. None: it is too little even for cells that are worth subdividing, now or, by
        an estimate of its rows, at the finest level."""
        grid, ratio = self.grid, 0.5
        assert self.config.max_memory is not None  # the config is resolved
        most = self.config.max_memory * 2**30 / BYTES_PER_ROW
        finer = subdivide(grid, kept, float(grid.cell_size) / 2)
        later = int(grid.max_level - grid.level) - 1
        if later and ratio * (finer.num_rows * ROWS_RATIO**later / most) ** 0.4 > MAX_RATIO:
            return None
        will_be_seen = remaining * int(grid.num_seen)
        learnable = 0 if later else min(ROWS_PER_SEEN * will_be_seen, ROWS_PER_PIXEL * int(grid.num_pixels))
        wanted = min(max(finer.num_rows, learnable), most)
        for _ in range(4):
            better = max(ratio * (finer.num_rows / wanted) ** 0.4, 0.25)  # surfaces are layers of some cells
            if better > MAX_RATIO:
                return None
            if 0.95 < better / ratio < 1.05:
                break
            ratio = better
            finer = subdivide(grid, kept, ratio * float(grid.cell_size))
        return finer


def _nothing_seen() -> FloatingPointError:
    return FloatingPointError("no cell has anything in it any more; try a lower --optimizer.lr, or a longer run")
