"""The whole host: phases follow the plan of the first run, and nothing of ours enters nerfstudio's state."""
# pyright: reportMissingImports=false

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest
import torch

pytestmark = pytest.mark.nerfstudio_full
pytest.importorskip("nerfstudio.engine.trainer", reason="needs all of nerfstudio 1.1.5")

import nerfstudio  # noqa: E402
from full_host import PLANNED, RAYS, config_of, train, trainer_of, watch  # noqa: E402
from nerfstudio.data.pixel_samplers import PixelSampler  # noqa: E402

from edge_se_sampler.errors import InputError  # noqa: E402
from edge_se_sampler.nerfstudio.resume import PLAN_FILE, SAMPLER_FILE  # noqa: E402


def test_the_host_is_nerfstudio_itself() -> None:
    assert "site-packages" in Path(nerfstudio.__file__ or "").parts


def strategies(seen: list[tuple[int, str, torch.Tensor]]) -> list[tuple[int, str]]:
    return [(step, strategy) for step, strategy, _ in seen]


def resumed(config: Any, trained: Any, **changes: Any) -> Any:
    again = copy.deepcopy(config)
    again.load_dir = trained.checkpoint_dir
    for key, value in changes.items():
        setattr(again, key, value)
    again.timestamp = "resumed"
    return trainer_of(again)


@pytest.mark.parametrize("name", ["edge-se-nerf", "edge-se-nerfacto"])
def test_phases_switch_at_the_planned_step_also_after_resuming(name: str, host_scene: Path, tmp_path: Path) -> None:
    config = config_of(name, host_scene, tmp_path, max_num_iterations=PLANNED)
    trainer = trainer_of(config)
    seen = watch(trainer.pipeline.datamanager.train_pixel_sampler)
    trainer.train()
    assert strategies(seen) == [(step, "edge" if step < PLANNED // 10 else "se") for step in range(PLANNED)]
    assert all(indices.shape == (RAYS, 3) for *_, indices in seen)
    # for 500 more: a tenth of those would be early
    trainer = resumed(config, trainer, max_num_iterations=500)
    seen = watch(trainer.pipeline.datamanager.train_pixel_sampler)
    assert trainer.pipeline.datamanager.train_pixel_sampler.schedule.progress(PLANNED // 2) == 0.5
    train(trainer, 3)
    assert strategies(seen) == [(PLANNED + k, "se") for k in range(3)]
    # and once more: the plan travels on
    third = resumed(config, trainer, max_num_iterations=500, timestamp="third")
    assert third.pipeline.datamanager.train_pixel_sampler.schedule.progress(PLANNED // 2) == 0.5


def test_a_run_stopped_in_its_early_phase_goes_on_in_it(host_scene: Path, tmp_path: Path) -> None:
    config = config_of("edge-se-nerf", host_scene, tmp_path, max_num_iterations=60)
    trainer = trainer_of(config)
    train(trainer, 4)
    trainer = resumed(config, trainer, max_num_iterations=400)
    seen = watch(trainer.pipeline.datamanager.train_pixel_sampler)
    train(trainer, 4)
    assert strategies(seen) == [(4, "edge"), (5, "edge"), (6, "se"), (7, "se")]


def drawn(trainer: Any, steps: int) -> list[torch.Tensor]:
    seen = watch(trainer.pipeline.datamanager.train_pixel_sampler)
    train(trainer, steps)
    return [indices for *_, indices in seen]


LEARNING: dict[str, dict[str, Any]] = {
    **{name: {"late": name} for name in ("error-map", "error-cdf", "soft-mining", "actray", "regions", "quadtree")},
    "se-cached": {"late": "se", "error_source": "cached"},
}


@pytest.mark.parametrize("strategy", ["edge", *LEARNING])
def test_a_resumed_run_draws_what_the_uninterrupted_one_draws(strategy: str, host_scene: Path, tmp_path: Path) -> None:
    config = config_of("edge-nerf", host_scene, tmp_path, max_num_iterations=60)
    settings = LEARNING[strategy] | {"early": "uniform", "early_fraction": 0.0} if strategy in LEARNING else {}
    vars(config.pipeline.datamanager.pixel_sampler).update(settings)
    expected = drawn(trainer_of(copy.deepcopy(config)), 8)
    config.timestamp = "first"
    first = trainer_of(copy.deepcopy(config))
    drawn(first, 5)
    assert (first.base_dir / SAMPLER_FILE.format(rank=0, step=4)).exists() == (strategy in LEARNING)
    steps = (
        1 if strategy in LEARNING else 3
    )  # the errors that follow depend on nerfstudio's random numbers, which go on
    for pixels, expected_pixels in zip(drawn(resumed(config, first), steps), expected[5 : 5 + steps], strict=True):
        assert torch.equal(pixels, expected_pixels)


def test_what_was_learnt_by_another_checkpoint_is_not_taken(host_scene: Path, tmp_path: Path, capfd: Any) -> None:
    config = config_of("edge-nerf", host_scene, tmp_path, max_num_iterations=60)
    vars(config.pipeline.datamanager.pixel_sampler).update(early="uniform", late="actray", early_fraction=0.0)
    trainer = trainer_of(config)
    train(trainer, 3)
    path = trainer.base_dir / SAMPLER_FILE.format(rank=0, step=2)
    saved = torch.load(path, weights_only=True)
    torch.save(saved | {"step": 1}, path)
    again = resumed(config, trainer)
    assert f"{path} has no state of step 2: the strategies learn anew" in capfd.readouterr().err
    assert not again.pipeline.datamanager.train_pixel_sampler.state_dict()["actray.distribution"]["clock"]
    for content in (saved | {"state": {"actray.distribution": {}}}, {"step": 2}, []):
        torch.save(content, path)
        with pytest.raises(InputError, match=f"{path.name}: cannot be read .*; delete it to let the strategies learn"):
            resumed(config, trainer)
    path.write_bytes(b"no state")
    with pytest.raises(InputError, match=f"{path.name}: cannot be read"):
        resumed(config, trainer)


def test_a_checkpoint_without_a_plan_is_reported(host_scene: Path, tmp_path: Path, capfd: Any) -> None:
    config = config_of("edge-se-nerf", host_scene, tmp_path)
    trainer = trainer_of(config)
    train(trainer, 1)
    (trainer.base_dir / PLAN_FILE).unlink()
    capfd.readouterr()
    again = resumed(config, trainer, max_num_iterations=400)
    assert again.pipeline.datamanager.train_pixel_sampler.schedule.progress(200) == 0.5
    assert f"no plan at {trainer.base_dir / PLAN_FILE}" in capfd.readouterr().err


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"planned_steps": "20"}', '{"planned_steps": 0}'])
def test_what_is_no_plan_is_refused(content: str, host_scene: Path, tmp_path: Path) -> None:
    config = config_of("edge-se-nerf", host_scene, tmp_path)
    trainer = trainer_of(config)
    train(trainer, 1)
    (trainer.base_dir / PLAN_FILE).write_text(content)
    with pytest.raises(InputError, match=f"{PLAN_FILE}: .*delete it to follow"):
        resumed(config, trainer)


def test_the_state_is_nerfstudios_alone(host_scene: Path, tmp_path: Path) -> None:
    config = config_of("edge-se-nerf", host_scene, tmp_path)
    trainer = trainer_of(config)
    train(trainer, 4)
    stock = trainer_of(config_of("vanilla-nerf", host_scene, tmp_path))
    (checkpoint,) = trainer.checkpoint_dir.glob("*.ckpt")
    saved = torch.load(checkpoint, weights_only=False)
    assert set(saved["pipeline"]) == set(stock.pipeline.state_dict())
    assert json.loads((trainer.base_dir / PLAN_FILE).read_text()) == {"planned_steps": PLANNED}
    manager = trainer.pipeline.datamanager
    if isinstance(manager, torch.nn.Module):  # as in 1.1.5, no longer in its main branch
        held = {type(module).__name__ for module in manager.modules()}
        assert held == {"EdgeSEDataManager", "RayGenerator"}  # not the pipeline: its weights would be saved twice


def test_evaluation_stays_nerfstudios_and_configs_stay_as_they_were(host_scene: Path, tmp_path: Path) -> None:
    config = config_of("edge-se-nerf", host_scene, tmp_path)
    before = copy.deepcopy(config.pipeline.datamanager.pixel_sampler)
    trainer = trainer_of(config)
    manager = trainer.pipeline.datamanager
    assert type(manager.eval_pixel_sampler) is PixelSampler
    assert manager.eval_pixel_sampler.num_rays_per_batch == RAYS
    train(trainer, 4)
    assert config.pipeline.datamanager.pixel_sampler == before
    trainer.pipeline.get_eval_loss_dict(0)


def test_the_host_may_change_the_number_of_rays_while_training(host_scene: Path, tmp_path: Path) -> None:
    trainer = trainer_of(config_of("se-nerf", host_scene, tmp_path))
    sampler = trainer.pipeline.datamanager.train_pixel_sampler
    seen = watch(sampler)
    sampler.set_step(10)
    for rays in (7, 40, 5000):  # the last: more than the training images have pixels
        sampler.set_num_rays_per_batch(rays)
        trainer.train_iteration(10)
    assert [len(indices) for *_, indices in seen] == [7, 40, 5000]
    assert [strategy for _, strategy, _ in seen] == ["se"] * 3
