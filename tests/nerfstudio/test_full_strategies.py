"""Ways of choosing pixels compared inside nerfstudio: what is trained there is what `bench strategies` says."""
# pyright: reportMissingImports=false

from __future__ import annotations

import json
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

pytestmark = pytest.mark.nerfstudio_full
pytest.importorskip("nerfstudio.engine.trainer", reason="needs all of nerfstudio 1.1.5")

from capture_folder import OPENCV, write_transforms  # noqa: E402

from edge_se_sampler.bench.baselines.folders import copied_scene  # noqa: E402
from edge_se_sampler.bench.nerfstudio.host import build_trainer  # noqa: E402
from edge_se_sampler.bench.strategies import nerfacto  # noqa: E402
from edge_se_sampler.bench.strategies.nerfacto import nerfacto_config  # noqa: E402
from edge_se_sampler.bench.strategies.train import run_trial  # noqa: E402
from edge_se_sampler.bench.strategies.trials import (  # noqa: E402
    NERFACTO,
    PLACEMENTS,
    STRATEGIES,
    Length,
    PlanName,
    Settings,
    Trial,
)
from edge_se_sampler.bench.train import offcenter_copies  # noqa: E402
from edge_se_sampler.data.synthetic.folder import make_scenes  # noqa: E402

SHORT = Settings(nerf=Length(1.5, 4, 2))
TRIAL = Trial(NERFACTO, "mic", 1, "centered", "steps", "edge", 3)


@pytest.mark.parametrize(("plan", "steps", "seconds"), [("steps", 4, 0.5), ("seconds", 5, 1.75)])
def test_a_training_lasts_as_long_as_its_plan(
    plan: PlanName, steps: int, seconds: float, host_scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # each look at the clock takes 0.25 s: one before the first step, one after each step of a plan by seconds
    clock = SimpleNamespace(process_time=map((0.25).__mul__, count()).__next__)
    monkeypatch.setattr(nerfacto, "time", clock)
    run = run_trial(replace(TRIAL, plan=plan), SHORT, host_scene)
    assert (run["steps"], run["ready_seconds"], run["seconds"]) == (steps, 0.25, seconds)
    assert run["cpu_seconds"] == seconds + 0.5
    assert run["size"] == [32, 32]
    assert len({run[name] for name in ("psnr", "foreground_psnr", "edge_band_psnr")}) == 3
    assert json.loads(json.dumps(run)) == run


@pytest.mark.parametrize("strategy", [name for name, known in STRATEGIES.items() if NERFACTO in known.models])
def test_every_strategy_of_nerfacto_draws_its_pixels(
    strategy: str, host_scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    build_trainer, seen = nerfacto.build_trainer, []

    def build(*arguments: Any) -> Any:
        trainer = build_trainer(*arguments)
        sampler = trainer.pipeline.datamanager.train_pixel_sampler
        seen.append((sampler.config.early, sampler.config.late, sampler.config.early_steps))
        return trainer

    monkeypatch.setattr(nerfacto, "build_trainer", build)
    run = run_trial(replace(TRIAL, strategy=strategy), SHORT, host_scene)
    expected = {"early": "uniform", "late": "uniform", **STRATEGIES[strategy].settings}
    assert seen == [(expected["early"], expected["late"], 1)]
    assert run["steps"] == 4


def test_a_capture_is_measured_beside_its_mean_color(tmp_path: Path) -> None:
    write_transforms(tmp_path / "scene", OPENCV)
    copy = copied_scene(tmp_path / "work", tmp_path / "scene", downscale=2)
    run = run_trial(TRIAL, SHORT, copy)
    assert run["foreground_psnr"] is None
    assert run["background_psnr"] > 0
    assert (run["outcome"] == "converged") == (run["psnr"] >= run["background_psnr"] + 0.5)


def test_off_center_a_blender_scene_keeps_cameras_box_and_depths(host_scene: Path, tmp_path: Path) -> None:
    (scene,) = make_scenes(tmp_path / "scenes", ["mic"], size=32, num_train=4, num_val=2, num_test=2)
    copies = offcenter_copies(scene, tmp_path)
    trainers = []
    for placement in PLACEMENTS:
        data = copied_scene(tmp_path, copies / placement, downscale=1)
        config = nerfacto_config(replace(TRIAL, placement=placement), SHORT, data, tmp_path / "runs", is_object=True)
        trainers.append(build_trainer(config, "test"))
    centered, shifted = (trainer.pipeline.datamanager.train_dataset for trainer in trainers)
    assert torch.equal(centered.cameras.camera_to_worlds, shifted.cameras.camera_to_worlds)
    assert torch.equal(centered.scene_box.aabb, shifted.scene_box.aabb)
    assert not torch.equal(centered.cameras.cx, shifted.cameras.cx)
    assert {trainer.pipeline.model.collider.far_plane for trainer in trainers} == {6}


def test_a_photographed_object_has_depths_of_its_own(tmp_path: Path) -> None:
    write_transforms(tmp_path / "scene", OPENCV)
    copy = copied_scene(tmp_path / "work", tmp_path / "scene", downscale=2)
    model = nerfacto_config(TRIAL, SHORT, copy, tmp_path / "runs", is_object=True).pipeline.model
    assert (model.background_color, model.far_plane, model.disable_scene_contraction) == ("white", 1000, False)
