"""nerfstudio 1.1.5 itself: our sampling on its base classes, its samplers in our data manager.

Runs in the light environment that .ci/nerfstudio-light makes, which has its pixel samplers and callbacks and none of
its models. Where its own sampler cannot do what ours is tested for, the test shows that too.
"""
# pyright: reportMissingImports=false
# nerfstudio's pins rule out the environment that is linted

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import torch
import tyro
from tiny import tiny_config, tiny_views

pytestmark = pytest.mark.nerfstudio
# the package alone would not do: with none installed, this very folder passes for one
pytest.importorskip("nerfstudio.data.pixel_samplers", reason="needs nerfstudio 1.1.5")

import nerfstudio  # noqa: E402
from nerfstudio.data.pixel_samplers import (  # noqa: E402
    PairPixelSamplerConfig,
    PatchPixelSamplerConfig,
    PixelSampler,
    PixelSamplerConfig,
)
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation  # noqa: E402

from edge_se_sampler.data.blender import read_blender  # noqa: E402
from edge_se_sampler.data.config import VanillaDataManagerConfig  # noqa: E402
from edge_se_sampler.data.views import Views  # noqa: E402
from edge_se_sampler.engine.config import (  # noqa: E402
    MANAGER,
    SAMPLER,
    OptimizerConfig,
    PipelineConfig,
    TrainerConfig,
    override,
)
from edge_se_sampler.engine.pipeline import Pipeline  # noqa: E402
from edge_se_sampler.engine.run_folder import RunFolder  # noqa: E402
from edge_se_sampler.engine.session import prepare, prepare_resume, resolve_config  # noqa: E402
from edge_se_sampler.engine.trainer import Trainer  # noqa: E402
from edge_se_sampler.errors import InputError  # noqa: E402
from edge_se_sampler.methods import STRATEGIES, method_configs  # noqa: E402
from edge_se_sampler.nerfstudio.pixel_sampler import EdgeSEPixelSampler, EdgeSEPixelSamplerConfig  # noqa: E402
from edge_se_sampler.sampling import settings as settings_module  # noqa: E402
from edge_se_sampler.sampling.expansive import Expansive  # noqa: E402
from edge_se_sampler.sampling.pixel_sampler import ImportantPixels  # noqa: E402
from edge_se_sampler.sampling.registry import PIXEL_STRATEGIES, PixelStrategy  # noqa: E402

NUMBERS = (40, 7, 23)
"""Absolute image numbers, neither in order nor from 0."""
SIZE = (12, 10)
RAYS = 50


def images(sizes: tuple[tuple[int, int], ...] = (SIZE,) * 3, channels: int = 3) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    return [torch.rand((*size, channels), generator=generator) for size in sizes]


def left_third(size: tuple[int, int]) -> torch.Tensor:
    mask = torch.zeros((*size, 1), dtype=torch.bool)
    mask[:, : size[1] // 3] = True
    return mask


def batch_of(pictures: list[torch.Tensor], *, stacked: bool, mask: bool = False, **others: Any) -> dict[str, Any]:
    """A batch as nerfstudio's loaders make it: stacked, or lists where sizes differ."""
    batch = {"image": pictures, **others}
    if mask:
        batch["mask"] = [left_third((picture.shape[0], picture.shape[1])) for picture in pictures]
    if stacked:
        batch = {key: torch.stack(value) for key, value in batch.items()}
    return batch | {"image_idx": torch.tensor(NUMBERS[: len(pictures)])}


MIXED = ((12, 10), (8, 14), (5, 6))
BATCHES: dict[str, Callable[[], dict[str, Any]]] = {
    "stacked": lambda: batch_of(images(), stacked=True),
    "stacked, masked": lambda: batch_of(images(), stacked=True, mask=True),
    "mixed sizes": lambda: batch_of(images(MIXED), stacked=False),
    "mixed sizes, masked": lambda: batch_of(images(MIXED), stacked=False, mask=True),
    "RGBA": lambda: batch_of(images(channels=4), stacked=True),
    "uint8": lambda: batch_of([(255 * image).to(torch.uint8) for image in images()], stacked=True),
}
STRATEGY_SETTINGS: dict[str, dict[str, Any]] = {
    "uniform": {"early": "uniform", "late": "uniform"},
    "precrop": {"early": "precrop", "late": "uniform", "precrop_fraction": 0.9},  # 0.5 misses the masks altogether
    "edge": {"early": "edge", "late": "uniform"},
    "se": {"early": "uniform", "late": "se", "early_fraction": 0.0},
}


def scores(candidates: dict[str, Any]) -> torch.Tensor:
    """A stand-in for the model: any function of what is drawn."""
    return candidates["image"].double().sum(dim=1) + candidates["indices"][:, 2]


def bound(config: Any, rays: int = RAYS, step: int = 3, **kwargs: Any) -> Any:
    """A sampler as the data manager makes it, following a run of 100 steps."""
    sampler = config.setup(num_rays_per_batch=rays, **kwargs)
    sampler.bind(squared_error=scores, progress=lambda step: step / 100, seed=5)
    sampler.set_step(step)
    return sampler


def of_host(strategy: str, rays: int = RAYS, step: int = 3, **settings: Any) -> Any:
    """Our sampler on nerfstudio's base, set up with everything nerfstudio's data manager passes."""
    config = EdgeSEPixelSamplerConfig(**STRATEGY_SETTINGS[strategy], **settings)
    return bound(config, rays, step, is_equirectangular=torch.tensor(False), fisheye_crop_radius=None)


def check_pixels(batch: dict[str, Any], pixels: dict[str, Any], rays: int = RAYS) -> None:
    """Exactly `rays` rows, absolute image numbers, and every per-pixel key as it is at those pixels."""
    indices = pixels["indices"]
    assert (indices.shape, indices.dtype) == ((rays, 3), torch.int64)
    numbers = batch["image_idx"].tolist()
    assert set(indices[:, 0].tolist()) <= set(numbers)
    for key in set(batch) - {"image_idx"}:
        expected = [batch[key][numbers.index(number)][row, column] for number, row, column in indices.tolist()]
        assert torch.equal(pixels[key], torch.stack(expected)), key
    if "mask" in batch:
        assert pixels["mask"].all()


def test_the_host_is_nerfstudio_itself_and_not_our_own_protocol() -> None:
    assert nerfstudio.__file__ is not None
    assert "site-packages" in Path(nerfstudio.__file__).parts
    assert version("nerfstudio") == "1.1.5"
    assert issubclass(EdgeSEPixelSampler, PixelSampler)
    assert issubclass(EdgeSEPixelSamplerConfig, PixelSamplerConfig)
    assert "site-packages" in Path(sys.modules[PixelSampler.__module__].__file__ or "").parts


# -- our sampling on their base ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("images_per_step", ["one", "all"])
@pytest.mark.parametrize("strategy", STRATEGY_SETTINGS)
@pytest.mark.parametrize("kind", BATCHES)
def test_the_same_pixels_are_drawn_as_on_our_own_base(kind: str, strategy: str, images_per_step: Any) -> None:
    batch = BATCHES[kind]()
    settings = STRATEGY_SETTINGS[strategy] | {"images_per_step": images_per_step}
    ours = bound(settings_module.EdgeSEPixelSamplerConfig(**settings))
    hosted = of_host(strategy, images_per_step=images_per_step)
    assert type(ours).__mro__[1] is type(hosted).__mro__[1] is ImportantPixels
    assert not isinstance(ours, PixelSampler)
    drawn = []
    for step in (3, 4):
        ours.set_step(step)
        hosted.set_step(step)
        assert hosted.strategy == ours.strategy == strategy
        expected, pixels = ours.sample(batch), hosted.sample(batch)
        assert expected.keys() == pixels.keys()
        assert all(torch.equal(expected[key], pixels[key]) for key in expected)
        check_pixels(batch, pixels)
        drawn.append(pixels["indices"])
    assert not torch.equal(*drawn)


@pytest.mark.parametrize("name", ["error-map", "error-cdf", "soft-mining", "actray", "regions", "quadtree"])
@pytest.mark.parametrize("kind", BATCHES)
def test_strategies_that_learn_from_errors_draw_the_same_pixels_as_on_our_own_base(kind: str, name: str) -> None:
    batch, settings = BATCHES[kind](), {"early": name, "late": name, "images_per_step": "all"}
    unweighted: dict[str, Any] = {"soft_mining_alpha": 0.0} if name == "soft-mining" else {}
    ours = bound(settings_module.EdgeSEPixelSamplerConfig(**settings, **unweighted))
    hosted = bound(EdgeSEPixelSamplerConfig(**settings))
    for step in range(3, 9):
        ours.set_step(step)
        hosted.set_step(step)
        expected, pixels = ours.sample(batch), hosted.sample(batch)
        assert expected.keys() == pixels.keys()
        assert all(torch.equal(expected[key], pixels[key]) for key in expected)
        check_pixels(batch, pixels)
        for sampler in (ours, hosted):
            assert sampler.needs_errors
            sampler.observe(scores(pixels))


def test_the_hosts_losses_take_no_weights_of_soft_mining() -> None:
    with pytest.raises(InputError, match=r"soft-mining-alpha is 0.6: nerfstudio's losses take no weights"):
        EdgeSEPixelSamplerConfig(late="soft-mining", soft_mining_alpha=0.6).check()


@pytest.mark.parametrize("phase", ["early", "late"])
def test_expansive_supervision_is_refused_where_losses_take_no_weights(phase: str) -> None:
    with pytest.raises(InputError, match=rf"{phase} is 'expansive': weights the loss, and nerfstudio's losses take no"):
        EdgeSEPixelSamplerConfig(**{phase: "expansive"}).check()


def test_a_strategy_of_another_package_that_weights_the_loss_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PIXEL_STRATEGIES, "foreign", PixelStrategy(Expansive, ("early", "late"), "of another package"))
    with pytest.raises(InputError, match="pixel-sampler: foreign weights the loss, and nerfstudio's losses take no"):
        bound(EdgeSEPixelSamplerConfig(early="foreign", late="foreign")).sample(BATCHES["stacked"]())


def test_the_strategies_are_not_all_the_same_draw() -> None:
    batch = BATCHES["stacked"]()
    drawn = [of_host(strategy, images_per_step="all").sample(batch)["indices"] for strategy in STRATEGY_SETTINGS]
    assert not any(torch.equal(drawn[i], drawn[j]) for i in range(4) for j in range(i))


@dataclass(frozen=True)
class Trap:
    """A batch that nerfstudio's own sampler cannot serve."""

    batch: Callable[[], dict[str, Any]]
    raised: type[Exception]
    rays: int = RAYS
    settings: dict[str, Any] = field(default_factory=dict)


TRAPS = {
    "one stacked image with a mask": Trap(lambda: batch_of(images((SIZE,)), stacked=True, mask=True), IndexError),
    "a list with masks": Trap(BATCHES["mixed sizes, masked"], IndexError),
    "a list with another list": Trap(lambda: batch_of(images(MIXED), stacked=False, normals=images(MIXED)), TypeError),
    "an odd number of rays on a list": Trap(BATCHES["mixed sizes"], AssertionError, rays=51),
    "fewer valid pixels than rays": Trap(
        lambda: batch_of(images((SIZE,)), stacked=True, mask=True),
        ValueError,
        rays=200,
        settings={"rejection_sample_mask": False},
    ),
}


@pytest.mark.parametrize("strategy", STRATEGY_SETTINGS)
@pytest.mark.parametrize("name", TRAPS)
def test_batches_that_the_hosts_own_sampler_cannot_serve(name: str, strategy: str) -> None:
    trap = TRAPS[name]
    with pytest.raises(trap.raised):
        PixelSamplerConfig(**trap.settings).setup(num_rays_per_batch=trap.rays).sample(trap.batch())
    batch = trap.batch()
    check_pixels(batch, of_host(strategy, rays=trap.rays, **trap.settings).sample(batch), trap.rays)


def test_the_hosts_own_sampler_serves_what_is_not_a_trap() -> None:
    """Or the traps would show no more than that it was called wrongly."""
    torch.manual_seed(0)
    for kind in ("stacked", "stacked, masked", "mixed sizes", "RGBA", "uint8"):
        batch = BATCHES[kind]()
        check_pixels(batch, PixelSamplerConfig().setup(num_rays_per_batch=RAYS).sample(batch))


def test_masks_can_be_ignored() -> None:
    pixels = of_host("uniform", rays=500, ignore_mask=True).sample(BATCHES["stacked, masked"]())
    assert 0 < int(pixels["mask"].sum()) < 500


@pytest.mark.parametrize("strategy", STRATEGY_SETTINGS)
def test_the_host_may_change_the_number_of_rays_at_any_time(strategy: str) -> None:
    batch, sampler = BATCHES["stacked"](), of_host(strategy)
    for rays in (7, 500):  # 500 is more than the 360 pixels there are
        sampler.set_num_rays_per_batch(rays)
        check_pixels(batch, sampler.sample(batch), rays)


@pytest.mark.parametrize("strategy", STRATEGY_SETTINGS)
def test_the_full_images_come_along_when_asked_for(strategy: str) -> None:
    batch = BATCHES["stacked"]()
    assert of_host(strategy, keep_full_image=True).sample(batch)["full_image"] is batch["image"]
    assert "full_image" not in of_host(strategy).sample(batch)


def test_unbound_it_draws_uniformly() -> None:
    """As a viewer or an exporter finds it: nobody tells it the step, and there is no model to ask."""
    batch = BATCHES["stacked"]()
    sampler = EdgeSEPixelSamplerConfig().setup(num_rays_per_batch=RAYS)
    uniform = EdgeSEPixelSamplerConfig(early="uniform", late="uniform").setup(num_rays_per_batch=RAYS)
    uniform.bind(squared_error=scores, progress=lambda step: step / 100, seed=0)
    assert sampler.strategy == "uniform"
    first = sampler.sample(batch)["indices"]
    for step in (2, 3):
        uniform.set_step(step)
        assert torch.equal(sampler.sample(batch)["indices"], uniform.sample(batch)["indices"])
    assert not torch.equal(first, uniform.sample(batch)["indices"])


def test_the_batch_is_left_as_it_was() -> None:
    for kind, make in BATCHES.items():
        batch, before = make(), make()
        for strategy in STRATEGY_SETTINGS:
            of_host(strategy).sample(batch)
        assert batch.keys() == before.keys(), kind
        for key, value in batch.items():
            assert all(torch.equal(a, b) for a, b in zip(value, before[key], strict=True)), (kind, key)


# -- their configs ----------------------------------------------------------------------------------------------------


def test_the_shared_config_is_not_written_into() -> None:
    """nerfstudio gives training and evaluation the same one."""
    config = EdgeSEPixelSamplerConfig()
    sampler = bound(config, rays=9, is_equirectangular=torch.tensor(False), keep_full_image=True)
    assert config == EdgeSEPixelSamplerConfig()
    assert (sampler.config.num_rays_per_batch, sampler.config.keep_full_image) == (9, True)
    host = PixelSamplerConfig()
    host.setup(num_rays_per_batch=9)
    assert host.num_rays_per_batch == 9


def test_configs_are_importable_by_name_and_survive_pickling() -> None:
    config = EdgeSEPixelSamplerConfig(early="precrop", max_num_iterations=7)
    for named in (type(config), config._target):
        assert getattr(import_module(named.__module__), named.__qualname__) is named
    again = pickle.loads(pickle.dumps(config))
    assert again == config
    assert again is not config
    assert isinstance(again.setup(num_rays_per_batch=4), EdgeSEPixelSampler)


def test_the_flags_are_those_of_both_configs() -> None:
    kind = tyro.conf.SuppressFixed[EdgeSEPixelSamplerConfig]  # as ns-train does
    config = tyro.cli(kind, args=["--early", "precrop", "--max-num-iterations", "7"])
    assert config == EdgeSEPixelSamplerConfig(early="precrop", max_num_iterations=7)
    with pytest.raises(SystemExit):
        tyro.cli(kind, args=["--early", "middle"])


def test_all_images_a_step_is_the_default_here() -> None:
    assert EdgeSEPixelSamplerConfig().images_per_step == "all"
    assert len(set(of_host("edge").sample(BATCHES["stacked"]())["indices"][:, 0].tolist())) == 3


@pytest.mark.parametrize("strategy", STRATEGY_SETTINGS)
@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"is_equirectangular": torch.tensor(True)}, "equirectangular"),
        ({"fisheye_crop_radius": 4.0}, "fisheye crop radius"),
        ({"fisheye_crop_radius": torch.tensor(4.0)}, "fisheye crop radius"),
    ],
)
def test_cameras_whose_pixels_are_not_alike_are_refused(strategy: str, kwargs: Any, message: str) -> None:
    """nerfstudio's own sampler weighs the sphere, or keeps to the circle; drawing as if nothing were is no answer."""
    config = EdgeSEPixelSamplerConfig(**STRATEGY_SETTINGS[strategy])
    with pytest.raises(InputError, match=message):
        config.setup(num_rays_per_batch=RAYS, **kwargs)
    check_pixels(
        batch := BATCHES["stacked"](), PixelSamplerConfig().setup(num_rays_per_batch=RAYS, **kwargs).sample(batch)
    )


def test_loss_weights_are_refused_because_the_host_would_ignore_them() -> None:
    with pytest.raises(InputError, match=r"importance-weight is 1.*nerfstudio's losses take no weights"):
        EdgeSEPixelSamplerConfig(importance_weight=1.0).setup(num_rays_per_batch=RAYS)


def test_coarse_scoring_is_refused_because_the_host_renders_both() -> None:
    with pytest.raises(InputError, match=r"error-source is 'coarse'.*only together with the fine ones"):
        EdgeSEPixelSamplerConfig(error_source="coarse").setup(num_rays_per_batch=RAYS)


def test_a_setting_without_meaning_is_refused_as_everywhere() -> None:
    with pytest.raises(InputError, match="edge-epsilon"):
        EdgeSEPixelSamplerConfig(edge_epsilon=0.0).setup(num_rays_per_batch=RAYS)


def test_their_training_callback_tells_our_sampler_the_step() -> None:
    sampler = bound(EdgeSEPixelSamplerConfig(), step=0)
    callback = TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], sampler.set_step)
    strategies = {}
    for step in (9, 10):
        callback.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        callback.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        strategies[step] = sampler.strategy
        callback.run_callback_at_location(0, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        assert sampler.strategy == strategies[step]
    assert strategies == {9: "edge", 10: "se"}
    with pytest.raises(AssertionError, match="'step: int' must be an argument"):
        TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], lambda: None)


# -- their samplers in our data manager -------------------------------------------------------------------------------


def trainer_with(pixel_sampler: Any, views: Views, rays: int = RAYS, steps: int = 10) -> Trainer:
    """Our own trainer, a tiny model, and any sampler."""
    manager = VanillaDataManagerConfig(train_num_rays_per_batch=rays, pixel_sampler=pixel_sampler)
    config = resolve_config(
        TrainerConfig(
            pipeline=PipelineConfig(manager, tiny_config(density_activation="softplus")),
            max_num_iterations=steps,
            optimizer=OptimizerConfig(lr=1e-2),
        ),
        views,
    )
    return config.setup(
        run=RunFolder(Path("never written")), pipeline=Pipeline.build(config, views, "cpu"), preview=None
    )


@pytest.mark.parametrize(
    ("config", "rays"),
    [
        (PixelSamplerConfig(), RAYS),
        (PatchPixelSamplerConfig(patch_size=4), 48),  # whole patches only: 3 of them
        (PairPixelSamplerConfig(), RAYS),
    ],
    ids=["PixelSampler", "PatchPixelSampler", "PairPixelSampler"],
)
def test_their_samplers_train_our_model_in_our_data_manager(config: Any, rays: int, scene: Path) -> None:
    torch.manual_seed(0)
    before = copy.copy(config)
    trainer = trainer_with(config, read_blender(scene, "train"))
    assert isinstance(trainer.pipeline.datamanager.train_pixel_sampler, PixelSampler)
    assert config == before
    start = [parameter.detach().clone() for parameter in trainer.pipeline.model.parameters()]
    losses = [trainer.train_iteration(step) for step in range(4)]
    assert all(0 < loss < 4 for loss in losses)
    assert len(set(losses)) == 4
    assert any(not torch.equal(a, b) for a, b in zip(start, trainer.pipeline.model.parameters(), strict=True))
    bundle, pixels = trainer.pipeline.datamanager.next_train(4)
    assert len(bundle) == len(pixels["image"]) == rays
    assert torch.equal(bundle.camera_indices[:, 0], pixels["indices"][:, 0])


def test_a_run_with_their_sampler_is_saved_and_goes_on(scene: Path, tmp_path: Path) -> None:
    config = override(method_configs()["vanilla-nerf"], {
        "data": scene, "output_dir": tmp_path, "pipeline.model": tiny_config(), "max_num_iterations": 4,
        SAMPLER: PixelSamplerConfig(), f"{MANAGER}.train_num_rays_per_batch": 16, "machine.device_type": "cpu",
    })  # fmt: skip
    torch.manual_seed(0)
    trainer = prepare(config)
    trainer.train()
    read = trainer.run.config({"vanilla-nerf": config})
    assert read.pipeline.datamanager.pixel_sampler == PixelSamplerConfig()
    resumed = prepare_resume(trainer.run, read, max_num_iterations=6)
    assert resumed.next_step == 4
    resumed.train()
    assert resumed.next_step == 6


def test_their_patches_arrive_whole(scene: Path) -> None:
    torch.manual_seed(0)
    trainer = trainer_with(PatchPixelSamplerConfig(patch_size=4), read_blender(scene, "train"))
    indices = trainer.pipeline.datamanager.next_train(0)[1]["indices"].reshape(-1, 4, 4, 3)
    offsets = indices - indices[:, :1, :1]
    grid = torch.stack(torch.meshgrid(torch.arange(4), torch.arange(4), indexing="ij"), dim=-1)
    assert torch.equal(offsets[..., 1:], grid.expand(len(indices), 4, 4, 2))
    assert not offsets[..., 0].any()


def test_their_sampler_keeps_to_the_masks_of_our_data_manager() -> None:
    masks = tuple(left_third((8, 6))[..., 0].numpy() for _ in range(3))
    torch.manual_seed(0)
    trainer = trainer_with(PixelSamplerConfig(), tiny_views(masks=masks))
    assert int(trainer.pipeline.datamanager.next_train(0)[1]["indices"][:, 2].max()) == 1


def test_training_is_the_same_with_our_sampler_on_either_base(scene: Path) -> None:
    """Bound to a run by the same data manager: both phases, to the last bit."""
    views = read_blender(scene, "train")
    ours = trainer_with(settings_module.EdgeSEPixelSamplerConfig(early_fraction=0.2, images_per_step="all"), views)
    hosted = trainer_with(EdgeSEPixelSamplerConfig(early_fraction=0.2), views)
    assert isinstance(hosted.pipeline.datamanager.train_pixel_sampler, PixelSampler)
    strategies = []
    for step in range(4):
        assert ours.train_iteration(step) == hosted.train_iteration(step)
        strategies.append(hosted.pipeline.datamanager.train_pixel_sampler.strategy)
    assert strategies == ["edge", "edge", "se", "se"]


# -- how nerfstudio finds us ------------------------------------------------------------------------------------------

ENTRY_POINTS = sorted({name for name in STRATEGIES if name != "vanilla-nerf"} | {"edge-se-nerfacto", "lean-nerf"})


def test_entry_points_that_cannot_be_had_break_nothing() -> None:
    """nerfstudio loads them unguarded: one exception, and no ns-train of any method works."""
    code = f"""
import sys
sys.modules["nerfstudio.plugins.types"] = None  # an import of it fails, whatever is installed
from edge_se_sampler.nerfstudio import entry_points
print([getattr(entry_points, name.replace("-", "_")) for name in {ENTRY_POINTS}])
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == str([None] * len(ENTRY_POINTS))
    said = [line for line in run.stderr.splitlines() if line.startswith("edge-se-sampler: ")]  # the rest is imports'
    assert len(said) == 1
    assert said[0].startswith("edge-se-sampler: its methods are left out of nerfstudio: ")
    assert "Traceback" not in run.stderr


def test_an_entry_point_is_named_after_its_method_and_never_after_nerfstudios() -> None:
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 has none")
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    declared = project["entry-points"]["nerfstudio.method_configs"]
    module = "edge_se_sampler.nerfstudio.entry_points"
    assert declared == {name: f"{module}:{name.replace('-', '_')}" for name in ENTRY_POINTS}
    assert not set(declared) & {"vanilla-nerf", "nerfacto", "instant-ngp", "mipnerf"}
