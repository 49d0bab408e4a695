"""Several trained models of a scene as one."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from edge_se_sampler.data.cameras import Cameras, RayBundle
from edge_se_sampler.models.ray_model import RayModel


class Ensemble(RayModel):
    """Renders the mean of the outputs of its members, models trained on the same scene with other seeds, whose errors
    cancel in part (deep ensembles, Lakshminarayanan et al. 2017). Its config is the first member's."""

    def __init__(self, members: Sequence[RayModel]) -> None:
        super().__init__(members[0].config, members[0].grid)
        self.meets_all_cells = members[0].meets_all_cells
        self.members = nn.ModuleList(members)

    @property
    def rays_per_chunk(self) -> int:
        return min(member.rays_per_chunk for member in self._models())

    def forward(self, rays: RayBundle) -> dict[str, Tensor]:
        """As `RayModel`, for the networks that all members have."""
        outputs = [self._render_member(member, rays) for member in self._models()]
        common = set.intersection(*(set(rendered) for rendered in outputs))
        return {key: torch.stack([rendered[key] for rendered in outputs]).mean(dim=0) for key in sorted(common)}

    def find_empty_depths(self, camera: Cameras) -> Tensor | None:
        found = [member.find_empty_depths(camera) for member in self._models()]
        known = [depths for depths in found if depths is not None]
        return torch.stack(known).amin(dim=0) if len(known) == len(found) else None

    def _render_member(self, member: RayModel, rays: RayBundle) -> dict[str, Tensor]:
        """A member's outputs, the background of its depth moved to where this model's config has it."""
        outputs = member(rays)
        if "depth_fine" in outputs:
            farther = (self.config.depths[1] - member.config.depths[1]) * rays.metadata["directions_norm"]
            outputs["depth_fine"] = outputs["depth_fine"] + (1 - outputs["accumulation_fine"]) * farther
        return outputs

    def _models(self) -> list[RayModel]:
        return [member for member in self.members if isinstance(member, RayModel)]  # what a type checker can tell
