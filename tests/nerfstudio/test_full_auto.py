"""The whole host under schedule "adaptive": the phases follow the errors that training sees, and nothing else."""
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

from full_host import PLANNED, config_of, train, trainer_of, watch  # noqa: E402

from edge_se_sampler.nerfstudio.resume import SCHEDULE_FILE  # noqa: E402
from edge_se_sampler.nerfstudio.scoring import DEAD_CHECK_STEPS, squared_errors  # noqa: E402
from edge_se_sampler.sampling.background import PlainBackgrounds  # noqa: E402
from edge_se_sampler.sampling.schedule import WINDOW_STEPS  # noqa: E402


def auto(name: str, scene: Path, runs: Path, **changes: Any) -> Any:
    config = config_of(name, scene, runs, **changes)
    config.pipeline.datamanager.pixel_sampler.schedule = "adaptive"
    return config


def observed(trainer: Any) -> list[float]:
    """The mean of the errors of every training batch that the sampler observes from now on."""
    sampler, means = trainer.pipeline.datamanager.train_pixel_sampler, []
    observe = sampler.observe
    sampler.observe = lambda errors: (means.append(float(errors.mean())), observe(errors))[1]
    return means


@pytest.mark.parametrize("alpha", ["white", None])
@pytest.mark.parametrize("name", ["edge-se-nerf", "edge-se-nerfacto"])
def test_every_training_batch_is_observed_once(name: str, alpha: str | None, host_scene: Path, tmp_path: Path) -> None:
    trainer = trainer_of(auto(name, host_scene, tmp_path, alpha=alpha))
    sampler = trainer.pipeline.datamanager.train_pixel_sampler
    means = observed(trainer)
    rendered: list[float] = []

    def record(module: Any, _: Any, outputs: Any) -> None:
        if module.training and sampler.pending_batch is not None:
            image = sampler.pending_batch.values["image"]
            rendered.append(float(squared_errors(module, outputs, image).detach().mean()))

    hooks = trainer.pipeline.model._forward_hooks
    handle = trainer.pipeline.model.register_forward_hook(record)
    hooks.move_to_end(handle.id, last=False)  # before ours, which takes the batch
    train(trainer, 3)
    trainer.pipeline.eval()
    trainer.pipeline.get_eval_loss_dict(0)
    trainer.pipeline.train()
    assert len(means) == 3
    assert means == rendered
    sampler.schedule.current = "late"
    trainer._start_step = 3
    train(trainer, 2)  # now scored candidates are observed, once a step
    assert sampler.schedule.observations == 5


def test_the_phase_follows_the_errors(host_scene: Path, tmp_path: Path) -> None:
    trainer = trainer_of(auto("edge-se-nerf", host_scene, tmp_path))
    sampler = trainer.pipeline.datamanager.train_pixel_sampler
    observe, share = sampler.observe, 1.0

    def as_if(errors: torch.Tensor) -> None:
        pixels = sampler.pending_batch.values
        image, numbers = pixels["image"].numpy(), pixels["indices"][:, 0].numpy()
        backgrounds = PlainBackgrounds()
        backgrounds.add(sampler.pending_batch.batch)
        distance = backgrounds.squared_distance(image, numbers, sampler.background_color)
        observe(torch.full((len(image),), share * float(distance.mean())))  # alike, so that edges do not pay

    sampler.observe = as_if
    seen = watch(sampler)
    train(trainer, 30)
    assert {strategy for _, strategy, _ in seen} == {"edge"}  # though planned for 20 steps
    share = 0.1
    trainer._start_step = 30
    train(trainer, WINDOW_STEPS + 3)
    assert seen[-1][1] == "se"


def test_a_resumed_run_continues_with_the_saved_schedule(host_scene: Path, tmp_path: Path) -> None:
    config = auto("edge-se-nerf", host_scene, tmp_path, max_num_iterations=PLANNED)
    trainer = trainer_of(config)
    trainer.train()
    saved = trainer.checkpoint_dir.parent / SCHEDULE_FILE
    states = json.loads(saved.read_text())
    assert states[str(PLANNED - 1)]["observations"] == PLANNED
    assert all("step" in path.name for path in trainer.checkpoint_dir.iterdir())  # nothing of ours among them
    again = copy.deepcopy(config)
    again.load_dir, again.timestamp = trainer.checkpoint_dir, "resumed"
    resumed = trainer_of(again)
    assert resumed.pipeline.datamanager.train_pixel_sampler.schedule.state_dict() == states[str(PLANNED - 1)]
    again.timestamp = config.timestamp  # in its own folder, where the checkpoint that it began with stays
    again.max_num_iterations = 2
    trainer_of(again).train()
    assert json.loads(saved.read_text())[str(PLANNED - 1)] == states[str(PLANNED - 1)]


def test_a_dead_model_is_reported_once(host_scene: Path, tmp_path: Path, capfd: Any) -> None:
    trainer = trainer_of(auto("edge-se-nerf", host_scene, tmp_path))
    field = trainer.pipeline.model.field_fine.field_output_density.net
    with torch.no_grad():  # its softplus is never dead, but may be as good as that
        field.weight.zero_()
        field.bias.fill_(-40)
    trainer.pipeline.datamanager.train_pixel_sampler.schedule.observations = DEAD_CHECK_STEPS - 2
    train(trainer, 5)
    assert capfd.readouterr().err.count("nothing of the object is learnt") == 1


def test_cached_errors_are_those_of_training_and_no_candidate_is_rendered(host_scene: Path, tmp_path: Path) -> None:
    config = config_of("edge-se-nerf", host_scene, tmp_path)
    config.pipeline.datamanager.pixel_sampler.error_source = "cached"
    trainer = trainer_of(config)
    sampler = trainer.pipeline.datamanager.train_pixel_sampler
    means, seen = observed(trainer), watch(sampler)
    rendered = []
    trainer.pipeline.model.register_forward_hook(lambda *_: rendered.append(1))
    train(trainer, 8)
    assert {strategy for _, strategy, _ in seen} == {"edge", "se"}
    assert len(means) == len(rendered) == 8  # one rendering a step, of what is trained on
    error_map = sampler.strategies["se"].selector.error_map
    assert error_map.updated.max() == 8
    values = error_map.values[error_map.updated > 0]
    assert float(values.min()) >= 0
    assert values.std() > 0
