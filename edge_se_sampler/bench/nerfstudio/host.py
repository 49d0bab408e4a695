"""nerfstudio's methods, set up as ns-train sets them up."""
# pyright: reportMissingImports=false
# nerfstudio's pins rule out the environment that is linted

from __future__ import annotations

import copy
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch


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


def render_test_views(trainer: Any) -> list[Any]:
    """The test views as nerfstudio renders them now, (H, W, 3) each."""
    pipeline = trainer.pipeline
    pipeline.eval()
    cameras = pipeline.datamanager.eval_dataset.cameras.to(pipeline.device)
    outputs = [pipeline.model.get_outputs_for_camera(cameras[i : i + 1]) for i in range(len(cameras))]
    pipeline.train()
    return [output["rgb_fine" if "rgb_fine" in output else "rgb"].cpu().numpy() for output in outputs]
