"""The whole host: lean-nerf as its model learns what it does standalone, and lives on in checkpoints."""
# pyright: reportMissingImports=false

from __future__ import annotations

import copy
import json
from functools import cache
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

pytestmark = pytest.mark.nerfstudio_full
pytest.importorskip("nerfstudio.engine.trainer", reason="needs all of nerfstudio 1.1.5")

from full_host import config_of, train, trainer_of, watch  # noqa: E402
from nerfstudio.cameras.rays import RayBundle as HostRays  # noqa: E402
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig  # noqa: E402
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig  # noqa: E402
from nerfstudio.utils.eval_utils import eval_setup  # noqa: E402
from test_full_batches import nerfstudio_folder  # noqa: E402

from edge_se_sampler.bench.nerfstudio.host import render_test_views  # noqa: E402
from edge_se_sampler.data.synthetic.folder import make_scenes  # noqa: E402
from edge_se_sampler.engine.config import MANAGER, override  # noqa: E402
from edge_se_sampler.engine.evaluation import evaluate  # noqa: E402
from edge_se_sampler.engine.rendering import to_pictures  # noqa: E402
from edge_se_sampler.engine.session import prepare, read_test_views  # noqa: E402
from edge_se_sampler.errors import InputError  # noqa: E402
from edge_se_sampler.methods import method_configs  # noqa: E402
from edge_se_sampler.nerfstudio.lean_model import convert_rays  # noqa: E402

STEPS, RAYS = 300, 256


@pytest.fixture(scope="module")
def scene(host_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Enough views and pixels to know where the object is not."""
    folder = tmp_path_factory.mktemp("lean")
    return make_scenes(folder, ["mic"], size=48, num_train=12, num_val=1, num_test=3)[0]


@cache
def parsed_config() -> Any:
    """Without a scene: parsing takes seconds."""
    return config_of("lean-nerf", Path(), Path(), rays=RAYS, max_num_iterations=STEPS)


def lean_config(scene: Path, runs: Path, alpha: str | None = "white", **changes: Any) -> Any:
    config = copy.deepcopy(parsed_config())
    config.output_dir, config.pipeline.datamanager.data = runs, scene
    config.pipeline.datamanager.dataparser.alpha_color = alpha
    vars(config).update(changes)
    return config


@pytest.fixture(scope="module")
def trained(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """nerfstudio's trainer after all of a training, its config saved as ns-train does."""
    config = lean_config(scene, tmp_path_factory.mktemp("runs"))
    config.save_config()
    trainer = trainer_of(config, "test")
    trainer.train()
    return trainer


def psnr_of(pipeline: Any) -> float:
    return pipeline.get_average_eval_image_metrics()["psnr"]


def test_it_learns_what_the_standalone_program_learns(trained: Any, scene: Path, tmp_path: Path) -> None:
    changes = {"data": scene, "output_dir": tmp_path, "max_num_iterations": STEPS, "machine.device_type": "cpu"}
    config = override(method_configs()["lean-nerf"], changes | {f"{MANAGER}.train_num_rays_per_batch": RAYS})
    standalone = prepare(config)
    standalone.train()
    expected = evaluate(standalone.pipeline.model, to_pictures(read_test_views(standalone.config)))["psnr"]
    assert expected > 28
    assert psnr_of(trained.pipeline) > expected - 0.3
    model = trained.pipeline.model.field
    assert int(model.grid.level) == int(model.grid.max_level) == 2
    assert bool(model.supersampled)


def test_it_trains_on_alpha_and_on_pixels_that_see_a_cell(trained: Any) -> None:
    manager = trained.pipeline.datamanager
    batch = manager.train_image_dataloader.cached_collated_batch
    assert batch["image"].shape[-1] == 4  # though the data parser composites on white
    foreground, mask = batch["image"][..., 3] > 0, batch["mask"][..., 0]
    assert mask[foreground].float().mean() > 0.99
    assert 0.05 < mask.float().mean() < 0.9
    assert manager.train_pixel_sampler.config.early == "expansive"
    assert trained.pipeline.datamanager.eval_dataset[0]["image"].shape[-1] == 3


def test_a_ray_is_rendered_alike_however_many_there_are(trained: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hosts give as many as they like: of thousands at once, plain torch would take gigabytes."""
    pipeline = trained.pipeline
    pipeline.eval()
    rays = pipeline.datamanager.eval_dataset.cameras[:1].generate_rays(0).flatten()
    whole, sizes = pipeline.model.get_outputs(rays), []
    field = type(pipeline.model.field)
    render = field.render
    monkeypatch.setattr(field, "rays_per_chunk", property(lambda _: 500))
    monkeypatch.setattr(field, "render", lambda self, some: (sizes.append(len(some)), render(self, some))[1])
    parts = pipeline.model.get_outputs(rays)
    assert max(sizes) == 500
    for name in ("rgb", "accumulation", "depth"):
        torch.testing.assert_close(parts[name], whole[name], rtol=0, atol=1e-5)


def test_images_that_are_not_kept_are_trained_on_where_pixels_see_a_cell_too(
    trained: Any, scene: Path, tmp_path: Path
) -> None:
    config = lean_config(scene, tmp_path)
    config.pipeline.datamanager.train_num_images_to_sample_from = 3
    config.pipeline.datamanager.train_num_times_to_repeat_images = 2
    trainer = trainer_of(config)
    seen = watch(trainer.pipeline.datamanager.train_pixel_sampler)
    train(trainer, 8)
    pixels = torch.cat([indices for *_, indices in seen])
    batch = trained.pipeline.datamanager.train_image_dataloader.cached_collated_batch
    masks = batch["mask"][torch.argsort(batch["image_idx"])]
    assert len(pixels[:, 0].unique()) > 3
    assert masks[tuple(pixels.T)].all()


def test_its_loss_takes_the_samplers_weights(scene: Path, tmp_path: Path) -> None:
    trainer = trainer_of(lean_config(scene, tmp_path))
    train(trainer, 2)
    rays, batch = trainer.pipeline.datamanager.next_train(2)
    assert len(batch["weight"].unique()) > 1
    model = trainer.pipeline.model
    outputs = model(rays)

    def loss(weight: torch.Tensor) -> float:
        return float(model.get_loss_dict(outputs, batch | {"weight": weight})["loss"])

    first = torch.zeros(len(batch["weight"]))
    first[:10] = 1
    assert 0 < loss(first) < loss(torch.ones_like(first))
    assert loss(first) + loss(1 - first) == pytest.approx(loss(torch.ones_like(first)), rel=1e-4)


@pytest.mark.parametrize("test_mode", ["test", "inference"])
def test_a_checkpoint_renders_what_was_trained(test_mode: Any, trained: Any) -> None:
    """In "inference", as ns-render asks for it, nothing is derived from images."""
    _, pipeline, _, step = eval_setup(trained.base_dir / "config.yml", test_mode=test_mode)
    assert step == STEPS - 1
    assert pipeline.model.field.config.depths == trained.pipeline.model.field.config.depths
    cameras = trained.pipeline.datamanager.eval_dataset.cameras
    expected = render_test_views(trained)
    for i, picture in enumerate(expected):
        found = pipeline.model.get_outputs_for_camera(cameras[i : i + 1])
        np.testing.assert_allclose(found["rgb"].numpy(), picture, atol=1e-5)
        assert set(found) == {"rgb", "accumulation", "depth"}
    if test_mode == "test":
        assert psnr_of(pipeline) == pytest.approx(psnr_of(trained.pipeline), abs=1e-3)


@pytest.mark.parametrize("name", ["density", "features"])
def test_weights_of_other_cells_are_refused(name: str, trained: Any) -> None:
    _, pipeline, *_ = eval_setup(trained.base_dir / "config.yml", test_mode="inference")
    weights = dict(pipeline.model.state_dict())
    pipeline.model.load_state_dict(weights)
    with pytest.raises(InputError, match="not this model's"):
        pipeline.model.load_state_dict(weights | {f"field.{name}": weights[f"field.{name}"][:10, :3]})


def test_renders_and_exports_leave_the_background_out(trained: Any, scene: Path, tmp_path: Path) -> None:
    """nerfstudio's own commands: a view's transparency, and points on the object alone."""
    for needed in ("open3d", "pymeshlab", "xatlas"):
        pytest.importorskip(needed, reason="ns-export needs it", exc_type=ImportError)
    import open3d
    from nerfstudio.scripts.exporter import ExportPointCloud
    from nerfstudio.scripts.render import DatasetRender

    config = trained.base_dir / "config.yml"
    DatasetRender(config, output_path=tmp_path, rendered_output_names=["rgba"], image_format="png").main()
    pictures = sorted(tmp_path.rglob("*.png"))
    assert len(pictures) == 3
    for picture, truth in zip(pictures, sorted((scene / "test").glob("*.png")), strict=True):
        found, expected = iio.imread(picture)[..., 3] / 255, iio.imread(truth)[..., 3] / 255
        assert np.abs(found - expected).mean() < 0.02
    bars = {"num_points": 2000, "num_rays_per_batch": 2000, "remove_outliers": False, "normal_method": "open3d"}
    ExportPointCloud(load_config=config, output_dir=tmp_path, **bars).main()
    points = torch.from_numpy(np.asarray(open3d.io.read_point_cloud(str(tmp_path / "point_cloud.ply")).points))
    assert len(points) >= 2000
    grid = trained.pipeline.model.field.grid
    assert grid.contains(points).float().mean() > 0.9


def test_a_resumed_run_goes_on_as_the_first_was_planned(trained: Any, scene: Path, tmp_path: Path) -> None:
    config = lean_config(scene, tmp_path)
    first = trainer_of(copy.deepcopy(config), "test")
    train(first, 100)  # in cells that have been subdivided once
    config.load_dir, config.timestamp = first.checkpoint_dir, "resumed"
    config.max_num_iterations = STEPS - 100
    resumed = trainer_of(config, "test")
    optimizer, model = resumed.optimizers.optimizers["fields"], resumed.pipeline.model.field
    assert int(model.grid.level) == 1
    for name, value in first.pipeline.state_dict().items():
        assert torch.equal(resumed.pipeline.state_dict()[name], value), name
    assert optimizer.state[model.features]["exp_avg"].shape == model.features.shape
    assert optimizer.state[model.features]["exp_avg"].abs().max() > 0
    resumed.train()
    assert int(model.grid.level) == 2
    rates = [group["lr"] / group["initial_lr"] for group in optimizer.param_groups]
    assert rates == pytest.approx([0.1 ** ((STEPS - 1) / STEPS)] * 3)
    assert psnr_of(resumed.pipeline) == pytest.approx(psnr_of(trained.pipeline), abs=0.5)


def test_its_background_is_the_data_parsers(scene: Path, tmp_path: Path) -> None:
    trainer = trainer_of(lean_config(scene, tmp_path, alpha="black"))
    train(trainer, 60)
    camera = trainer.pipeline.datamanager.eval_dataset.cameras[:1]
    trainer.pipeline.eval()
    outputs = trainer.pipeline.model.get_outputs_for_camera(camera)
    assert outputs["rgb"][0, 0].tolist() == [0, 0, 0]
    rgba = trainer.pipeline.model.get_rgba_image(outputs)
    opaque = outputs["accumulation"][..., 0] > 0.9
    assert opaque.any()
    torch.testing.assert_close(rgba[..., :3] * rgba[..., 3:], outputs["rgb"], atol=1e-5, rtol=0)
    assert rgba[0, 0, 3] == 0


def test_without_alpha_it_learns_where_the_object_is(scene: Path, tmp_path: Path) -> None:
    """Within the data parser's scene box, for all cameras are outside of it."""
    folder = tmp_path / "rgb"
    for path in scene.rglob("*.*"):
        copied = folder / path.relative_to(scene)
        copied.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".png":
            image = iio.imread(path).astype(np.float64) / 255
            iio.imwrite(copied, (255 * (image[..., :3] * image[..., 3:] + 1 - image[..., 3:])).astype(np.uint8))
        else:
            copied.write_bytes(path.read_bytes())
    trainer = trainer_of(lean_config(folder, tmp_path, max_num_iterations=200), "test")
    model, sampler = trainer.pipeline.model, trainer.pipeline.datamanager.train_pixel_sampler
    near, far = model.field.config.depths
    assert 2 < near < 2.5 < 5.5 < far < 6.5  # the box reaches 1.5 from the origin, the cameras are 4 from it
    assert sampler.strategy == "expansive"
    assert "mask" not in trainer.pipeline.datamanager.train_image_dataloader.cached_collated_batch
    trainer.train()
    assert psnr_of(trainer.pipeline) > 26


@pytest.mark.parametrize("mixed", [False, True])
def test_masks_of_the_data_hold(mixed: bool, host_scene: Path, tmp_path: Path) -> None:
    config = lean_config(nerfstudio_folder(tmp_path, host_scene, mixed=mixed, masked=True, channels=4), tmp_path)
    config.pipeline.datamanager.dataparser = NerfstudioDataParserConfig(train_split_fraction=0.8)
    trainer = trainer_of(config)
    manager = trainer.pipeline.datamanager
    batch = manager.train_image_dataloader.cached_collated_batch
    assert isinstance(batch["mask"], list) == mixed
    for image, mask in zip(batch["image"], batch["mask"], strict=True):
        assert mask.any()
        assert not mask[:, image.shape[1] // 2 :].any()
    seen = watch(manager.train_pixel_sampler)
    train(trainer, 2)
    drawn = torch.cat([indices for *_, indices in seen])
    masks = dict(zip(batch["image_idx"].tolist(), batch["mask"], strict=True))
    assert all(masks[number][row, column] for number, row, column in drawn.tolist())


def test_what_is_masked_is_not_painted(host_scene: Path, tmp_path: Path) -> None:
    """As nerfstudio's own images are, with numbers in [0, 1] among bytes."""
    config = lean_config(nerfstudio_folder(tmp_path, host_scene, mixed=False, masked=True, channels=3), tmp_path)
    parser = NerfstudioDataParserConfig(train_split_fraction=0.8, mask_color=(1.0, 1.0, 1.0))
    config.pipeline.datamanager.dataparser = parser
    train(trainer_of(config), 2)


def test_a_pixels_rays_are_spread_as_far_as_its_quarters(scene: Path, tmp_path: Path) -> None:
    """If maybe at another angle; so their mean is the same but for third derivatives. What is no camera's has no
    extent."""
    trainer = trainer_of(lean_config(scene, tmp_path))
    manager = trainer.pipeline.datamanager
    cameras = manager.train_dataset.read_views().cameras
    pixels = torch.cartesian_prod(torch.arange(len(cameras)), torch.arange(0, 48, 5), torch.arange(0, 48, 5))
    bundle = manager.train_ray_generator(pixels)

    def spread(rays: Any) -> torch.Tensor:
        quarters, _ = rays.split_pixels()
        off = float(cameras.fx[0]) * (quarters.double() - rays.directions.double()[:, None])
        assert off.mean(dim=1).norm(dim=1).max() < 0.01
        return (off[..., None] * off[..., None, :]).mean(dim=1)

    found, expected = spread(convert_rays(bundle)), spread(cameras.pixel_rays(pixels))
    size = expected.diagonal(dim1=1, dim2=2).sum(dim=1)
    assert size.max() == pytest.approx(2 / 16, rel=0.02)  # a quarter of a pixel each way
    assert ((found - expected).norm(dim=(1, 2)) / size).max() < 0.1
    bundle.pixel_area = torch.ones_like(bundle.pixel_area)
    alone, _ = convert_rays(bundle).split_pixels()
    torch.testing.assert_close(alone, bundle.directions[:, None].expand(-1, 4, 3))


def test_rays_may_be_bounded(trained: Any) -> None:
    """As the viewer's crop and texture exports do."""
    model = trained.pipeline.model.eval()
    camera = trained.pipeline.datamanager.eval_dataset.cameras[:1]
    rays = camera.generate_rays(0, keep_shape=True)
    whole = model.get_outputs_for_camera_ray_bundle(rays)
    row, column = divmod(int(whole["accumulation"][..., 0].argmax()), 48)
    distance = float(whole["depth"][row, column])
    along = rays.directions[row, column] * (distance - 0.3)

    def opacity(near: float, far: float) -> float:
        one = [torch.full((1, 1), value) for value in (near, far, 1.0)]
        origin, direction = rays.origins[row, column] + along, rays.directions[row, column]
        bundle = HostRays(origin[None], direction[None], one[2], nears=one[0], fars=one[1])
        return float(model(bundle)["accumulation"])

    assert opacity(0.0, 1.0) > 0.9  # nearer than the scene's near depth
    assert opacity(0.0, 0.01) < 0.1
    model.train()


def test_what_it_cannot_do_is_refused(scene: Path, tmp_path: Path) -> None:
    fresh = lean_config(scene, tmp_path)

    def refused(message: str, **changes: Any) -> None:
        config = copy.deepcopy(fresh)
        for path, value in changes.items():
            *owners, name = path.split("__")
            owner = config
            for part in owners:
                owner = getattr(owner, part)
            setattr(owner, name, value)
        with pytest.raises(InputError, match=message):
            trainer_of(config)

    model = fresh.pipeline.model.lean
    refused("--mixed-precision", mixed_precision=True)
    refused("--use-grad-scaler", use_grad_scaler=True)
    refused("--gradient-accumulation-steps", gradient_accumulation_steps={"fields": 2})
    refused("pipeline.model.size", pipeline__model__lean=override(model, {"size": "tiny"}))
    refused("background-color", pipeline__model__lean=override(model, {"background_color": "random"}))
    refused("near is 7", pipeline__model__lean=override(model, {"near": 7.0, "far": 6.0}))
    stock = VanillaDataManagerConfig(dataparser=fresh.pipeline.datamanager.dataparser)
    stock.data = scene
    refused("data manager", pipeline__datamanager=stock)


def test_checkpoints_need_no_permission_to_run_code(trained: Any) -> None:
    (path,) = trained.checkpoint_dir.glob("*.ckpt")
    assert torch.load(path, weights_only=True)["step"] == STEPS - 1
    assert json.loads((trained.base_dir / "edge-se-plan.json").read_text()) == {"planned_steps": STEPS}
