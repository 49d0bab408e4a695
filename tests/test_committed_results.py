"""Every number in the README is the committed result's, and a committed result comes out again."""

from __future__ import annotations

import json
import math
import statistics
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from edge_se_sampler.bench import demo
from edge_se_sampler.bench.chart.summary import (
    comparable,
    dominating,
    front,
    over_scenes,
    rows_of,
    rows_of_others,
    rows_of_scenes,
)
from edge_se_sampler.bench.chart.train import LOOKS
from edge_se_sampler.bench.chart.variants import GROUPS, VARIANTS
from edge_se_sampler.bench.paper.published import LABELS, SCENES, STRATEGIES
from edge_se_sampler.bench.paper.scenes import synthetic_scenes
from edge_se_sampler.bench.paper.tables import alike
from edge_se_sampler.bench.paper.trials import PAPERS, PRESETS, Cell, run_cell
from edge_se_sampler.bench.paper.verdicts import failed, verdicts
from edge_se_sampler.bench.schedule.summary import MARGIN, failures, lengths
from edge_se_sampler.bench.stability.settings import STRATEGIES as MAP_STRATEGIES
from edge_se_sampler.bench.stability.summary import totals

ROOT = Path(__file__).parent.parent


def result(name: str) -> dict[str, Any]:
    return json.loads((ROOT / "configs" / name).read_text())


def readme_row(beginning: str) -> str:
    (row,) = [line for line in (ROOT / "README.md").read_text().splitlines() if line.startswith(f"| {beginning}")]
    return row.split("|")[2].strip()


def demo_psnrs(method: str) -> str:
    psnrs = [result(f"demo/seed-{seed}/demo.json")["methods"][method]["results"]["psnr"] for seed in (0, 1, 2)]
    return " / ".join(f"{psnr:.2f}" for psnr in psnrs)


def test_the_readme_quotes_the_committed_results():
    told = f"Random {demo_psnrs('vanilla-nerf')}, Edge + SE {demo_psnrs('edge-se-nerf')} dB"
    assert readme_row("demo") == told
    assert told in " ".join((ROOT / "README.md").read_text().split())
    quality = result("quality/result.json")
    assert quality["seed"] == 0
    assert quality["seconds"] <= 180
    assert readme_row("bricks") == f"{quality['results']['psnr']:.2f} dB after {quality['seconds']:.0f} s"
    bench = result("samplers/result.json")
    assert bench["pixels"] == 64_000_000
    assert readme_row("tables") == f"{bench['build_seconds']:.1f} s, {bench['bytes_per_pixel']:.2f} bytes a pixel"
    times = bench["milliseconds"]
    told = f"{times['edge_all_images']:.2f} ms from 100 images, {times['edge_one_image']:.2f} ms from one"
    assert readme_row("4096") == f"{told} (a flat searchsorted: {times['flat_searchsorted']:.2f} ms)"
    assert readme_row("training memory") == f"{bench['training_memory']['ratio']:.3f} x"
    for file, row in (("result", "SE's step"), ("paper", "the paper's network")):
        scoring = result(f"scoring/{file}.json")
        times, ranks = scoring["time_against_random"], scoring["rank_correlation_with_exact"]
        assert readme_row(row) == (
            f"{times['exact']:.2f}, {times['coarse']:.2f}, {times['memory']:.2f} x; ranks agree with the exact ones "
            f"{ranks['coarse']:.2f}, {ranks['memory']:.2f} after {scoring['learning']} steps"
        )


def test_cheap_squared_errors_come_at_randoms_price_on_the_papers_network():
    scoring = result("scoring/paper.json")
    assert scoring["time_against_random"]["coarse"] <= 1.2
    assert scoring["time_against_random"]["memory"] <= 1.05
    assert max(scoring["memory_against_random"][how] for how in ("coarse", "memory")) <= 1.05


def test_the_readme_quotes_the_bench_inside_nerfstudio():
    told = result("nerfstudio/result.json")
    readme = " ".join((ROOT / "README.md").read_text().split())
    for method, cost in told["costs"]["se_against_uniform"].items():
        ending = f"| {cost['seconds']:.2f} | {cost['bytes']:.2f} |"
        rows = [line for line in (ROOT / "README.md").read_text().splitlines() if line.endswith(ending)]
        assert any(f"`{method}`" in row for row in rows), method
    theirs, ours = (told["failures"][method] for method in ("vanilla-nerf", "edge-se-nerf"))
    assert sorted({run["seed"] for run in told["runs"]}) == list(range(10))
    assert (
        f"`vanilla-nerf` failed in {theirs['failed']} of {theirs['runs']} runs, "
        f"{theirs['at_background']} of them still at the background, "
        f"`edge-se-nerf` in {ours['failed']} of {ours['runs']}, {ours['at_background']} at the background; "
        f"mean PSNR {theirs['mean_psnr']:.2f} and {ours['mean_psnr']:.2f} dB"
    ) in readme


def of_table(number: int) -> list[dict[str, Any]]:
    return [run for run in result("paper/cpu/result.json")["runs"] if run["table"] == number]


def test_the_readme_quotes_the_papers_tables():
    for label, strategy in zip(LABELS, STRATEGIES, strict=True):
        fields = []
        for table in PAPERS:
            runs = [run for run in alike(of_table(table)) if run["strategy"] == strategy]
            bad = sum(map(failed, runs))
            assert {(run["scene"], run["seed"]) for run in runs} == set(product(SCENES, (0, 1, 2)))
            mean = f"{statistics.mean(run['psnr'] for run in runs):.2f}"
            fields.append(f"{mean}, {bad} of {len(runs)} failed" if bad else mean)
        assert f"| {label} | " + " | ".join(fields) + " |" in (ROOT / "README.md").read_text()


@pytest.mark.parametrize(
    ("label", "tables"),
    [
        ("nothing: Xavier weights, ReLU", (1, 2)),
        ("softplus density", (14, 15)),
        ("torch's initial weights", (7, 8)),
        ("torch's initial weights, `--reinit-dead True`", (17, 18)),
    ],
)
def test_the_readme_quotes_what_helps_random(label: str, tables: tuple[int, int]):
    told = []
    for table in tables:
        runs = [run for run in alike(of_table(table)) if run["strategy"] == "vanilla-nerf"]
        told.append(f"{sum(map(failed, runs))} of {len(runs)} failed")
    assert f"| {label} | " + " | ".join(told) + " |" in (ROOT / "README.md").read_text()


def test_the_readme_quotes_precrop_in_the_middle():
    runs = [run for run in of_table(16) if run["strategy"] == "precrop-nerf"]
    assert f"{sum(map(failed, runs))} of {len(runs)} runs fail" in " ".join((ROOT / "README.md").read_text().split())


def test_the_verdicts_are_what_the_committed_runs_say():
    told = result("paper/cpu/result.json")
    assert told["verdicts"] == json.loads(json.dumps(verdicts(told["runs"])))
    for claim in told["verdicts"]:
        assert f"| {claim['text']} | {claim['source']} | {claim['verdict']} |" in (ROOT / "README.md").read_text()


def test_the_readme_quotes_the_failures_of_auto():
    result_of_auto = result("schedule/result.json")
    told = failures(result_of_auto["runs"])
    assert told == result_of_auto["failures"]
    assert len({(run["table"], run["scene"]) for run in result_of_auto["runs"]}) == 28
    assert {run["seed"] for run in result_of_auto["runs"] if run["part"] == "failures"} == set(range(10))
    _, most = told["auto_interval"]
    assert (
        f"Of {told['pairs']} pairs Random failed in {told['random']}, `auto` in {told['auto']} (at most "
        f"{100 * most:.1f} % of runs like these, by the 95 % interval)"
    ) in " ".join((ROOT / "README.md").read_text().split())


def test_the_readme_quotes_auto_against_the_best_fixed_share():
    told = result("schedule/result.json")
    assert told["lengths"] == json.loads(json.dumps(lengths(told["runs"])))
    for row in told["lengths"]:
        assert row["low"] > -MARGIN, row["iterations"]
        difference = f"{row['mean']:+.2f} [{row['low']:+.2f}, {row['high']:+.2f}]"
        assert in_readme([f"{row['iterations']:,}", row["best"], difference])


MAPPED = ("vanilla-nerf", "revived", "precrop-nerf", "edge-se-nerf", "auto")


@pytest.mark.parametrize(
    "label",
    ["base", "f 1%", "f 30%", "off centre", "10 views", "black", "random", "textured", "softplus", "torch weights",
     "noise 1", "depth 8", "rate x3"],
)  # fmt: skip
def test_the_readme_quotes_the_map(label: str):
    told = result("stability/result.json")
    assert told["totals"] == json.loads(json.dumps(totals(told["runs"])))
    place = {(row["label"], row["strategy"]): row for row in told["totals"]}
    fields = [f"{place[label, name]['failures']} of {place[label, name]['runs']}" for name in MAPPED]
    assert f"| {label} | " + " | ".join(fields) + " |" in (ROOT / "README.md").read_text()


def test_the_readme_tells_how_many_of_the_map_failed():
    runs = result("stability/result.json")["runs"]
    lost = {name: sum(r["strategy"] == name and r["outcome"] != "learnt" for r in runs) for name in MAP_STRATEGIES}
    assert {sum(r["strategy"] == name for r in runs) for name in MAP_STRATEGIES} == {240}
    text = " ".join((ROOT / "README.md").read_text().split())
    for words in (
        f"Random and SE die almost everywhere, {lost['vanilla-nerf']} and {lost['se-nerf']} of 240 runs",
        f"what killed them goes on ({lost['revived']} failed)",
        f"not too small ({lost['precrop-nerf']})",
        f"Edge + SE loses {lost['edge-se-nerf']}:",
        f"with dead networks begun anew, {lost['auto']} failed: five",
    ):
        assert words in text, words
    small = [r for r in runs if r["strategy"] == "auto" and r["outcome"] != "learnt" and r.get("foreground", 1) <= 0.02]
    assert len(small) == 5


# -- the chart


def in_readme(fields: list[str]) -> bool:
    return f"| {' | '.join(fields)} |" in (ROOT / "README.md").read_text()


def test_the_readme_quotes_the_chart():
    told = result("chart/result.json")
    head, rows = rows_of(told["runs"])
    shown = head.index("failed") + 1
    for group in GROUPS:
        assert all(in_readme(row[:shown]) for row in rows[group]), group
    for name, _, _, *psnrs in rows_of_others(told["runs"], told["external"]):
        assert in_readme([name, *psnrs, ""]), name
    ends = {label: float(psnrs[-1]) for label, *psnrs, _ in (row[:shown] for row in rows["methods"])}
    (lean, at_end), *six = ends.items()
    best, best_end = max(six, key=lambda item: item[1])
    other, *_, other_end = max(rows_of_others(told["runs"], told["external"]), key=lambda row: float(row[-1]))
    assert (
        f"{lean} has {rows['methods'][0][1]} dB after 3 CPU seconds and {at_end:.2f} dB within its minute, in which "
        f"the best of the six strategies ({best}) comes to {best_end:.2f} dB and the best of the other programs "
        f"({other}) to {other_end} dB"
    ) in " ".join((ROOT / "README.md").read_text().split())
    assert "medians of seeds 0, 1, 2" in (ROOT / "README.md").read_text()
    end = {(run["variant"], run["scene"]): f"{run['psnr']:.2f}" for run in told["runs"] if run["seed"] == 0}
    assert (
        f"Without the hull drums ends at {end['no-hull', 'drums']} dB and mic at {end['no-hull', 'mic']}, seed 0; with "
        f"it at {end['lean', 'drums']} and {end['lean', 'mic']}."
    ) in " ".join((ROOT / "README.md").read_text().split())
    _, scenes = rows_of_scenes(told["runs"], told["external"])
    assert all(in_readme(row) for row in scenes)
    dead = {row[0]: sum(end.startswith("(") for end in row[1:]) for row in scenes}
    assert {name for name, count in dead.items() if count} == {"Random", "SE"}
    assert dead["Random"] == dead["SE"] == 6


def test_the_readme_quotes_lean_nerf_without_alpha_on_every_scene():
    runs = result("lean-no-hull/result.json")["runs"]
    assert {run["variant"] for run in runs} == {"no-hull"}
    assert {(run["scene"], run["seed"]) for run in runs} == set(product(SCENES, range(10)))
    psnrs = [run["psnr"] for run in runs]
    assert (
        f"of {len(runs)} such trainings {sum(run['outcome'] != 'learnt' for run in runs)} failed, with "
        f"{statistics.mean(psnrs):.2f} dB on average and {min(psnrs):.2f} at least."
    ) in " ".join((ROOT / "README.md").read_text().split())


def test_the_readme_says_what_edges_and_split_cells_are_worth_without_a_hull():
    runs = result("chart/result.json")["runs"]

    def ended(name: str, scene: str, seconds: float = float("inf")) -> float:
        mine = [run for run in runs if (run["variant"], run["scene"]) == (name, scene)]
        return over_scenes(mine, seconds) or float("nan")

    def ahead(*where: Any) -> float:
        return ended("no-hull", *where) - ended("no-hull-uniform", *where)

    text = " ".join((ROOT / "README.md").read_text().split())
    assert (
        f"ahead at first, by {ahead('bricks', 3):.1f} dB after 3 s on bricks and {ahead('mic', 3):.1f} on mic, and "
        f"behind after the minute, by {-ahead('bricks'):.1f} and {-ahead('mic'):.1f} dB (on drums by "
        f"{-ahead('drums'):.1f})"
    ) in text
    both = comparable([run for run in runs if run["variant"] in ("lean", "lean-se")])
    assert {run["scene"] for run in both["lean"]} == {*SCENES}
    gains = {look: (over_scenes(both["lean-se"], look) or 0) - (over_scenes(both["lean"], look) or 0) for look in LOOKS}
    assert all(abs(gain) < 0.1 for look, gain in gains.items() if look >= 5)
    assert all(-0.35 < gain < -0.1 for look, gain in gains.items() if look <= 3)
    assert "on the seven scenes remembered errors are level from 5 s on, and a little behind before" in text
    begun = ended("lean", "bricks", 3) - ended("no-density", "bricks", 3)
    assert f"with a hull that is {begun:.1f} dB after 3 s" in text
    assert f"worth {ended('no-hull', 'bricks') - ended('economy-off', 'bricks'):.1f} dB" in text


def test_every_variant_is_on_the_chart_with_three_seeds():
    told = result("chart/result.json")
    for name in VARIANTS:
        runs = [run for run in told["runs"] if (run["variant"], run["scene"]) == (name, "bricks")]
        assert sorted(run["seed"] for run in runs) == [0, 1, 2], name


def test_the_readme_says_what_six_frequencies_are_worth():
    runs = result("chart/result.json")["runs"]
    both = comparable([run for run in runs if run["variant"] in ("lean", "frequencies-4")])
    known = {(run["scene"], run["seed"]) for run in both["lean"]}
    assert known == set(product(("bricks", "drums", "mic"), (0, 1, 2)))
    pairs = [(over_scenes(both["lean"], look), over_scenes(both["frequencies-4"], look)) for look in LOOKS]
    ahead = [ours - theirs for ours, theirs in pairs if ours is not None and theirs is not None]
    assert min(ahead) > 0
    told = f"they are ahead at every look, by {min(ahead):.2f} to {max(ahead):.2f} dB"
    assert told in " ".join((ROOT / "README.md").read_text().split())


def test_the_readme_says_which_sizes_are_ahead_when():
    runs = [run for run in result("chart/result.json")["runs"] if run["scene"] == "bricks"]

    def ahead(name: str, seconds: float) -> float:
        ours, theirs = ([run for run in runs if run["variant"] == which] for which in ("lean", name))
        return (over_scenes(theirs, seconds) or 0) - (over_scenes(ours, seconds) or 0)

    assert all(ahead(name, 3) > 0 > ahead(name, 100) for name in ("width-32", "cells-1.6", "steps-1.5"))
    assert all(ahead(name, 3) < 0 < ahead(name, 100) < 0.1 for name in ("width-128", "features-16", "frequencies-8"))
    assert all(ahead(name, look) < 0 for name in ("cells-0.7", "depth-2", "rays-128") for look in (3, 7, 20, 60))


def test_lean_nerf_is_on_the_committed_charts_front():
    told = result("chart/result.json")
    assert told["front"] == front(told["runs"])
    assert dominating(told["runs"]) == []
    ahead = front([run for run in told["runs"] if VARIANTS[run["variant"]].group in ("methods", "scorings")])
    assert {row["best"] for row in ahead} == {"lean"}


@pytest.mark.parametrize(("seconds", "bar"), [(3, 26), (7, 28), (20, 31), (100, 34)])
def test_lean_nerf_is_as_fast_on_one_core_as_it_should_be_on_two(seconds: float, bar: float):
    told = result("chart/result.json")
    assert told["settings"] == {"seconds": 60, "threads": 1, "pixels": 100}
    runs = [run for run in told["runs"] if (run["variant"], run["scene"]) == ("lean", "bricks")]
    assert (over_scenes(runs, seconds) or 0) >= bar


def test_the_readme_quotes_lean_nerf_on_seven_scenes_and_of_ten_seeds():
    minute, short = (
        [run for run in result(name)["runs"] if run["variant"] == "lean"]
        for name in ("chart/result.json", "lean/result.json")
    )
    ends = {run["scene"]: run["psnr"] for run in minute if run["seed"] == 0}
    assert {*ends} == {*SCENES}
    assert statistics.mean(ends.values()) >= 32
    assert min(ends.values()) >= 28.5
    assert {(run["scene"], run["seed"]) for run in short} == set(product(SCENES, range(10)))
    failed_ones = sum(run["outcome"] != "learnt" for run in short)
    psnrs = [run["psnr"] for run in short]
    worst, best = (choose(ends, key=ends.__getitem__) for choose in (min, max))
    assert (
        f"On the seven scenes (seed 0, 60 CPU seconds) it ends at {statistics.mean(ends.values()):.2f} dB on average, "
        f"between {ends[worst]:.2f} ({worst}) and {ends[best]:.2f} ({best}); of {len(short)} trainings of 10 CPU "
        f"seconds, seeds 0 to 9 on each, {failed_ones} failed, with {statistics.mean(psnrs):.2f} dB on average and "
        f"{min(psnrs):.2f} at least."
    ) in " ".join((ROOT / "README.md").read_text().split())


def test_the_readme_quotes_the_dense_step():
    seconds = result("step/result.json")["medians"]
    theirs = f"one step takes {seconds['theirs']:.1f} s on both cores here"
    ours = f"and the same step of `vanilla-nerf`, size `paper`, {seconds['ours']:.1f} s"
    assert f"{theirs}, {ours}" in " ".join((ROOT / "README.md").read_text().split())


@pytest.mark.slow
@pytest.mark.parametrize("cell", [Cell(1, "mic", "edge-nerf", 0), Cell(4, "mic", "vanilla-nerf", 0)])
def test_a_cell_of_the_papers_tables_comes_out_again(cell: Cell, tmp_path: Path):
    """On whatever machine this is: rounding grows with the steps, so the bound is what another seed would move it."""
    data_of = synthetic_scenes(PRESETS["cpu"], [cell], tmp_path)
    again = run_cell(cell, PRESETS["cpu"], data_of(cell), tmp_path / "runs")
    (told,) = [run for run in result("paper/cpu/result.json")["runs"] if asdict(cell).items() <= run.items()]
    assert (again["outcome"], again["steps"]) == (told["outcome"], told["steps"])
    assert abs(again["psnr"] - told["psnr"]) < 0.5
    assert math.isclose(again["loss"][0], told["loss"][0], rel_tol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("method", demo.METHODS)
def test_the_demo_comes_out_again(method: str, tmp_path: Path):
    """Its first 40 steps, on whatever machine this is: rounding grows with the steps, so the bound is loose."""
    trainer = demo.demo_trainer(method, demo.make_demo_scene(tmp_path), tmp_path / "runs", seed=0)
    losses = [trainer.train_iteration(step) for step in range(41)]
    for line in result("demo/seed-0/demo.json")["methods"][method]["loss"][:5]:
        assert math.isclose(losses[line["step"]], line["loss"], rel_tol=0.02), line
