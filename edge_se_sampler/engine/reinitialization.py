"""New initial weights for dead networks.

With a ReLU, a network whose raw density is negative at every sample has no gradient: no sampler and no number of steps
can help it. Coarse and fine network die, and are reinitialized, independently of each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.engine.rendering import render_rays
from edge_se_sampler.models.config import NeRFModelConfig
from edge_se_sampler.models.field import NeRFField, initialize_linear
from edge_se_sampler.models.ray_model import RayModel
from edge_se_sampler.sampling.random_streams import Stream, stream

PATIENCE = 8
"""Steps in a row without any density gradient, after which the probe rays are rendered."""
PROBE_RAYS = 512


def dead_networks(model: RayModel, probes: Sequence[RayBundle]) -> list[str]:
    """Names of the model's networks that have no density at any sample of the rays."""
    # accumulation 0: any density at a sample makes its ray a little opaque
    return [
        name for name in model.networks if not any(render_rays(model, r, f"accumulation_{name}").any() for r in probes)
    ]


class DeadNetworkReset:
    """Gives a dead network new initial weights: a function of the run's seed and of how many sub-seeds were used.
    `probe` are fixed rays, which distinguish a dead network from one whose last batches were empty."""

    def __init__(self, model: RayModel, optimizer: torch.optim.Optimizer, probe: RayBundle, seed: int) -> None:
        self.model, self.optimizer, self.probe, self.seed = model, optimizer, probe, seed
        self.steps_without_gradient = dict.fromkeys(model.networks, 0)
        self.used_sub_seeds = 0

    def after_backward(self) -> dict[str, int]:
        """Look at a step's gradients, reinitialize what is dead, and return each such network's name -> sub-seed."""
        counts = self.steps_without_gradient
        for name in counts:
            counts[name] = 0 if getattr(self.model, name).density.weight.grad.any() else counts[name] + 1
        suspects = [name for name, count in counts.items() if count >= PATIENCE]
        counts.update(dict.fromkeys(suspects, 0))
        dead = [name for name in dead_networks(self.model, [self.probe]) if name in suspects] if suspects else []
        return {name: self._reinitialize(getattr(self.model, name)) for name in dead}

    def _reinitialize(self, field: NeRFField) -> int:
        config = self.model.config
        assert isinstance(config, NeRFModelConfig)
        self.used_sub_seeds += 1
        rng = stream(self.seed, self.used_sub_seeds, Stream.WEIGHTS)
        initialize_linear(field, config.initialization, rng)
        for weight in field.parameters():
            self.optimizer.state.pop(weight, None)
        return self.used_sub_seeds

    def state_dict(self) -> dict[str, Any]:
        return {"steps_without_gradient": dict(self.steps_without_gradient), "used_sub_seeds": self.used_sub_seeds}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.steps_without_gradient = dict(state["steps_without_gradient"])
        self.used_sub_seeds = state["used_sub_seeds"]
