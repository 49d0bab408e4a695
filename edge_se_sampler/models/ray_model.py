"""The contract of every model with training, evaluation and samplers: rays -> colors and their errors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from edge_se_sampler import ranks
from edge_se_sampler.data.cameras import Cameras, RayBundle
from edge_se_sampler.models.config import ModelConfig
from edge_se_sampler.occupancy.bricks import BrickGrid
from edge_se_sampler.protocol import TrainingCallback, TrainingCallbackAttributes


@dataclass(frozen=True)
class ParameterGroup:
    """Weights that are optimized alike."""

    parameters: list[nn.Parameter]
    lr_scale: float = 1.0
    """Their learning rate, as a multiple of the run's."""
    maximum: float = float("inf")
    """Upper bound that weights with sparse gradients (an embedding's) are clamped to."""
    total_variation: float = 0.0
    """Weight, relative to a ray's squared error, of the total variation of weights with sparse gradients."""


class RayModel(nn.Module, ABC):
    """Renders rays, by a resolved config; outside the occupied cells of its grid, if it has one, no network is
    evaluated, and the density is 0."""

    networks: tuple[str, ...] = ("fine",)
    """Names of the networks, each an attribute; the colors of "fine" are the model's."""
    meets_all_cells: bool = False
    """Whether rays meet all cells of its grid between their "nears" and "fars", if they have them; else samples lie
    between the model's depths."""

    def __init__(self, config: ModelConfig, grid: BrickGrid | None) -> None:
        super().__init__()
        self.config = config
        self.grid = grid
        self.num_unseen_rays = config.preset.num_unseen_rays
        """Rays a step, of cameras between the training views, that `auxiliary_loss` regularizes."""
        self.random = torch.Generator()
        """Source of jitter, noise and random backgrounds; seeded at every training step."""
        self._chunk_rays = 0
        """Rays of the chunk, of all ranks, that is trained on."""
        self.background_fn: Callable[[RayBundle], Tensor] | None = None
        """n rays -> (n, 3) background colors in [0, 1], in place of the config's background color."""

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    @property
    def dtype(self) -> torch.dtype:
        return next(self.parameters()).dtype

    @property
    @abstractmethod
    def rays_per_chunk(self) -> int:
        """How many rays are rendered at once, which bounds the memory."""

    def chunks(self, num_rays: int) -> Iterator[slice]:
        """Slices of that many rays, each small enough to be rendered at once."""
        size = self.rays_per_chunk
        return (slice(start, start + size) for start in range(0, num_rays, size))

    def own_chunks(self, num_rays: int) -> Iterator[slice]:
        """`chunks` of a training step's rays; of several ranks each gets every so manieth ray of every chunk, and draws
        for them what a single process would draw."""
        for chunk in self.chunks(num_rays):
            self._chunk_rays = min(chunk.stop, num_rays) - chunk.start
            yield slice(chunk.start + ranks.rank(), chunk.stop, ranks.world_size())
        self._chunk_rays = 0

    @abstractmethod
    def forward(self, rays: RayBundle) -> dict[str, Tensor]:
        """Render n rays; in training mode with jittered samples.

        Returns:
            rgb_NETWORK (n, 3) and accumulation_NETWORK (n, 1) of each network; depth_fine (n, 1), world units along the
            ray; background (n, 3), the colors that the rays are composited on.
        """

    def find_empty_depths(self, camera: Cameras) -> Tensor | None:
        """Depths along one camera's optical axis, (H W,), world units, before which the rays of a pixel meet nothing;
        inf: they never do. As "empty_depths" (n, 1) in rays' metadata they make rendering faster. None: not known."""
        return None

    def parameter_groups(self) -> list[ParameterGroup]:
        """All weights, in groups that are optimized differently."""
        return [ParameterGroup(list(self.parameters()))]

    def get_training_callbacks(self, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:
        """What the model does between training steps; nothing by default."""
        return []

    def begin_step(self, step: int, seed: int) -> None:
        """Begin training step 0, 1, 2, ...: all that it draws is a function of the seed."""
        if self.random.device != self.device:
            self.random = torch.Generator(self.device)
        self.random.manual_seed(seed)

    def squared_error(self, outputs: dict[str, Tensor], image: Tensor, network: str = "fine") -> Tensor:
        """(n,) squared error of every ray, summed over channels (NeRF, equation 6): outputs of `forward` against
        straight-alpha pixels (n, 3|4) in [0, 1]."""
        return (outputs[f"rgb_{network}"] - target_colors(image, outputs["background"])).square().sum(dim=1)

    def training_loss(self, rays: RayBundle, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Render n rays: their losses (n,), whose mean is minimized, and the fine network's squared errors (n,)."""
        return self.loss(self(rays), batch)

    def auxiliary_loss(self, rays: RayBundle) -> Tensor:
        """(n,) loss of `num_unseen_rays` rays without pixels, whose mean training minimizes as well; 0 by default."""
        return torch.zeros(len(rays), device=self.device)

    def loss(self, outputs: dict[str, Tensor], batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Squared errors of every ray, (n,), a mean over channels as in NeRF's code, summed over the networks, and
        times batch["weight"] (n,) if there is one; and the fine network's squared errors, (n,), detached."""
        error = fine = self.squared_error(outputs, batch["image"], "fine")
        for network in self.networks[:-1]:
            error = self.squared_error(outputs, batch["image"], network) + error
        return (error * batch["weight"] / 3 if "weight" in batch else error / 3), fine.detach()

    def get_background(self, rays: RayBundle) -> Tensor:
        """(n, 3) background colors of n rays, in [0, 1]."""
        if self.background_fn is not None:
            return self.background_fn(rays)
        if self.training and self.config.background_color == "random":
            return self.uniform(len(rays), 3)
        return torch.full((len(rays), 3), self.config.background_level, device=self.device, dtype=self.dtype)

    def uniform(self, rows: int, columns: int) -> Tensor:
        """(rows, columns) uniform draws in [0, 1) from the step's generator."""
        return self.draw(torch.rand, rows, columns)

    def draw(self, kind: Callable[..., Tensor], rows: int, columns: int) -> Tensor:
        """(rows, columns) draws from the step's generator by torch.rand or torch.randn; where a row is one of
        `own_chunks`' rays, its part of the chunk's draws."""
        own, whole = slice(ranks.rank(), None, ranks.world_size()), self._chunk_rays
        if rows != len(range(whole)[own]):
            own, whole = slice(None), rows
        return kind((whole, columns), generator=self.random, device=self.device, dtype=self.dtype)[own]


def target_colors(image: Tensor, background: Tensor) -> Tensor:
    """The colors (n, 3) that rays should have: pixels (n, 3|4), straight alpha, composited on backgrounds (n, 3)."""
    if image.shape[1] == 3:
        return image
    return image[:, :3] * image[:, 3:] + background * (1 - image[:, 3:])
