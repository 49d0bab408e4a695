"""Trainings on real scenes: what is measured of one, and the page of a result."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from edge_se_sampler.bench.real.command import BenchReal
from edge_se_sampler.bench.real.report import describe
from edge_se_sampler.bench.real.trials import VARIANTS, Settings, Trial, run_trial
from edge_se_sampler.bench.runner import new_result, write_result
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.errors import InputError

RUN = {
    "psnr": 30.0, "ssim": 0.95, "val_psnr": 31.0, "train_psnr": 33.0, "steps": 1000, "seconds": 60.1,
    "cpu_seconds": 110.0, "level": 2, "rows": 5_000_000, "memory": 1.9, "seconds_per_view": 0.1,
}  # fmt: skip


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    make_scenes(folder, ("bricks",), size=24, num_train=6, num_val=1, num_test=2)
    return folder


def test_a_training_is_measured_on_every_split(scenes: Path, tmp_path: Path) -> None:
    run = run_trial(Trial("bricks", 1, "2s", "lean-nerf", 0), scenes, tmp_path, Settings(num_train_views=2))
    assert run.keys() == RUN.keys()
    assert run["seconds"] == pytest.approx(2, abs=1)
    assert 12 < run["psnr"] < 40
    assert len({run[name] for name in ("psnr", "val_psnr", "train_psnr")}) == 3  # other views each
    assert 0.2 < run["memory"] < 4


def result_of(folder: Path, runs: list[dict[str, Any]]) -> Path:
    result = new_result("real", {"num_train_views": 5}) | {"errors": [], "runs": runs}
    write_result(folder / "result.json", json.loads(json.dumps(result)))
    return folder


def run_of(
    psnr: float, seed: int, scene: str = "lego", budget: str = "1m", variant: str = "lean-nerf"
) -> dict[str, Any]:
    return {"scene": scene, "downscale": 2, "budget": budget, "variant": variant, "seed": seed, **RUN, "psnr": psnr}


def test_the_page_has_medians_and_differences_on_the_same_seeds(tmp_path: Path) -> None:
    runs = [run_of(psnr, seed) for seed, psnr in enumerate((30.0, 32.0, 31.5))]
    runs += [run_of(33.0, 0, budget="3m"), run_of(35.0, 0, scene="chair"), run_of(29.5, 0, variant="no hull")]
    page = describe(result_of(tmp_path, runs))
    assert "| lego, 400 px | 31.50 (30.00 to 32.00) | 33.00 |" in page
    assert "| chair, 400 px | 35.00 | – |" in page
    assert "| lego, 400 px | 1m | no hull | 29.50 | -0.50 | 1 |" in page


def test_without_variants_there_is_no_section_of_them(tmp_path: Path) -> None:
    assert "One thing changed" not in describe(result_of(tmp_path, [run_of(30.0, 0)]))


def test_every_variant_changes_what_there_is() -> None:
    from edge_se_sampler.engine.config import override
    from edge_se_sampler.methods import method_configs

    config = method_configs()["lean-nerf"]
    for label, changes in VARIANTS.items():
        assert (override(config, changes) != config) == (label != "lean-nerf"), label


def test_missing_scenes_are_refused(scenes: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no folder lego"):
        BenchReal(output_dir=tmp_path, scenes_dir=scenes).experiment()
