"""InfoNeRF (Kim, Seo and Han 2022): rays should be sure of where they end, and near poses should agree.

alpha  opacity of each of the fine network's intervals along a ray, (n, s)
p, q   alpha / (sum alpha + 1e-10): of a ray, and of the same ray turned a little about the origin
H      -sum p log2(p + 1e-10), in bits: a ray's entropy
KL     sum q (log q - log p), in nats, both with 1e-10 added: what the turn tells

After the paper's public code, with one difference: its unseen poses come from all loaded ones, those of the validation
and test views included; here from between the training views (`Cameras.between`).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.models.config import InfoNeRFModelConfig
from edge_se_sampler.models.nerf import NeRFModel
from edge_se_sampler.models.rendering import opacity

TINY = 1e-10


def shares(alpha: Tensor) -> Tensor:
    """p of every interval, (n, s) -> (n, s); a ray without any opacity has none anywhere."""
    return alpha / (alpha.sum(dim=1, keepdim=True) + TINY)


def ray_entropy(alpha: Tensor, accumulation: Tensor, threshold: float) -> Tensor:
    """H of rays that hit something, 0 of the others.

    Args:
        alpha: (n, s).
        accumulation: (n, 1); a ray hits where it is above the threshold, through which no gradient flows.

    Returns:
        (n,) in bits, 0 .. log2(s).
    """
    p = shares(alpha)
    entropy = -(p * torch.log2(p + TINY)).sum(dim=1)
    return entropy * (accumulation.detach()[:, 0] > threshold)


def information_gain(alpha: Tensor, near: Tensor) -> Tensor:
    """KL from rays to the same rays turned a little; (n, s), (n, s) -> (n,) in nats, >= 0 to rounding."""
    p, q = shares(alpha) + TINY, shares(near) + TINY
    return (q * (q.log() - p.log())).sum(dim=1)


def turn(angles: Tensor) -> Tensor:
    """Rotation about x, y and z, the last first: (3,) radians -> (3, 3)."""
    (cx, cy, cz), (sx, sy, sz) = angles.cos().tolist(), angles.sin().tolist()
    about_x = [[1, 0, 0], [0, cx, -sx], [0, sx, cx]]
    about_y = [[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]
    about_z = [[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]
    x, y, z = (angles.new_tensor(matrix) for matrix in (about_x, about_y, about_z))
    return x @ y @ z


def turned(rays: RayBundle, rotation: Tensor) -> RayBundle:
    """Rays turned about the world's origin."""
    rotation = rotation.to(rays.origins)
    return RayBundle(rays.origins @ rotation.T, rays.directions @ rotation.T, rays.camera_indices, rays.metadata)


class InfoNeRFModel(NeRFModel):
    """NeRF with ray entropy minimisation on unseen rays and information gain reduction on all."""

    config: InfoNeRFModelConfig

    def __init__(self, config: InfoNeRFModelConfig, rng: np.random.Generator) -> None:
        super().__init__(config, rng)
        self.num_unseen_rays = config.num_unseen_rays or 0
        self.gain_weight = 0.0
        self.rotation = torch.eye(3)

    def begin_step(self, step: int, seed: int) -> None:
        """As the model's; and the step's little turn, and how much its information gain counts."""
        super().begin_step(step, seed)
        config = self.config
        self.gain_weight = config.gain_weight * config.gain_rate ** (step // config.gain_steps)
        if self.gain_weight:
            angles = 2 * self.uniform(1, 3)[0].cpu() - 1
            self.rotation = turn(angles * math.radians(config.gain_degrees))

    def training_loss(self, rays: RayBundle, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """(n,) NeRF's loss and the information gain; and the squared errors."""
        outputs = self(rays)
        loss, error = self.loss(outputs, batch)
        return loss + self._gain(rays, outputs), error

    def unseen_loss(self, rays: RayBundle) -> Tensor:
        """(n,) ray entropy and information gain."""
        outputs = self(rays)
        entropy = ray_entropy(_alpha(outputs), outputs["accumulation_fine"], self.config.entropy_threshold)
        return self.config.entropy_weight * entropy + self._gain(rays, outputs)

    def _gain(self, rays: RayBundle, outputs: dict[str, Tensor]) -> Tensor:
        """Seen and unseen rays, each a mean of its own, count half each; alone, the former count all."""
        if not self.gain_weight:
            return torch.zeros((), device=self.device)
        near = self(turned(rays, self.rotation))
        return self.gain_weight / (2 if self.num_unseen_rays else 1) * information_gain(_alpha(outputs), _alpha(near))


def _alpha(outputs: dict[str, Tensor]) -> Tensor:
    return opacity(outputs["density_fine"], outputs["delta_fine"])
