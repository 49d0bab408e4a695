"""InfoNeRF (Kim, Seo and Han 2022): rays of low entropy, and nearby poses that agree.

alpha  opacity of each of the fine network's intervals along a ray, (n, s)
p, q   alpha / (sum alpha + 1e-10): of a ray, and of the same ray rotated a little about the origin
H      -sum p log2(p + 1e-10), in bits: a ray's entropy
KL     sum q (log q - log p), in nats, both with 1e-10 added: the information gain

After the paper's public code, with one difference: its unseen poses come from all loaded views, validation and test
included; here they lie between the training views.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.models.config import InfoNeRFModelConfig
from edge_se_sampler.models.nerf import NeRFModel

TINY = 1e-10


def ray_pdf(alpha: Tensor) -> Tensor:
    """p of every interval, (n, s) -> (n, s); all 0 on a ray without any opacity."""
    return alpha / (alpha.sum(dim=1, keepdim=True) + TINY)


def ray_entropy(alpha: Tensor, accumulation: Tensor, threshold: float) -> Tensor:
    """H (n,) in bits, 0 .. log2(s), of alphas (n, s); 0 for rays that hit nothing, whose accumulation (n, 1) is at most
    the threshold. No gradient flows through the accumulation."""
    p = ray_pdf(alpha)
    return -(p * torch.log2(p + TINY)).sum(dim=1) * (accumulation.detach()[:, 0] > threshold)


def information_gain(alpha: Tensor, rotated_alpha: Tensor) -> Tensor:
    """KL between rays and the same rays rotated a little; (n, s), (n, s) -> (n,) in nats, >= 0 up to rounding."""
    p, q = ray_pdf(alpha) + TINY, ray_pdf(rotated_alpha) + TINY
    return (q * (q.log() - p.log())).sum(dim=1)


def rotation_matrix(angles: Tensor) -> Tensor:
    """Rotation about x, y and z, the last first: (3,) radians -> (3, 3)."""
    (cx, cy, cz), (sx, sy, sz) = angles.cos().tolist(), angles.sin().tolist()
    about_x = [[1, 0, 0], [0, cx, -sx], [0, sx, cx]]
    about_y = [[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]
    about_z = [[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]
    x, y, z = (angles.new_tensor(matrix) for matrix in (about_x, about_y, about_z))
    return x @ y @ z


def rotate_rays(rays: RayBundle, rotation: Tensor) -> RayBundle:
    """The rays rotated about the world's origin by a (3, 3) matrix."""
    turned = rotation.to(rays.origins).T
    metadata = rays.metadata | {"pixel_axes": rays.metadata["pixel_axes"] @ turned}
    return RayBundle(rays.origins @ turned, rays.directions @ turned, rays.camera_indices, metadata)


class InfoNeRFModel(NeRFModel):
    """NeRF with ray entropy minimization on unseen rays and information gain reduction on all."""

    config: InfoNeRFModelConfig
    gain_weight = 0.0
    rotation = torch.eye(3)

    def begin_step(self, step: int, seed: int) -> None:
        """As `RayModel`; draws the step's small rotation, and decays the weight of the information gain."""
        super().begin_step(step, seed)
        config = self.config
        self.gain_weight = config.gain_weight * config.gain_rate ** (step // config.gain_steps)
        if self.gain_weight:
            angles = 2 * self.uniform(1, 3)[0].cpu() - 1
            self.rotation = rotation_matrix(angles * math.radians(config.gain_degrees))

    def training_loss(self, rays: RayBundle, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """As `RayModel`; NeRF's loss plus the information gain."""
        outputs = self(rays)
        loss, error = self.loss(outputs, batch)
        return loss + self._gain(rays, outputs), error

    def auxiliary_loss(self, rays: RayBundle) -> Tensor:
        """(n,) weighted ray entropy plus information gain of rays without an image."""
        outputs = self(rays)
        entropy = ray_entropy(_alpha(outputs), outputs["accumulation_fine"], self.config.entropy_threshold)
        return self.config.entropy_weight * entropy + self._gain(rays, outputs)

    def _gain(self, rays: RayBundle, outputs: dict[str, Tensor]) -> Tensor:
        """Weighted information gain, (n,): the means over seen and unseen rays count half each, if there are both."""
        if not self.gain_weight:
            return torch.zeros((), device=self.device)
        gain = information_gain(_alpha(outputs), _alpha(self(rotate_rays(rays, self.rotation))))
        return self.gain_weight / (2 if self.num_unseen_rays else 1) * gain


def _alpha(outputs: dict[str, Tensor]) -> Tensor:
    return -torch.expm1(-outputs["density_fine"] * outputs["delta_fine"])
