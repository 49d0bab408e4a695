"""Data manager and model together: what a training step needs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from edge_se_sampler.data.datamanager import VanillaDataManager
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.errors import InputError
from edge_se_sampler.models.config import LeanModelConfig, Model, ModelConfig
from edge_se_sampler.models.ray_model import RayModel
from edge_se_sampler.occupancy.bricks import BrickGrid
from edge_se_sampler.occupancy.depths import find_depths
from edge_se_sampler.occupancy.hull import Hull
from edge_se_sampler.occupancy.saved_grid import check_grid
from edge_se_sampler.occupancy.scene_analysis import SceneAnalysis, analyze_scene
from edge_se_sampler.sampling.random_streams import Stream, stream
from edge_se_sampler.sampling.settings import SamplingSettings

OTHER_WEIGHTS = "the checkpoint's weights are not this model's: another version wrote them"


@dataclass(frozen=True)
class Pipeline:
    """What callbacks and scoring may reach; nerfstudio's pipelines have the same two."""

    datamanager: VanillaDataManager
    model: Any
    """A RayModel."""
    data_summary: str = ""
    """What the training views are, in a line."""
    data_digest: str = ""
    """Of the training views."""
    memory_summary: str = ""
    """What training was estimated to take of memory, in a line; "": that is not known."""
    hull: Hull | None = None
    """The cells with which training begins; None: the model has no grid."""

    def has_data_of(self, state: Mapping[str, Any]) -> bool:
        """Whether a checkpoint is of a training on the same views, as far as it says."""
        return state.get("data_digest", self.data_digest) == self.data_digest

    @classmethod
    def build(
        cls,
        config: TrainerConfig,
        views: Views,
        device: str,
        saved_grid: BrickGrid | None = None,
        *,
        changed_data: bool = False,
    ) -> Pipeline:
        """Set up both for a resolved config; on the occupancy grid of a checkpoint, else on the scene's own. InputError
        if the checkpoint's grid is another scene's, unless that is accepted."""
        model_config, manager_config = config.pipeline.model, config.pipeline.datamanager
        grid, hull, has_masks, summary, digest = saved_grid, None, False, views.describe(), views.digest()
        if model_config.needs_grid:
            analysis = analyze_views(views, model_config)
            grid, hull = analysis.grid(), analysis.hull
            has_masks = analysis.num_silhouettes > 0
            if saved_grid is not None:
                if not (changed_data or saved_grid.is_of_the_same_scene(grid)):
                    changed = "its images, masks or cameras have changed since, or this machine rounds differently"
                    remedy = "restore the data, or go on in these cells by --changed-data True"
                    raise InputError(f"the scene's cells are not the checkpoint's: {changed}; {remedy}")
                saved_grid.scene = grid.scene  # that is its data from now on
            if manager_config.skip_empty_rays and has_masks:
                views = views.with_masks(analysis.hit_pixels)
        if isinstance(manager_config.pixel_sampler, SamplingSettings):
            manager_config = replace(manager_config, pixel_sampler=manager_config.pixel_sampler.resolve_auto(has_masks))
        background = (model_config.background_level,) * 3  # a random one has no edges of its own: white will do
        datamanager = manager_config.setup(views=views, device=device, background_color=background)
        model = build_model(config, device, saved_grid or grid)
        return cls(datamanager, model, summary, digest, views.memory, hull)


def analyze_views(views: Views, config: ModelConfig) -> SceneAnalysis:
    """`analyze_scene` with a model's settings."""
    size_px, by_alpha = config.voxel_size_px, config.culls_by_alpha
    share = config.near_share or 0.0 if isinstance(config, LeanModelConfig) else 0.0
    return analyze_scene(views, *config.depths, voxel_size_px=size_px, by_alpha=by_alpha, near_share=share)


def resolve_depths(views: Views, config: Model) -> tuple[Model, str]:
    """The config with near and far, where they are left out, from the training views, and their source; a near share
    that is left out follows from it."""
    if config.near is not None and config.far is not None:
        return config, "the settings"
    found = find_depths(views)
    if isinstance(config, LeanModelConfig) and config.near_share is None and config.near is None:
        config = replace(config, near_share=found.near_share)
    near = found.near if config.near is None else config.near
    far = found.far if config.far is None else config.far
    source = found.source if config.near is config.far is None else f"{found.source} and the settings"
    return replace(config, near=near, far=far), source


def build_model(config: TrainerConfig, device: str, grid: BrickGrid | None = None) -> RayModel:
    """The model with its initial weights: a function of the seed and the size alone, whatever the method."""
    rng = stream(config.machine.seed, 0, Stream.WEIGHTS)
    return config.pipeline.model.setup(rng=rng, grid=grid).to(device)


def saved_grid(weights: Mapping[str, Tensor]) -> BrickGrid | None:
    """The grid in a checkpoint's weights, None if it has none; InputError if another version wrote it."""
    state = {key.removeprefix("grid."): value for key, value in weights.items() if key.startswith("grid.")}
    if not state:
        return None
    try:
        check_grid(state)
        grid = BrickGrid.from_state(state)
        if not grid.has_all_corners():
            raise ValueError("corners of its cells are not stored")
        return grid
    except (KeyError, ValueError) as problem:
        raise InputError(f"{OTHER_WEIGHTS} ({problem})") from problem


def load_weights(model: RayModel, weights: Mapping[str, Tensor]) -> None:
    """Give a model, on its `saved_grid`, a checkpoint's weights; InputError if they are another model's."""
    try:
        model.load_state_dict(weights)
    except RuntimeError as problem:
        raise InputError(OTHER_WEIGHTS) from problem
