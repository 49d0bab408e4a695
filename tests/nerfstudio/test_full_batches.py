"""The whole host: masks, mixed sizes, RGBA and other samplers' work, through its own loaders and a training step."""
# pyright: reportMissingImports=false

from __future__ import annotations

import copy
import inspect
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_origin

import imageio.v3 as iio
import numpy as np
import pytest
import torch

pytestmark = pytest.mark.nerfstudio_full
pytest.importorskip("nerfstudio.engine.trainer", reason="needs all of nerfstudio 1.1.5")

from full_host import RAYS, config_of, trainer_of, watch  # noqa: E402
from nerfstudio.configs.method_configs import all_methods  # noqa: E402
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig  # noqa: E402
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig  # noqa: E402
from nerfstudio.data.datasets.base_dataset import InputDataset  # noqa: E402
from nerfstudio.data.pixel_samplers import PairPixelSamplerConfig, PatchPixelSampler, PixelSampler  # noqa: E402

from edge_se_sampler.errors import InputError  # noqa: E402
from edge_se_sampler.nerfstudio.datamanager import EdgeSEDataManager, attach  # noqa: E402
from edge_se_sampler.nerfstudio.pixel_sampler import EdgeSEPixelSampler, EdgeSEPixelSamplerConfig  # noqa: E402

SIZES = [(32, 32), (20, 30), (31, 17), (32, 24), (9, 32), (25, 25)]


def nerfstudio_folder(folder: Path, source: Path, *, mixed: bool, masked: bool, channels: int) -> Path:
    """Six views in nerfstudio's own format; mixed: each cropped to another size; masked: to its left half."""
    transforms = json.loads((source / "transforms_train.json").read_text())
    frames = []
    for i, (height, width) in enumerate(SIZES):
        frame = transforms["frames"][i % len(transforms["frames"])]
        image = iio.imread(source / f"{frame['file_path']}.png")[..., :channels]
        focal = 0.5 * image.shape[1] / np.tan(0.5 * transforms["camera_angle_x"])
        height, width = (height, width) if mixed else image.shape[:2]
        iio.imwrite(folder / f"{i}.png", image[:height, :width])
        frames.append(
            {
                "file_path": f"{i}.png",
                "transform_matrix": frame["transform_matrix"],
                **{"w": width, "h": height, "fl_x": focal, "fl_y": focal, "cx": 16.0, "cy": 16.0},
            }
        )
        if masked:
            mask = np.zeros((height, width), dtype=np.uint8)
            mask[:, : width // 2] = 255
            iio.imwrite(folder / f"mask_{i}.png", mask)
            frames[-1]["mask_path"] = f"mask_{i}.png"
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}))
    return folder


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("rays", [RAYS, 6001])
def test_every_kind_of_images_trains(
    rays: int, channels: int, mixed: bool, masked: bool, host_scene: Path, tmp_path: Path
) -> None:
    config = config_of("edge-se-nerfacto", host_scene, tmp_path, rays=rays)
    data = nerfstudio_folder(tmp_path, host_scene, mixed=mixed, masked=masked, channels=channels)
    config.pipeline.datamanager.data = data
    config.pipeline.datamanager.dataparser = NerfstudioDataParserConfig(train_split_fraction=0.8)
    config.pipeline.model.background_color = "random"
    config.pipeline.datamanager.pixel_sampler.precrop_fraction = 0.9
    trainer = trainer_of(config)
    manager = trainer.pipeline.datamanager
    cached = manager.train_image_dataloader.cached_collated_batch
    assert isinstance(cached["image"], list) == mixed
    assert ("mask" in cached) == masked
    sizes = {int(number): image.shape for number, image in zip(cached["image_idx"], cached["image"], strict=True)}
    seen = watch(manager.train_pixel_sampler)
    for step in (0, 10):  # early, late
        manager.train_pixel_sampler.set_step(step)
        loss, _, _ = trainer.train_iteration(step)
        assert torch.isfinite(loss)
    assert [strategy for _, strategy, _ in seen] == ["edge", "se"]
    for _, _, indices in seen:
        assert len(indices) == rays
        for number, row, column in indices.tolist():
            height, width = sizes[number][:2]
            assert row < height
            assert column < (width // 2 if masked else width)


@pytest.mark.parametrize("background", ["white", "random"])
def test_rgba_of_a_blender_folder_trains(background: str, host_scene: Path, tmp_path: Path) -> None:
    config = config_of("edge-se-nerf", host_scene, tmp_path, alpha=None)
    config.pipeline.model.background_color = background
    trainer = trainer_of(config)
    for step in (0, 10):
        trainer.pipeline.datamanager.train_pixel_sampler.set_step(step)
        assert torch.isfinite(trainer.train_iteration(step)[0])


def test_only_some_images_in_memory_train_as_well(host_scene: Path, tmp_path: Path) -> None:
    """They are collated anew, in any order; each keeps the table of its absolute number."""
    config = config_of("edge-nerf", host_scene, tmp_path)
    config.pipeline.datamanager.train_num_images_to_sample_from = 2
    config.pipeline.datamanager.train_num_times_to_repeat_images = 0
    trainer = trainer_of(config)
    sampler = trainer.pipeline.datamanager.train_pixel_sampler
    seen = watch(sampler)
    for _ in range(12):
        trainer.train_iteration(0)
    assert {number for *_, indices in seen for number in indices[:, 0].tolist()} == {0, 1, 2, 3}
    assert all(len(indices[:, 0].unique()) <= 2 for *_, indices in seen)
    assert len(sampler.strategies["edge"].distribution._table) == 4


def test_all_pixels_masked_is_refused_before_training(host_scene: Path, tmp_path: Path) -> None:
    config = config_of("edge-se-nerfacto", host_scene, tmp_path)
    data = nerfstudio_folder(tmp_path, host_scene, mixed=False, masked=True, channels=3)
    for path in data.glob("mask_*.png"):
        iio.imwrite(path, np.zeros_like(iio.imread(path)))
    config.pipeline.datamanager.data = data
    config.pipeline.datamanager.dataparser = NerfstudioDataParserConfig(train_split_fraction=0.8)
    with pytest.raises(InputError, match="masked in all images"):
        trainer_of(config)


# -- stock configurations ---------------------------------------------------------------------------------------------


def test_a_stock_method_trains_on_important_pixels(host_scene: Path, tmp_path: Path) -> None:
    trainer = trainer_of(config_of("vanilla-nerf", host_scene, tmp_path))
    attach(trainer, early="edge", late="se", edge_filter="laplacian")
    sampler = trainer.pipeline.datamanager.train_pixel_sampler
    seen = watch(sampler)
    trainer.train()
    assert [(step, strategy) for step, strategy, _ in seen] == [(s, "edge" if s < 2 else "se") for s in range(20)]
    assert sampler.config.edge_filter == "laplacian"
    assert type(trainer.pipeline.datamanager.eval_pixel_sampler) is PixelSampler
    config = config_of("edge-se-nerf", host_scene, tmp_path / "ours")
    config.pipeline.datamanager.pixel_sampler.edge_filter = "laplacian"
    ours = trainer_of(config)
    drawn = watch(ours.pipeline.datamanager.train_pixel_sampler)
    ours.train()
    for (*_, attached), (*_, by_config) in zip(seen, drawn, strict=True):
        assert torch.equal(attached, by_config)


def test_a_methods_own_dataset_stays(host_scene: Path, tmp_path: Path) -> None:
    class Depths(InputDataset):
        """Stands for one that has more than images."""

    class Manager(EdgeSEDataManager[Depths]):
        pass

    for target, expected in (
        (EdgeSEDataManager, InputDataset),
        (EdgeSEDataManager[Depths], Depths),
        (Manager, Depths),
    ):
        config = config_of("edge-se-nerf", host_scene, tmp_path)
        config.pipeline.datamanager._target = target
        manager = trainer_of(config).pipeline.datamanager
        assert [type(dataset) for dataset in (manager.train_dataset, manager.eval_dataset)] == [expected] * 2
        assert isinstance(manager.train_pixel_sampler, EdgeSEPixelSampler)


def test_attaching_where_pixels_are_drawn_by_others_is_refused(host_scene: Path, tmp_path: Path) -> None:
    class Parallel:
        """Stands for ParallelDataManager, which would start processes."""

        train_pixel_sampler = None

    class Whole:
        """Stands for FullImageDatamanager, Gaussian splatting's."""

    trainer = trainer_of(config_of("vanilla-nerf", host_scene, tmp_path))
    manager = trainer.pipeline.datamanager
    manager.train_pixel_sampler = PairPixelSamplerConfig().setup(num_rays_per_batch=8)
    with pytest.raises(InputError, match="is a PairPixelSampler"):
        attach(trainer)
    with pytest.raises(InputError, match=r"Parallel does not draw its pixels in this process.*EdgeSEDataManagerConfig"):
        attach(SimpleNamespace(pipeline=SimpleNamespace(datamanager=Parallel())))
    with pytest.raises(InputError, match=r"Whole draws no pixels.* train on whole images have no use"):
        attach(SimpleNamespace(pipeline=SimpleNamespace(datamanager=Whole())))


def test_patches_are_refused(host_scene: Path, tmp_path: Path) -> None:
    config = config_of("edge-se-nerf", host_scene, tmp_path)
    config.pipeline.datamanager.patch_size = 4
    with pytest.raises(InputError, match="patch-size is 4"):
        trainer_of(config)
    stock = config_of("vanilla-nerf", host_scene, tmp_path, rays=32)
    stock.pipeline.datamanager.patch_size = 4
    trainer = trainer_of(stock)
    assert type(trainer.pipeline.datamanager.train_pixel_sampler) is PatchPixelSampler
    with pytest.raises(InputError, match="is a PatchPixelSampler"):
        attach(trainer)


# its __del__ ends processes that were never started
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_parallel_data_manager_is_refused(host_scene: Path, tmp_path: Path) -> None:
    config = copy.deepcopy(all_methods["nerfacto"])
    parallel = get_origin(config.pipeline.datamanager._target) or config.pipeline.datamanager._target
    assert parallel.__name__ == "ParallelDataManager"
    if "pixel_sampler" not in inspect.getsource(parallel.setup_train):
        pytest.skip("this ParallelDataManager, as in nerfstudio's main branch, asks no configured sampler at all")
    small = config_of("edge-se-nerfacto", host_scene, tmp_path)
    config.pipeline.datamanager.pixel_sampler = EdgeSEPixelSamplerConfig()
    config.pipeline.datamanager.data = host_scene
    config.pipeline.datamanager.dataparser = small.pipeline.datamanager.dataparser
    with pytest.raises(InputError, match=r"worker process.*EdgeSEDataManagerConfig"):
        config.pipeline.datamanager.setup(device="cpu")


def test_a_sampler_that_is_never_bound_warns_once(host_scene: Path, tmp_path: Path, capfd: Any) -> None:
    config = config_of("vanilla-nerf", host_scene, tmp_path)
    assert type(config.pipeline.datamanager) is VanillaDataManagerConfig
    config.pipeline.datamanager.pixel_sampler = EdgeSEPixelSamplerConfig()
    manager = config.pipeline.datamanager.setup(device="cpu")
    assert type(manager) is VanillaDataManager
    for step in range(3):
        manager.next_train(step)
    assert capfd.readouterr().err.count("is not bound to a training run and draws uniformly") == 1
