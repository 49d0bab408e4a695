"""nerfstudio's methods, set up as ns-train sets them up."""
# pyright: reportMissingImports=false
# nerfstudio's pins rule out the environment that is linted

from __future__ import annotations

import copy
import importlib
import random
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from edge_se_sampler.errors import InputError


def require_nerfstudio(what: str) -> None:
    """InputError, which names what needs it, if nerfstudio is not there as a whole."""
    if find_spec("nerfstudio") is None or find_spec("torchvision") is None:
        raise InputError(f"{what} needs all of nerfstudio 1.1.5 beside edge_se_sampler in one environment")


def skip_lpips_weights() -> None:
    """Build models without LPIPS, whose weights would be downloaded; only nerfstudio's own evaluation measures it."""
    metrics: Any = importlib.import_module("torchmetrics.image.lpip")
    metrics.LearnedPerceptualImagePatchSimilarity = torch.nn.Identity


def build_config(method: str, seed: int, data: Path, runs: Path, flags: Sequence[str] = ()) -> Any:
    """A method's config on a Blender folder or on one with a transforms.json, without evaluations on the way; flags: as
    ns-train takes them."""
    import tyro
    from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
    from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    config = copy.deepcopy(tyro.cli(AnnotatedBaseConfigUnion, args=[method, *flags]))
    config.output_dir, config.vis, config.machine.seed = runs, "tensorboard", seed
    config.machine.device_type = "cuda" if torch.cuda.is_available() else "cpu"
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 10**9
    manager = config.pipeline.datamanager
    is_capture = (data / "transforms.json").exists()
    manager.data, manager.dataparser = data, NerfstudioDataParserConfig() if is_capture else BlenderDataParserConfig()
    config.set_timestamp()
    return config


def build_trainer(config: Any, test_mode: str) -> Any:
    """nerfstudio's trainer, seeded as ns-train seeds it."""
    random.seed(config.machine.seed)
    torch.manual_seed(config.machine.seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup(test_mode=test_mode)
    return trainer


def render_test_views(trainer: Any, numbers: Sequence[int] | None = None) -> list[Any]:
    """The test views, or those of some numbers, as nerfstudio renders them now, (H, W, 3) each."""
    pipeline = trainer.pipeline
    pipeline.eval()
    cameras = pipeline.datamanager.eval_dataset.cameras.to(pipeline.device)
    chosen = range(len(cameras)) if numbers is None else numbers
    outputs = [pipeline.model.get_outputs_for_camera(cameras[i : i + 1]) for i in chosen]
    pipeline.train()
    return [output["rgb_fine" if "rgb_fine" in output else "rgb"].cpu().numpy() for output in outputs]
