"""What every model is to training, evaluation and samplers: rays -> colours and their errors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.errors import InputError
from edge_se_sampler.models.config import ModelConfig
from edge_se_sampler.occupancy.grid import OccupancyGrid


class RayModel(nn.Module, ABC):
    """Renders rays; every network of it is one of `networks`, "fine" the one whose colours count."""

    networks: tuple[str, ...] = ("fine",)
    num_unseen_rays = 0
    """Rays a step, of cameras between the training views, that `auxiliary_loss` regularizes."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.grid: OccupancyGrid | None = None
        """Where networks are asked; None: everywhere."""
        self.random = torch.Generator()
        """Of jitter, noise and random backgrounds; the trainer seeds it at every step."""
        self.background_fn: Callable[[RayBundle], Tensor] | None = None
        """n rays -> (n, 3) background colours in [0, 1], in place of the config's background color."""

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Where the weights are."""

    @abstractmethod
    def chunks(self, rays: int) -> Iterator[slice]:
        """Rows of that many rays, as many at a time as are worth rendering at once."""

    @abstractmethod
    def forward(self, rays: RayBundle) -> dict[str, Tensor]:
        """Render n rays; in training mode with jittered samples.

        Returns:
            rgb_NETWORK (n, 3) and accumulation_NETWORK (n, 1) of each network; depth_fine (n, 1), world units along the
            ray; background (n, 3), the colours that the rays are composited on.
        """

    def parameter_groups(self) -> list[tuple[list[nn.Parameter], float]]:
        """Weights, and their learning rate as a multiple of the run's."""
        return [(list(self.parameters()), 1.0)]

    def begin_step(self, step: int, seed: int) -> None:
        """Make the randomness of what follows a function of the seed, in a training step (0, 1, 2, ...)."""
        if self.random.device != self.device:
            self.random = torch.Generator(self.device)
        self.random.manual_seed(seed)

    @property
    def needs_cells(self) -> bool:
        """Whether it is to be settled in the scene's cells before it is trained."""
        return self.config.empty_space_skipping

    def settle(self, grid: OccupancyGrid) -> None:
        """Ask networks only in the grid's cells from now on."""
        self.grid = grid.to(self.device, self.dtype)

    def load_state_dict(self, state_dict: Mapping[str, Any], *args: Any, **kwargs: Any) -> Any:
        """As torch's; a state with cells settles the model in them.

        Raises:
            InputError: it is another model's, or the model is settled in other cells: features would lie at other
                corners.
        """
        if "grid.hull" in state_dict:
            told = {key.removeprefix("grid."): told for key, told in state_dict.items() if key.startswith("grid.")}
            first, splits = OccupancyGrid.at_first(told)
            if self.grid is None:
                self.settle(first)
            elif not first.is_the_same_as(self.grid):
                raise InputError(
                    "the scene's cells are not the checkpoint's: its images, masks or cameras have changed since, or "
                    "this machine rounds otherwise; resume with what it began with, or train anew"
                )
            assert self.grid is not None
            for _ in range(splits):
                self.grid.split()
        try:
            return super().load_state_dict(state_dict, *args, **kwargs)
        except RuntimeError as problem:
            raise InputError("the checkpoint's weights are not this model's: another version wrote them") from problem

    def squared_error(self, outputs: dict[str, Tensor], image: Tensor, network: str = "fine") -> Tensor:
        """(n,) squared error of every ray, ||C_hat - C||^2 of equation 1 of the paper.

        Args:
            image: (n, 3|4) straight-alpha pixels in [0, 1].
        """
        return (outputs[f"rgb_{network}"] - target_colors(image, outputs["background"])).square().sum(dim=1)

    def training_loss(self, rays: RayBundle, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """(n,) what training minimises the mean of on a batch's rays, and (n,) the fine colours' squared errors."""
        return self.loss(self(rays), batch)

    def auxiliary_loss(self, rays: RayBundle) -> Tensor:
        """(n,) loss of `num_unseen_rays` rays without pixels, whose mean training minimizes as well; 0 by default."""
        return torch.zeros(len(rays), device=self.device)

    def loss(self, outputs: dict[str, Tensor], batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """The loss of every ray, (n,), and the fine network's squared errors, (n,), detached.

        The loss is the squared error, a mean over channels as in NeRF's code, summed over the networks, and times
        batch["weight"] (n,) if there is one.
        """
        error = fine = self.squared_error(outputs, batch["image"], "fine")
        for network in self.networks[:-1]:
            error = self.squared_error(outputs, batch["image"], network) + error
        return (error * batch["weight"] / 3 if "weight" in batch else error / 3), fine.detach()

    def get_background(self, rays: RayBundle) -> Tensor:
        """(n, 3) background colours of n rays, in [0, 1]."""
        if self.background_fn is not None:
            return self.background_fn(rays)
        if self.training and self.config.background_color == "random":
            return self.uniform(len(rays), 3)
        return torch.full((len(rays), 3), self.config.background_level, device=self.device, dtype=self.dtype)

    @property
    def dtype(self) -> torch.dtype:
        """Of the weights."""
        return next(self.parameters()).dtype

    def uniform(self, rows: int, columns: int) -> Tensor:
        """(rows, columns) in [0, 1), of the step's randomness."""
        return torch.rand((rows, columns), generator=self.random, device=self.device, dtype=self.dtype)


def target_colors(image: Tensor, background: Tensor) -> Tensor:
    """What a ray should show: (n, 3|4) straight-alpha pixels composited on (n, 3) backgrounds."""
    if image.shape[1] == 3:
        return image
    return image[:, :3] * image[:, 3:] + background * (1 - image[:, 3:])
