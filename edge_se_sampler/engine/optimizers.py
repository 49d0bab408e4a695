"""Adam, which also takes the sparse gradients of tables of which a step touches few rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import torch

from edge_se_sampler.engine.config import OptimizerConfig
from edge_se_sampler.errors import InputError
from edge_se_sampler.models.config import SizePreset
from edge_se_sampler.models.ray_model import ParameterGroup
from edge_se_sampler.models.voxel_backend import choose_ops

TOTAL_VARIATION_INTERVAL = 4
"""Steps between two that total variation counts in, by as much more: looking at all neighbors takes time."""


class RowAdam(torch.optim.Adam):
    """torch's Adam; of weights that have a sparse gradient, only the rows that it has are moved, by Adam without bias
    correction, and their running means are only then updated (as DVGO's and torch's SparseAdam do); that of the squared
    gradients is one for all of a row.

    Groups may have `maximum`, the largest value of such rows, and `total_variation`, by which the differences between
    a row and its neighbors in its brick count in its gradient.
    """

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.grad is None:
                    continue
                self._check_state(weight)
                if weight.grad.is_sparse:
                    self._step_rows(group, weight)
                    weight.grad = None
        return super().step(closure)

    def _check_state(self, weight: torch.Tensor) -> None:
        """InputError if a checkpoint's running mean of squares has another shape than a weight's gradient needs:
        compiled and fused steps would not find out."""
        assert weight.grad is not None
        shape = weight[:, :1].shape if weight.grad.is_sparse else weight.shape
        square = self.state.get(weight, {}).get("exp_avg_sq")
        if square is not None and square.shape != shape:
            problem = "the checkpoint's optimizer is not of a training by this run's config.json"
            raise InputError(f"{problem}; begin a new training")

    def _step_rows(self, group: dict[str, Any], weight: torch.Tensor) -> None:
        state, interval = self.state[weight], TOTAL_VARIATION_INTERVAL
        if not state:
            state["step"] = torch.tensor(0.0)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(weight), torch.zeros_like(weight[:, :1])
        state["step"] += 1
        choose_ops(weight).adam_rows(
            weight,
            state["exp_avg"],
            state["exp_avg_sq"],
            weight.grad,
            lr=group["lr"],
            betas=group["betas"],
            eps=group["eps"],
            maximum=group["maximum"],
            total_variation=0.0 if state["step"] % interval else interval * group["total_variation"],
        )


def create_adam(groups: Sequence[ParameterGroup], preset: SizePreset, config: OptimizerConfig) -> RowAdam:
    """Adam over groups of weights, for the training that a preset without open numbers describes."""
    return build_adam(torch_groups(groups, preset.learning_rate, preset.rays), config)


def torch_groups(groups: Sequence[ParameterGroup], learning_rate: float, rays: int) -> list[dict[str, Any]]:
    """Groups of weights as torch's optimizers and `RowAdam` take them, for trainings of so many rays a step."""
    return [
        {
            "params": group.parameters,
            "lr": learning_rate * group.lr_scale,
            "maximum": group.maximum,
            # the loss is a mean over rays and channels
            "total_variation": group.total_variation / (3 * rays),
        }
        for group in groups
    ]


def build_adam(groups: list[dict[str, Any]], config: OptimizerConfig) -> RowAdam:
    """Adam over `torch_groups`."""
    betas = (0.9, float(config.beta2))  # torch refuses an int, which json may have
    if config.fused:
        with suppress(RuntimeError):  # before torch 2.4, for weights on a GPU only
            return RowAdam([dict(group) for group in groups], betas=betas, eps=config.eps, fused=True)
    return RowAdam(groups, betas=betas, eps=config.eps)


def learning_rate_factor(config: OptimizerConfig, progress: float, step: int) -> float:
    """Learning rate of a step as a share of the initial one; `progress` is the part of the training, in [0, 1], that is
    done when it begins."""
    return config.final_fraction**progress * min(1.0, (step + 1) / (config.warmup_steps + 1))
