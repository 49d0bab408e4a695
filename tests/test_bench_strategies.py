"""Ways of choosing pixels on real scenes: what is trained, and that the page's numbers are those of the runs."""

from __future__ import annotations

import json
import shutil
import statistics
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_folder import HEIGHT, WIDTH, write_colmap

from edge_se_sampler.bench.results import new_result, write_result
from edge_se_sampler.bench.strategies.claims import CLAIMS
from edge_se_sampler.bench.strategies.command import BenchStrategies
from edge_se_sampler.bench.strategies.report import describe, describe_use, draw, table_of_claims, tables
from edge_se_sampler.bench.strategies.summary import (
    Panel,
    best_at_equal_seconds,
    captures_of,
    compare,
    cost_of_a_step,
    count_failures,
    panels_of,
)
from edge_se_sampler.bench.strategies.train import build_config, run_trial, without_alpha
from edge_se_sampler.bench.strategies.trials import (
    MODELS,
    NERFACTO,
    PLANS,
    STRATEGIES,
    Length,
    PlanName,
    Settings,
    Trial,
    read_views,
)
from edge_se_sampler.bench.train import offcenter_copies
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.config import MANAGER, MODEL
from edge_se_sampler.engine.session import resolve_config
from edge_se_sampler.errors import InputError
from edge_se_sampler.sampling.registry import PIXEL_STRATEGIES

SHORT = Settings(nerf=Length(0.6, 12, 2), lean=Length(1, 30, 2))
TRIAL = Trial("lean", "bricks", 1, "centered", "steps", "edge", 3)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scenes(tmp_path_factory.mktemp("scenes"), ("bricks",), size=24, num_train=6, num_val=1, num_test=3)[0]


# -- what is trained


@pytest.mark.parametrize(
    ("model", "strategy"), [(m, name) for name, s in STRATEGIES.items() for m in s.models if m in ("nerf", "lean")]
)
def test_every_strategy_can_be_trained_under_both_plans(model: str, strategy: str, scene: Path, tmp_path: Path) -> None:
    for plan in ("seconds", "steps"):
        trial = replace(TRIAL, model=model, strategy=strategy, plan=plan)
        config = resolve_config(build_config(trial, SHORT, tmp_path), read_views(scene, 1, "train"))
        sampler: Any = config.pipeline.datamanager.pixel_sampler
        known = PIXEL_STRATEGIES.get(strategy)
        expected: dict[str, Any] = dict(STRATEGIES[strategy].settings)
        if known:
            expected = {phase: strategy for phase in known.phases}
        chosen = {"early": "uniform", "late": "uniform", **expected}
        assert {name: getattr(sampler, name) for name in chosen} == chosen
        assert sampler.early_steps == {"nerf": 1, "lean": 3}[model]


@pytest.mark.parametrize("plan", PLANS)
@pytest.mark.parametrize("model", ["nerf", "lean"])
def test_a_training_lasts_as_long_as_its_plan(
    model: str, plan: PlanName, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fast = {f"{MODEL}.width": 16, f"{MODEL}.num_coarse_samples": 8, f"{MODEL}.num_importance_samples": 4}
    rays = {f"{MANAGER}.train_num_rays_per_batch": 64}
    nerf = MODELS["nerf"]
    monkeypatch.setitem(MODELS, "nerf", replace(nerf, changes={**nerf.changes, **fast, **rays}))
    run = run_trial(replace(TRIAL, model=model, plan=plan), SHORT, scene)
    length: Length = getattr(SHORT, model)
    if plan == "steps":
        assert run["steps"] == length.steps
    else:
        assert run["seconds"] == pytest.approx(length.seconds, abs=0.4)
        assert run["steps"] != length.steps
    assert 0 < run["ready_seconds"] < run["seconds"] < run["cpu_seconds"]
    assert run["size"] == [24, 24]
    assert len({run[name] for name in ("psnr", "foreground_psnr", "edge_band_psnr")}) == 3
    assert 3 < run["psnr"] < 40
    assert json.loads(json.dumps(run)) == run


def test_without_masks_the_images_are_composited_on_white(scene: Path) -> None:
    views = read_views(scene, 1, "train")
    image = without_alpha(views).images[1]
    alpha = views.images[1][..., 3:] / 255
    assert (alpha < 1).any()
    assert image.shape == (24, 24, 3)
    np.testing.assert_allclose(image, views.images[1][..., :3] * alpha + 255 * (1 - alpha), atol=0.51)


def test_masks_make_a_difference(scene: Path) -> None:
    runs = [run_trial(replace(TRIAL, model=model), SHORT, scene) for model in ("lean", "lean-no-masks")]
    assert runs[0]["psnr"] > runs[1]["psnr"]


def test_what_is_compared_is_trained_side_by_side(tmp_path: Path) -> None:
    for scene in ("lego", "chair"):
        (tmp_path / scene).mkdir()
    command = BenchStrategies(
        output_dir=tmp_path,
        scenes_dir=tmp_path,
        models=("nerf", "lean"),
        strategies=("edge", "hard-samples"),
        plans=("steps",),
    )
    experiment = command.experiment()
    trials = experiment.trials([])
    first = Trial("nerf", "lego", 8, "centered", "steps", "edge", 0)
    assert trials[:2] == [first, replace(first, strategy="hard-samples")]
    assert len(trials) == 3 * 2 * 2 * 2 * (2 + 1)  # hard samples are of NeRF alone
    assert experiment.arguments(first) == (Settings(), tmp_path / "lego")


def test_nerfacto_is_trained_on_small_copies_by_what_needs_no_weights(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flags: Any = {"output_dir": tmp_path, "scenes_dir": scene.parent, "scenes": ("bricks",), "models": (NERFACTO,)}
    command = BenchStrategies(**flags, workplace=tmp_path, placements=("centered",), downscales=(2,), plans=("steps",))
    monkeypatch.setattr("edge_se_sampler.bench.nerfstudio.host.find_spec", lambda _: None)
    with pytest.raises(InputError, match="nerfstudio"):
        command.experiment()
    monkeypatch.setattr("edge_se_sampler.bench.nerfstudio.host.find_spec", lambda _: True)
    experiment = command.experiment()
    trials = experiment.trials([])
    assert {t.strategy for t in trials} == STRATEGIES.keys() - {"expansive", "se-coarse", "hard-samples"}
    _, data = experiment.arguments(trials[0])
    assert read_views(data, 1, "test").images[0].shape[:2] == (12, 12)


def test_one_command_trains_nerfacto_on_captures_beside_all_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in ("lego", "fox"):
        (tmp_path / folder).mkdir()
    flags: Any = {"output_dir": tmp_path, "scenes_dir": tmp_path, "scenes": ("lego",), "captures": ("fox",)}
    monkeypatch.setattr("edge_se_sampler.bench.nerfstudio.host.find_spec", lambda _: True)
    with pytest.raises(InputError, match="add lean-no-masks or nerfacto to --models"):
        BenchStrategies(**flags, models=("nerf", "lean")).experiment()
    command = BenchStrategies(**flags, models=("nerf", NERFACTO), strategies=("uniform", "edge"), seeds=(5,))
    trials = command.experiment().trials([])
    assert len(trials) == len(set(trials)) == 2 * 2 * 2 * 2 * 2 + 2 * 2
    assert {(t.model, t.downscale, t.placement) for t in trials if t.scene == "fox"} == {(NERFACTO, 8, "centered")}


def test_lean_nerf_is_trained_on_a_capture_for_as_long_as_is_said(tmp_path: Path) -> None:
    write_colmap(tmp_path / "mug")
    flags: Any = {
        "output_dir": tmp_path,
        "scenes_dir": tmp_path,
        "scenes": (),
        "captures": ("mug",),
        "downscales": (2,),
    }
    command = BenchStrategies(**flags, models=("lean-no-masks",), plans=("seconds",), seeds=(1,), lean_seconds=1)
    experiment = command.experiment()
    trial = experiment.trials([])[0]
    run = run_trial(trial, *experiment.arguments(trial))
    assert 0.9 < run["seconds"] < 5  # not the 10 that is usual
    assert run["size"] == [WIDTH // 2, HEIGHT // 2]
    assert run["foreground_psnr"] is run["foreground_share"] is None
    assert run["outcome"] in ("converged", "underfit")
    assert captures_of([asdict(trial) | run]) == ["mug"]


def test_an_off_center_copy_is_made_once(scene: Path, tmp_path: Path) -> None:
    command = BenchStrategies(
        output_dir=tmp_path, scenes_dir=scene.parent, scenes=("bricks",), workplace=tmp_path, placements=("shifted",)
    )
    experiment = command.experiment()
    trial = experiment.trials([])[0]
    _, folder = experiment.arguments(trial)
    made = (folder / "transforms_train.json").stat().st_mtime_ns
    assert experiment.arguments(trial)[1] == folder
    assert (folder / "transforms_train.json").stat().st_mtime_ns == made
    assert read_views(folder, 1, "train").images[0].shape[:2] == (24 + 2 * 4, 24 + 2 * 5)


def test_scenes_of_one_name_have_off_center_copies_of_their_own(scene: Path, tmp_path: Path) -> None:
    shutil.copytree(scene, tmp_path / "others" / scene.name)
    one, other = (offcenter_copies(folder, tmp_path) for folder in (scene, tmp_path / "others" / scene.name))
    assert one != other


def test_bad_flags_are_refused(tmp_path: Path) -> None:
    (tmp_path / "lego").mkdir()
    flags: Any = {"output_dir": tmp_path, "scenes_dir": tmp_path, "scenes": ("lego",)}
    for bad in ({"strategies": ("none",)}, {"downscales": (0,)}, {"scenes": ("chair",)}):
        with pytest.raises(InputError):
            BenchStrategies(**flags | bad).experiment()


# -- what the runs say


def run_of(psnr: float, seed: int, strategy: str = "uniform", **more: Any) -> dict[str, Any]:
    trial = Trial("lean", "lego", 4, "centered", "seconds", strategy, seed)
    measured = {
        "size": [200, 200], "psnr": psnr, "foreground_psnr": psnr - 5, "edge_band_psnr": psnr - 7, "steps": 100,
        "seconds": 10.0, "ready_seconds": 1.0, "cpu_seconds": 12.0, "outcome": "converged",
    }  # fmt: skip
    return {**asdict(trial), **measured, **more}


def folder_of(folder: Path, runs: list[dict[str, Any]], errors: tuple[dict[str, Any], ...] = ()) -> Path:
    result = new_result("strategies", asdict(Settings())) | {"errors": list(errors), "runs": runs}
    write_result(folder / "result.json", json.loads(json.dumps(result)))
    return folder


PANEL = Panel("lean", (200, 200), "centered")


FAILED = {"uniform": [("lego", 1), ("chair", 0)], "edge": [("lego", 1), ("lego", 2)], "se-cached": []}


def random_runs() -> list[dict[str, Any]]:
    """Three strategies, of which `edge` lacks a seed on chair; `FAILED` lists the scenes and seeds that fail."""
    rng = np.random.default_rng(0)
    return [
        run_of(
            rng.normal(25, 1), seed, strategy, scene=scene, plan=plan, placement=placement,
            foreground_psnr=rng.normal(20, 1), edge_band_psnr=rng.normal(18, 1), seconds=rng.uniform(8, 12),
            steps=int(rng.integers(100, 200)), outcome="underfit" if (scene, seed) in FAILED[strategy] else "converged",
        )
        for strategy, scene, plan, placement, seed in product(
            ("uniform", "edge", "se-cached"), ("lego", "chair"), ("seconds", "steps"), ("centered", "shifted"), range(4)
        )
        if (strategy, scene, seed) != ("edge", "chair", 2)
    ]  # fmt: skip


def test_numbers_are_those_of_brute_force() -> None:
    runs = random_runs()

    def at(strategy: str, scene: str, plan: str, seed: int) -> dict[str, Any]:
        key = {"strategy": strategy, "scene": scene, "plan": plan, "seed": seed, "placement": "centered"}
        return next(run for run in runs if key.items() <= run.items())

    seeds = {"lego": (0, 1, 2, 3), "chair": (0, 1, 3)}
    for plan in ("seconds", "steps"):
        found = compare(runs, PANEL, "edge", plan)
        assert found is not None
        pairs = {s: [(at("edge", s, plan, i), at("uniform", s, plan, i)) for i in seeds[s]] for s in seeds}
        medians = [np.median([edge["psnr"] for edge, _ in of_scene]) for of_scene in pairs.values()]
        assert found.psnr == pytest.approx(sum(medians) / 2)
        alive = [
            [[r["psnr"] for p in pairs[s] if (r := p[i])["outcome"] == "converged"] for s in seeds] for i in (0, 1)
        ]
        spreads = [np.mean([np.ptp(psnrs) for psnrs in of_scenes]) for of_scenes in alive]
        assert found.spread == pytest.approx(max(spreads))
        pairs = {s: [p for p in pairs[s] if "converged" in (p[0]["outcome"], p[1]["outcome"])] for s in seeds}
        for metric in ("psnr", "foreground_psnr", "edge_band_psnr"):
            medians = [np.median([edge[metric] - uniform[metric] for edge, uniform in pairs[s]]) for s in seeds]
            assert found.differences[metric] == pytest.approx(sum(medians) / 2)
        assert len(found.pairs) == sum(map(len, pairs.values())) < 7
    ratios = []
    for scene, numbers in seeds.items():
        for seed in numbers:
            edge, uniform = (at(strategy, scene, "steps", seed) for strategy in ("edge", "uniform"))
            ratios.append((edge["seconds"] - 1) / edge["steps"] / ((uniform["seconds"] - 1) / uniform["steps"]))
    assert cost_of_a_step(runs, PANEL, "edge") == pytest.approx(statistics.median(ratios))
    outcomes = [run["outcome"] for run in runs if run["strategy"] == "edge" and run["placement"] == "centered"]
    assert count_failures(runs, PANEL, "edge") == (14 - outcomes.count("converged"), 14)


@pytest.mark.parametrize(
    ("psnrs", "verdict", "use"),
    [
        ((27.0, 27.1, 27.2), "better", "yes, better: lean (200 px)"),
        ((25.4, 25.5, 25.3), "same", "no need, not distinguishable in 1 of 1"),
        ((26.0, 26.1, 26.2), "same", "no need, not distinguishable in 1 of 1"),  # so does that of uniform
        ((23.0, 23.1, 23.2), "worse", "no, worse: lean (200 px)"),
        ((29.0,), None, "no verdict (too few seeds) in 1 of 1"),
        ((24.0, 27.0, 27.1), "same", "no need, not distinguishable in 1 of 1"),  # its own spread counts
    ],
)
def test_a_verdict_needs_more_than_the_spread_of_seeds(psnrs: tuple[float, ...], verdict: str | None, use: str) -> None:
    runs = [run_of(psnr, seed) for seed, psnr in enumerate((25.0, 25.3, 26.0)[: len(psnrs)])]
    runs += [run_of(psnr, seed, "edge") for seed, psnr in enumerate(psnrs)]
    found = compare(runs, PANEL, "edge", "seconds")
    assert found is not None
    assert found.verdict == verdict
    assert describe_use(runs, "edge") == use
    assert best_at_equal_seconds(runs, PANEL) == ("uniform" if verdict == "worse" else "edge")


def test_a_single_pair_has_no_verdict_however_many_seeds_one_side_has() -> None:
    runs = [run_of(25.0, 0), *(run_of(29 + seed / 10, seed, "edge") for seed in range(3))]
    found = compare(runs, PANEL, "edge", "seconds")
    assert found is not None
    assert found.differences["psnr"] == pytest.approx(4)
    assert found.verdict is None
    runs += [run_of(25.0, seed, outcome="collapsed") for seed in (1, 2)]  # it lives where uniform pixels die
    found = compare(runs, PANEL, "edge", "seconds")
    assert found is not None
    assert found.verdict == "better"


def test_one_place_where_a_strategy_is_better_is_a_use_of_it() -> None:
    runs = []
    for downscale, offsets in ((4, (2, 2)), (8, (-2, -2)), (16, (0, 0)), (2, (2,))):
        for seed, offset in enumerate(offsets):
            more = {"downscale": downscale, "size": [800 // downscale] * 2}
            runs += [run_of(25 + seed / 10, seed, **more), run_of(25 + offset, seed, "edge", **more)]
    expected = "only where it is better: lean (200 px); worse: lean (100 px); not distinguishable in 1 of 4"
    assert describe_use(runs, "edge") == f"{expected}; no verdict (too few seeds) in 1 of 4"
    nowhere_worse = [run for run in runs if run["downscale"] != 8]
    assert describe_use(nowhere_worse, "edge").startswith("yes, better: lean (200 px); not distinguishable")
    less = [run for run in runs if run["downscale"] >= 8]
    assert describe_use(less, "edge") == "no, worse: lean (100 px); not distinguishable in 1 of 2"
    assert describe_use(less, "se") == "–"
    worse = [run for run in runs if run["downscale"] == 8]
    moved = [run | {"placement": "shifted"} for run in worse]
    nerf = [run | {"model": "nerf"} for run in (*worse, *(run for run in runs if run["downscale"] == 16))]
    expected = "no, worse: nerf (100 px), lean; not distinguishable in 1 of 4"
    assert describe_use([*worse, *moved, *nerf], "edge") == expected


def test_images_of_another_size_are_compared_apart() -> None:
    fox = {"scene": "fox", "size": [135, 240], "downscale": 4}
    runs = [run_of(20.0, 0), run_of(24.0, 0, "edge"), run_of(10.0, 0, **fox), run_of(9.0, 0, "edge", **fox)]
    assert [panel.size for panel in panels_of(runs)] == [(135, 240), (200, 200)]
    found = [compare(runs, panel, "edge", "seconds") for panel in panels_of(runs)]
    assert [comparison and comparison.differences["psnr"] for comparison in found] == [-1.0, 4.0]


def test_a_capture_counts_where_it_has_a_number(tmp_path: Path) -> None:
    def both(strategy: str, psnr: float) -> list[dict[str, Any]]:
        fox = {"scene": "fox", "foreground_psnr": None}
        return [run_of(psnr, 0, strategy), run_of(psnr - 1, 0, strategy, **fox)]

    runs = [*both("uniform", 20.0), *both("edge", 23.0)]
    found = compare(runs, PANEL, "edge", "seconds")
    assert found is not None
    assert found.differences == dict.fromkeys(("psnr", "foreground_psnr", "edge_band_psnr"), 3.0)
    runs = [run for run in runs if run["scene"] == "fox"]
    found = compare(runs, PANEL, "edge", "seconds")
    assert found is not None
    assert found.differences == {"psnr": 3.0, "edge_band_psnr": 3.0}
    assert "| edge | 22.00 | +3.00 | – | +3.00 |" in describe(folder_of(tmp_path, runs))


def test_uniform_pixels_are_compared_with_nothing() -> None:
    runs = [run_of(25.0, 0), run_of(26.0, 1), run_of(24.0, 0, "edge", scene="chair")]
    uniform, edge = (compare(runs, PANEL, name, "seconds") for name in ("uniform", "edge"))
    assert uniform is not None
    assert (uniform.spread, uniform.differences, uniform.verdict) == (1.0, {}, None)
    assert edge is not None
    assert (edge.differences, edge.pairs) == ({}, [])  # uniform pixels have no training on that scene
    assert compare(runs, PANEL, "se", "seconds") is None
    assert best_at_equal_seconds(runs, PANEL) is None


def test_the_page_shows_the_numbers(tmp_path: Path) -> None:
    runs = [run_of(psnr, seed) for seed, psnr in enumerate((25.0, 25.2))]
    runs += [run_of(psnr, seed, "edge") for seed, psnr in enumerate((26.0, 26.4))]
    runs += [run_of(psnr, seed, "edge", plan="steps", seconds=7.0) for seed, psnr in enumerate((25.0, 25.1))]
    runs += [run_of(25.0, seed, plan="steps", seconds=4.0, outcome="collapsed") for seed in range(2)]
    page = describe(folder_of(tmp_path, runs, ({"model": "lean", "error": "broken"},)))
    assert "### lean, 200 px\n" in page
    edge = next(line for line in page.splitlines() if line.startswith("| edge | 26.20"))
    assert edge == (
        "| edge | 26.20 (0.40) | **+1.10** | +1.10 | +1.10 | 25.05 (0.10) | +0.05 | +0.05 | +0.05 | x2.00 | 0 of 4 |"
    )
    assert "| uniform | 25.10 (0.20) | – | – | – | 25.00 | – | – | – | x1.00 | 2 of 4 |" in page
    assert "| lean, 200 px | edge | +1.10 | better |" in page
    assert "| lean +1.10, a step x2.00 | yes, better: lean (200 px) |" in tables(tmp_path)["strategies"]
    assert "broken" in page
    assert "failed" not in tables(tmp_path)["strategies"]
    assert "10 s or 800 steps" in page
    assert "ended in an error" not in describe(folder_of(tmp_path, runs))


def test_failures_that_are_told_beside_seconds_are_those_at_equal_seconds() -> None:
    runs = [run_of(25.0 + seed, seed, name) for name in ("uniform", "edge") for seed in range(3)]
    runs += [run_of(9.0, seed, "edge", plan="steps", outcome="collapsed") for seed in range(3)]
    assert "failed" not in table_of_claims(runs)
    runs += [run_of(9.0, 3, "edge", outcome="collapsed")]
    assert ", 1 failed" in table_of_claims(runs)


def test_errors_are_shown_as_they_are(tmp_path: Path) -> None:
    error = "ValueError: <img src=x onerror=alert(1)>`\n[x](javascript:1) \udcff"
    page = describe(folder_of(tmp_path, [run_of(25.0, 0)], ({"model": "lean", "error": error},)))
    assert "- `lean, ValueError: <img src=x onerror=alert(1)>  [x](javascript:1)  `" in page


def test_the_picture_has_a_part_for_every_panel(tmp_path: Path) -> None:
    draw(folder_of(tmp_path, [run_of(25.0, 0)]), None)
    assert not (tmp_path / "chart.png").exists()  # nothing to compare
    draw(folder_of(tmp_path, random_runs()), None)
    assert "chart.png" in describe(tmp_path)


def test_claims_are_of_strategies_by_their_names() -> None:
    assert not {*PIXEL_STRATEGIES} - {*CLAIMS} - {"uniform"}
    assert "uniform" not in CLAIMS
    assert {*MODELS} == {"nerf", "lean", "lean-no-masks"}
