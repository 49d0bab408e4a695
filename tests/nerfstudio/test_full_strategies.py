"""Ways of choosing pixels compared inside nerfstudio: what is trained there is what `bench strategies` says."""
# pyright: reportMissingImports=false

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.nerfstudio_full
pytest.importorskip("nerfstudio.engine.trainer", reason="needs all of nerfstudio 1.1.5")

from capture_folder import OPENCV, write_transforms  # noqa: E402

from edge_se_sampler.bench.baselines.folders import copied_scene  # noqa: E402
from edge_se_sampler.bench.strategies import nerfacto  # noqa: E402
from edge_se_sampler.bench.strategies.train import run_trial  # noqa: E402
from edge_se_sampler.bench.strategies.trials import (  # noqa: E402
    NERFACTO,
    PLANS,
    STRATEGIES,
    Length,
    PlanName,
    Settings,
    Trial,
)

SHORT = Settings(nerf=Length(1.5, 4, 2))
TRIAL = Trial(NERFACTO, "mic", 1, "centered", "steps", "edge", 3)


@pytest.mark.parametrize("plan", PLANS)
def test_a_training_lasts_as_long_as_its_plan(plan: PlanName, host_scene: Path) -> None:
    run = run_trial(replace(TRIAL, plan=plan), SHORT, host_scene)
    if plan == "steps":
        assert run["steps"] == 4
    else:
        assert run["seconds"] == pytest.approx(1.5, abs=0.5)
        assert run["steps"] > 4
    assert 0 < run["ready_seconds"] < run["seconds"] < run["cpu_seconds"]
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
