"""A second chance for dead networks.

With a ReLU a network whose raw density is negative at every sample has no gradient left: no sampler and no number
of steps can help it. It may be born so, or training may kill it. Coarse and fine are revived each by itself: with a
dead coarse network the fine one trains on evenly spread samples, with a dead fine one nothing is rendered.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.engine.evaluation import render_rays
from edge_se_sampler.models.field import NeRFField
from edge_se_sampler.models.ray_model import RayModel
from edge_se_sampler.sampling.random_streams import Stream, stream

PATIENCE = 8
"""Batches in a row without any density gradient, before the probe is asked."""
PROBE_RAYS = 512


def dead_networks(model: RayModel, probes: Iterable[RayBundle]) -> list[str]:
    """Which of its networks have no density at any sample of the rays.

    The last interval is endless: the least density anywhere would make its ray opaque.
    """
    parts = list(probes)
    return [lvl for lvl in model.networks if not any(render_rays(model, r, f"accumulation_{lvl}").any() for r in parts)]


class DeadNetworkReset:
    """Gives a dead network new initial weights, of the next sub-seed: a function of the seed and of how many have
    been used, as everything random is.

    Args:
        probe: fixed rays that tell a dead network from one that has met empty batches.
        seed: the run's.
    """

    def __init__(self, model: RayModel, optimizer: torch.optim.Optimizer, probe: RayBundle, seed: int) -> None:
        self.model, self.optimizer, self.probe, self.seed = model, optimizer, probe, seed
        self.silent = dict.fromkeys(model.networks, 0)
        self.used = 0

    def after_backward(self) -> dict[str, int]:
        """Look at the gradients of a step; the networks that were given new weights, and of which sub-seed."""
        suspects = []
        for level in self.model.networks:
            gradient = getattr(self.model, level).density.weight.grad
            self.silent[level] = 0 if gradient.any() else self.silent[level] + 1
            if self.silent[level] >= PATIENCE:
                suspects.append(level)
                self.silent[level] = 0  # asked again after as many
        if not suspects:
            return {}
        dead = [level for level in dead_networks(self.model, [self.probe]) if level in suspects]
        return {level: self._begin_anew(getattr(self.model, level)) for level in dead}

    def _begin_anew(self, field: NeRFField) -> int:
        self.used += 1
        field.initialize(self.model.config.initialization, stream(self.seed, self.used, Stream.WEIGHTS))
        for weight in field.parameters():
            self.optimizer.state.pop(weight, None)
        return self.used

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"silent": dict(self.silent), "used": self.used}

    def load(self, state: dict[str, Any]) -> None:
        """Go on where `state` was taken."""
        self.silent, self.used = dict(state["silent"]), state["used"]
