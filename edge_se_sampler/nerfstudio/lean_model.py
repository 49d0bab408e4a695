"""lean-nerf as a model of nerfstudio: the standalone program's `LeanModel` between nerfstudio's rays and losses."""
# pyright: reportMissingImports=false
# nerfstudio's pins rule out the environment that is linted; here its classes count as unknown

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Annotated, Any, ClassVar

import torch
import tyro
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.model_components.renderers import RGBRenderer
from nerfstudio.models.base_model import Model, ModelConfig
from nerfstudio.utils import colormaps
from torch import Tensor

from edge_se_sampler import protocol
from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.engine.config import OptimizerConfig
from edge_se_sampler.engine.optimizers import RowAdam, build_adam, learning_rate_factor, torch_groups
from edge_se_sampler.engine.pipeline import OTHER_WEIGHTS, analyze_views, resolve_depths, saved_grid
from edge_se_sampler.errors import InputError
from edge_se_sampler.models.compilation import compile_ops
from edge_se_sampler.models.config import LeanModelConfig, decide_size
from edge_se_sampler.models.lean import LeanModel
from edge_se_sampler.models.rendering import remove_background
from edge_se_sampler.nerfstudio.resume import run_progress
from edge_se_sampler.occupancy.bricks import BrickGrid
from edge_se_sampler.sampling.image_batch import unit_interval
from edge_se_sampler.sampling.random_streams import Stream, stream

GROUP = "fields"
"""All weights: one optimizer steps them."""


class LeanNerfModel(Model):
    """Density and features at the corners of cells, which follow from the training images' cameras and alpha."""

    config: LeanNerfModelConfig

    def populate_modules(self) -> None:
        """Derive the cells from the training images, or, without images, leave them to a checkpoint. InputError for
        settings out of range or without meaning here, and for another data manager than lean-nerf's."""
        super().populate_modules()
        config, metadata = self.config.lean, self.kwargs["metadata"]
        if "read_views" not in metadata:
            raise InputError("lean-nerf needs the images' alpha and cameras: leave its data manager as it is")
        if config.background_color == "random" or config.size != "auto":
            problem = "neither --pipeline.model.size nor a random background-color has a meaning inside nerfstudio"
            raise InputError(f"{problem}: leave them out")
        compile_ops(torch.device(self.kwargs["device"]).type)
        self.hit_pixels = None
        """(H, W) bool of each training image: the pixels whose rays meet a cell, where alpha tells; for the data
        manager, which forgets them here."""
        if metadata["read_views"] is None:
            cells = torch.ones((1, 1, 1), dtype=torch.bool)
            grid, config = BrickGrid.from_cells(torch.zeros(3), 1.0, cells), replace(config, size="paper")
        else:
            views = metadata["read_views"]()
            config, _ = resolve_depths(views, decide_size(config, views.longest_side))
            config.check("pipeline.model.")
            analysis = analyze_views(views, config)
            grid = analysis.grid()
            self.hit_pixels = analysis.hit_pixels if analysis.num_silhouettes else None
        color, level = metadata["alpha_color"], config.background_level
        self.renderer_rgb = RGBRenderer(background_color=torch.full((3,), level) if color is None else color.float())
        rng = stream(torch.initial_seed(), 0, Stream.WEIGHTS)  # nerfstudio's seed
        self.field: LeanModel = config.setup(rng=rng, grid=grid)
        self.field.background_fn = lambda rays: self._background(rays.origins)
        self.register_buffer("depths", torch.tensor(config.depths, dtype=torch.float64))

    def _background(self, like: Tensor) -> Tensor:
        """The background's color, or what nerfstudio's viewer has in its place, as often as `like` (n, 3) has rows."""
        color = self.renderer_rgb.background_color
        return self.renderer_rgb.get_background_color(color, shape=like.shape, device=like.device)

    def get_outputs(self, ray_bundle: Any) -> dict[str, Any]:
        """rgb (n, 3) and accumulation (n, 1); in evaluation depth (n, 1) along the ray, of what stops more than half of
        the light, or far; in training what they were made of."""
        rays = convert_rays(ray_bundle)
        if self.training:
            outputs, rendered = self.field.render(rays)
            return {"rgb": outputs["rgb_fine"], "accumulation": outputs["accumulation_fine"], "rendered": rendered}
        # as many rays at once as its memory allows, which hosts do not know
        parts = [self.field.render(rays[some])[0] for some in self.field.chunks(len(rays))]
        names = "rgb_fine", "accumulation_fine", "depth_fine"
        rgb, opacity, depth = (torch.cat([part[name] for part in parts]) for name in names)
        far = self.field.config.depths[1] * rays.metadata["directions_norm"]
        depth = remove_background(depth, opacity, far)
        return {"rgb": rgb, "accumulation": opacity, "depth": torch.where(opacity > 0.5, depth, far)}

    def get_loss_dict(self, outputs: Any, batch: Any, metrics_dict: Any = None) -> dict[str, Tensor]:
        """The loss of `LeanModel`: of colors, and of opacity where images have alpha; weighted if the batch is."""
        if self.training:
            self.field.remember(outputs["rendered"])
        names = {f"{name}_fine": outputs[name] for name in ("rgb", "accumulation")}
        pixels = {"image": unit_interval(batch["image"].to(self.device))}
        if "weight" in batch:
            pixels["weight"] = batch["weight"].to(self.device)
        loss, _ = self.field.loss(names | {"background": self._background(outputs["rgb"])}, pixels)
        return {"loss": loss.mean()}

    def get_metrics_dict(self, outputs: Any, batch: Any) -> dict[str, Tensor]:
        return {"psnr": psnr(outputs["rgb"], self._target(batch))}

    def get_image_metrics_and_images(self, outputs: Any, batch: Any) -> tuple[dict[str, float], dict[str, Tensor]]:
        """PSNR and SSIM. LPIPS, whose weights would have to be downloaded, is left out."""
        from torchmetrics.functional import structural_similarity_index_measure  # as slow to import as all the rest

        target, rgb, accumulation = self._target(batch), outputs["rgb"], outputs["accumulation"]
        of_batch = (image.permute(2, 0, 1)[None] for image in (target, rgb))
        ssim = structural_similarity_index_measure(*of_batch, data_range=1.0)
        images = {
            "img": torch.cat((target, rgb), dim=1),
            "accumulation": colormaps.apply_colormap(accumulation),
            "depth": colormaps.apply_depth_colormap(outputs["depth"], accumulation=accumulation),
        }
        return {"psnr": float(psnr(rgb, target)), "ssim": float(ssim)}, images

    def _target(self, batch: Any) -> Tensor:
        """The batch's colors in front of the background."""
        return self.renderer_rgb.blend_background(unit_interval(batch["image"].to(self.device)))

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Straight alpha: nothing of the background. So exports leave it out."""
        opacity = outputs["accumulation"]
        rgb = remove_background(outputs[output_name], opacity, self._background(outputs[output_name]))
        return torch.cat((rgb.clamp(0, 1), opacity), dim=-1)

    def get_param_groups(self) -> dict[str, Any]:
        """Torch's groups of one optimizer; their learning rates are multiples of its own."""
        rays = self.kwargs["metadata"]["train_num_rays_per_batch"]
        return {GROUP: torch_groups(self.field.parameter_groups(), 1.0, rays)}

    def get_training_callbacks(self, training_callback_attributes: Any) -> list[TrainingCallback]:
        """Those of `LeanModel`; and what a training step begins with: the seed of its jitter, and its learning rate."""
        trainer = training_callback_attributes.trainer
        _check(trainer)
        progress, seed = run_progress(trainer), trainer.config.machine.seed
        settings, optimizer = (x[GROUP] for x in (trainer.config.optimizers, trainer.optimizers.optimizers))

        def begin_step(step: int) -> None:
            self.field.begin_step(step, int(stream(seed, step, Stream.MODEL).integers(2**63)))
            factor = learning_rate_factor(settings["optimizer"], progress(step), step)
            for group in optimizer.param_groups:
                group["lr"] = group["initial_lr"] * factor

        preset = SimpleNamespace(rays=self.kwargs["metadata"]["train_num_rays_per_batch"])
        host: Any = SimpleNamespace(progress=progress, optimizer=optimizer, config=SimpleNamespace(preset=preset))
        attributes = protocol.TrainingCallbackAttributes(training_callback_attributes.pipeline, host)
        functions = [callback.func for callback in self.field.get_training_callbacks(attributes)]
        before = [TrainingCallbackLocation.BEFORE_TRAIN_ITERATION]
        return [TrainingCallback(before, function) for function in (*functions, begin_step)]

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """As torch, on the checkpoint's cells and with as many numbers as they have; InputError if another version
        wrote it."""
        weights = {key.removeprefix("field."): value for key, value in state_dict.items()}
        grid = saved_grid(weights)
        if grid is not None:
            self.field.grid = grid.to(self.device)
            for name in ("density", "features"):
                parameter = getattr(self.field, name)
                parameter.data = parameter.data.new_empty((grid.num_rows, parameter.shape[1]), device=self.device)
        try:
            result = super().load_state_dict(state_dict, strict, assign)
        except RuntimeError as problem:
            raise InputError(OTHER_WEIGHTS) from problem
        near, far = self.depths.tolist()
        self.field.config = replace(self.field.config, near=near, far=far)
        return result


def _check(trainer: Any) -> None:
    """InputError for what nerfstudio's trainer could do and gradients of few rows, or cells that change, cannot."""
    config = trainer.config
    flags = {
        "mixed-precision True": config.mixed_precision,
        "use-grad-scaler True": config.use_grad_scaler,
        "gradient-accumulation-steps": any(steps > 1 for steps in config.gradient_accumulation_steps.values()),
        "machine.num-devices above 1": trainer.world_size > 1,
    }
    for flag, given in flags.items():
        if given:
            raise InputError(f"--{flag}: lean-nerf cannot train so; leave it out")


def convert_rays(bundle: Any) -> RayBundle:
    """nerfstudio's rays (n,) as ours. It says nothing of their pixels but the area: they are taken to be squares across
    the ray, upright in the world. Of 2 x 2 rays through a pixel the mean is hardly another, whatever its angle. Rays
    of no camera (area 1, in nerfstudio's exports) have no extent."""
    directions = bundle.directions
    norm = bundle.metadata.get("directions_norm", torch.ones_like(directions[:, :1]))
    up = directions.new_tensor([1e-4, 1e-4, 1.0]).expand_as(directions)  # not quite: a ray may go straight up
    right = torch.nn.functional.normalize(torch.linalg.cross(directions, up), dim=1)
    side = torch.where(bundle.pixel_area < 1, bundle.pixel_area, 0.0).sqrt() * norm
    axes = torch.stack((torch.linalg.cross(directions, right), right), dim=1) * side[:, :, None]
    metadata = {"directions_norm": norm, "pixel_axes": axes}
    if bundle.nears is not None and bundle.fars is not None:
        metadata |= {"nears": bundle.nears, "fars": bundle.fars}
    no_camera = torch.zeros_like(norm, dtype=torch.int64)  # the model does not ask which
    return RayBundle(bundle.origins, directions, no_camera, metadata)


def psnr(first: Tensor, second: Tensor) -> Tensor:
    """() in dB, of colors in [0, 1]."""
    return -10 * torch.log10((first - second).square().mean())


@dataclass
class LeanNerfModelConfig(ModelConfig):
    """lean-nerf. Where the data parser has an alpha_color, that is the background."""

    _target: type = field(default_factory=lambda: LeanNerfModel)
    lean: Annotated[LeanModelConfig, tyro.conf.arg(name="")] = field(default_factory=LeanModelConfig)
    """The settings of the standalone program."""
    enable_collider: bool = False
    """Depths come from the scene, see near and far."""
    eval_num_rays_per_chunk: int = 2**12
    """Rays that are rendered at once in evaluation."""


@dataclass(frozen=True)
class RowAdamConfig(OptimizerConfig):
    """The standalone program's optimizer, as nerfstudio asks for one; it has no schedule beside it."""

    max_norm: ClassVar[None] = None

    def setup(self, params: Any) -> RowAdam:
        """Adam over `torch_groups`, whose learning rates are multiples of this one."""
        groups = [group | {"lr": self.lr * group["lr"], "initial_lr": self.lr * group["lr"]} for group in params]
        return build_adam(groups, self)
