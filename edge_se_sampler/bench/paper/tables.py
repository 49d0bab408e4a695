"""The trials' PSNR in the form of the paper's tables."""

from __future__ import annotations

import statistics

from edge_se_sampler.bench.outcomes import failed
from edge_se_sampler.bench.paper.published import SCENES, published
from edge_se_sampler.bench.paper.trials import PAPER_TABLES
from edge_se_sampler.bench.runner import Run
from edge_se_sampler.bench.strategies import LABELS
from edge_se_sampler.bench.tables import markdown_table


def psnr_table(number: int, runs: list[Run]) -> str:
    """A row for each strategy, a column for each scene that has runs."""
    runs = select_runs(runs, number)
    scenes = [scene for scene in SCENES if any(run["scene"] == scene for run in runs)]
    reference = published(number) if number in PAPER_TABLES else {}
    rows = []
    for strategy, label in LABELS.items():
        of_strategy = [run for run in runs if run["strategy"] == strategy]
        if of_strategy:
            row = [label]
            for scene in scenes:
                of_scene = [run for run in of_strategy if run["scene"] == scene]
                row.append(format_psnr(of_scene, reference.get((strategy, scene))))
            average = statistics.mean(reference[strategy, scene] for scene in scenes) if reference else None
            seconds = statistics.median(run["cpu_seconds"] for run in of_strategy)
            rows.append([*row, format_psnr(of_strategy, average), f"{seconds:.1f}"])
    return markdown_table(["", *scenes, "mean", "CPU s"], rows)


def select_runs(runs: list[Run], table: int) -> list[Run]:
    """A table's runs of the seeds that all its strategies have; all its runs, if there is no such seed.

    Seeds that only some have were added for a verdict's sake: means over them would compare different seeds.
    """
    runs = [run for run in runs if run["table"] == table]
    strategies = {run["strategy"] for run in runs}
    seeds = [{run["seed"] for run in runs if run["strategy"] == strategy} for strategy in strategies]
    return [run for run in runs if run["seed"] in set.intersection(*seeds)] or runs


def format_psnr(runs: list[Run], reference: float | None = None) -> str:
    """Mean PSNR, in which every scene counts alike whatever its number of runs; of a single scene the deviation of the
    seeds; failures; the paper's number."""
    if not runs:
        return "–"
    by_scene: dict[str, list[float]] = {}
    for run in runs:
        by_scene.setdefault(run["scene"], []).append(run["psnr"])
    text = f"{statistics.mean(map(statistics.mean, by_scene.values())):.2f}"
    if len(by_scene) == 1 < len(runs):
        text += f" ± {statistics.stdev(run['psnr'] for run in runs):.2f}"
    if failures := sum(map(failed, runs)):
        text += f" ✗{failures}/{len(runs)}"
    return text if reference is None else f"{text} <sub>{reference:.2f}</sub>"
