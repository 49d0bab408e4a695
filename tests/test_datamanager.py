"""The data manager: images in nerfstudio's format, and the rays and pixels of a training step."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from tiny import tiny_model, tiny_views

from edge_se_sampler.data.config import VanillaDataManagerConfig
from edge_se_sampler.data.datamanager import VanillaDataManager, image_batch
from edge_se_sampler.errors import InputError
from edge_se_sampler.protocol import PixelSampler, PixelSamplerConfig
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig

VIEWS = tiny_views(3, 8, 6)


def manager_of(views: Any = VIEWS, rays: int = 50, **settings: Any) -> VanillaDataManager:
    sampler = EdgeSEPixelSamplerConfig(**settings)
    config = VanillaDataManagerConfig(train_num_rays_per_batch=rays, pixel_sampler=sampler)
    return config.setup(views=views)


def bind_at_step(manager: VanillaDataManager, step: int) -> None:
    """Bind the sampler to a run of 100 steps that is at this step."""
    manager.train_pixel_sampler.bind(
        squared_error=lambda batch: torch.arange(len(batch["indices"])).float(),
        progress=lambda step: step / 100,
        seed=0,
    )
    manager.train_pixel_sampler.set_step(step)


# --- image_batch ---


def test_views_of_one_size_are_stacked() -> None:
    batch = image_batch(VIEWS)
    assert set(batch) == {"image", "image_idx"}
    assert batch["image"].shape == (3, 8, 6, 4)
    assert batch["image"].dtype == torch.uint8
    assert batch["image_idx"].tolist() == [0, 1, 2]
    np.testing.assert_array_equal(batch["image"], np.stack(VIEWS.images))


def test_views_of_different_sizes_are_a_list() -> None:
    masks = (np.ones((8, 6), bool), np.zeros((4, 5), bool))
    views = replace(VIEWS, images=(VIEWS.images[0], VIEWS.images[1][:4, :5]), masks=masks)
    batch = image_batch(views)
    assert [image.shape for image in batch["image"]] == [(8, 6, 4), (4, 5, 4)]
    assert [tuple(mask.shape) for mask in batch["mask"]] == [(8, 6, 1), (4, 5, 1)]
    assert batch["image_idx"].tolist() == [0, 1]


def test_masks_are_stacked_like_their_images() -> None:
    masks = tuple(np.random.default_rng(i).random((8, 6)) < 0.5 for i in range(3))
    batch = image_batch(replace(VIEWS, masks=masks))
    assert batch["mask"].dtype == torch.bool
    np.testing.assert_array_equal(batch["mask"][..., 0], np.stack(masks))


def test_an_rgb_image_among_rgba_ones_gets_opaque_alpha() -> None:
    rgb = VIEWS.images[1][..., :3]
    batch = image_batch(replace(VIEWS, images=(VIEWS.images[0], rgb, VIEWS.images[2])))
    np.testing.assert_array_equal(batch["image"][1, ..., :3], rgb)
    assert bool((batch["image"][1, ..., 3] == 255).all())
    np.testing.assert_array_equal(batch["image"][0], VIEWS.images[0])
    assert image_batch(tiny_views(2, channels=3))["image"].shape[3] == 3  # none has alpha, so none is added


def test_no_views_are_refused() -> None:
    with pytest.raises(InputError, match="no training views"):
        image_batch(replace(VIEWS, images=()))


# --- next_train ---


@pytest.mark.parametrize("step", [0, 50])
@pytest.mark.parametrize("images_per_step", ["one", "all"])
def test_rays_and_pixels_of_a_step_belong_together(step: int, images_per_step: Any) -> None:
    """In the early (edge) and the late (squared error) phase."""
    manager = manager_of(images_per_step=images_per_step)
    bind_at_step(manager, step)
    rays, batch = manager.next_train(step)
    assert len(rays) == len(batch["indices"]) == len(batch["image"]) == 50
    for i, (view, row, column) in enumerate(batch["indices"].tolist()):
        np.testing.assert_allclose(batch["image"][i], VIEWS.images[view][row, column] / 255, rtol=1e-6)
        expected = VIEWS.cameras.to(dtype=torch.float32).image_rays(view)
        torch.testing.assert_close(rays.directions[i], expected.directions[row * 6 + column])
        assert rays.camera_indices[i].tolist() == [view]
    assert len(set(batch["indices"][:, 0].tolist())) == (1 if images_per_step == "one" else 3)


def test_masked_pixels_are_not_trained_on() -> None:
    masks = tuple(np.eye(8, 6, dtype=bool) for _ in range(3))
    manager = manager_of(replace(VIEWS, masks=masks))
    for step in (0, 50):
        bind_at_step(manager, step)
        _, batch = manager.next_train(step)
        assert bool((batch["indices"][:, 1] == batch["indices"][:, 2]).all())


def test_configs_are_not_changed() -> None:
    sampler = EdgeSEPixelSamplerConfig()
    config = VanillaDataManagerConfig(train_num_rays_per_batch=50, pixel_sampler=sampler)
    before = copy.deepcopy(config)
    manager = config.setup(views=VIEWS)
    manager.next_train(0)
    assert config == before
    assert manager.train_pixel_sampler.num_rays_per_batch == 50


@dataclass
class CornerConfig(PixelSamplerConfig):
    """The config of a third-party sampler that writes into its config, as nerfstudio's do."""

    _target: ClassVar[Any] = field(default=None)


class CornerSampler(PixelSampler):
    def __init__(self, config: CornerConfig, **kwargs: Any) -> None:
        super().__init__(config, **kwargs)
        self.config.num_rays_per_batch = 999

    def sample(self, image_batch: dict[str, Any]) -> dict[str, Any]:
        indices = torch.zeros((self.num_rays_per_batch, 3), dtype=torch.int64)
        return {"indices": indices, "image": image_batch["image"][0, :1, 0].expand(len(indices), 4)}


CornerConfig._target = CornerSampler


def test_any_pixel_sampler_with_nerfstudios_contract_is_accepted() -> None:
    sampler = CornerConfig(num_rays_per_batch=3)
    manager = VanillaDataManagerConfig(train_num_rays_per_batch=5, pixel_sampler=sampler).setup(views=VIEWS)
    rays, batch = manager.next_train(0)
    assert len(rays) == 5
    torch.testing.assert_close(batch["image"][4], torch.from_numpy(VIEWS.images[0][0, 0] / np.float32(255)))
    assert sampler.num_rays_per_batch == 3


def test_ray_errors_are_the_models_squared_errors() -> None:
    """By the fine colours, against pixels composited on the background."""
    manager, model = manager_of(rays=21), tiny_model().float().eval()
    bind_at_step(manager, 0)
    rays, batch = manager.next_train(0)
    with torch.no_grad():
        errors, rendered = manager.ray_errors(model, rays, batch), model(rays)["rgb_fine"]
    color, alpha = batch["image"][:, :3], batch["image"][:, 3:]
    expected = ((rendered - (color * alpha + 1 - alpha)) ** 2).sum(dim=1)
    torch.testing.assert_close(errors, expected, rtol=1e-4, atol=1e-6)


def test_everything_that_the_loss_needs_is_on_the_device() -> None:
    """torch's "meta" device stands in for a GPU."""
    sampler = EdgeSEPixelSamplerConfig(importance_weight=1.0)
    config = VanillaDataManagerConfig(train_num_rays_per_batch=50, pixel_sampler=sampler)
    manager = config.setup(views=VIEWS, device="meta")
    bind_at_step(manager, 0)
    rays, batch = manager.next_train(0)
    assert rays.directions.device.type == batch["image"].device.type == "meta"
    assert batch["weight"].device.type == "meta"
