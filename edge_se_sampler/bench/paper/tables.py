"""The trials' PSNR in the form of the paper's tables."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from edge_se_sampler.bench.outcomes import failed
from edge_se_sampler.bench.paper.published import SCENES, published
from edge_se_sampler.bench.paper.trials import PAPER_TABLES, TABLES
from edge_se_sampler.bench.runner import Run
from edge_se_sampler.bench.strategies import LABELS
from edge_se_sampler.bench.tables import markdown_table

LEGEND = (
    "Test PSNR in dB: mean ± standard deviation over the seeds that all strategies of the table have; ✗1/3: 1 of 3 "
    "runs failed. Small: the paper's number, on other data (bricks stands in for its Lego). CPU s: of training, median."
)


def psnr_tables(runs: list[Run]) -> list[str]:
    """Every table that has a run, under its title."""
    numbers = [number for number in TABLES if any(run["table"] == number for run in runs)]
    return [f"**Table {number}: {TABLES[number].title}**\n\n{psnr_table(number, runs)}" for number in numbers]


def psnr_table(number: int, runs: list[Run]) -> str:
    """A row for each strategy, a column for each scene."""
    runs = select_runs(runs, number)
    scenes = [scene for scene in SCENES if any(run["scene"] == scene for run in runs)]
    reference = published(number) if number in PAPER_TABLES else {}
    rows = []
    for strategy, label in LABELS.items():
        of_strategy = [run for run in runs if run["strategy"] == strategy]
        if of_strategy:
            fields = [
                _field([run for run in of_strategy if run["scene"] == scene], reference.get((strategy, scene)))
                for scene in scenes
            ]
            average = statistics.mean(reference[strategy, scene] for scene in scenes) if reference else None
            seconds = statistics.median(run["cpu_seconds"] for run in of_strategy)
            rows.append([label, *fields, _field(of_strategy, average), f"{seconds:.1f}"])
    return markdown_table(["", *scenes, "mean", "CPU s"], rows)


def summary_table(runs: list[Run]) -> str:
    """Mean PSNR and failures of every strategy in the paper's tables."""
    selected = {number: select_runs(runs, number) for number in PAPER_TABLES}
    head = ["", *(table.title for table in PAPER_TABLES.values())]
    rows = [
        [label, *(_summarize([run for run in selected[n] if run["strategy"] == strategy]) for n in PAPER_TABLES)]
        for strategy, label in LABELS.items()
    ]
    return markdown_table(head, rows)


def count_failures(runs: Sequence[Run]) -> str:
    """How many of some runs failed."""
    return f"{sum(map(failed, runs))} of {len(runs)} failed" if runs else "–"


def select_runs(runs: list[Run], table: int) -> list[Run]:
    """A table's runs of the seeds that all its strategies have; all its runs, if there is no such seed.

    Seeds that only some have were added for a verdict's sake: means over them would compare different seeds.
    """
    runs = [run for run in runs if run["table"] == table]
    strategies = {run["strategy"] for run in runs}
    seeds = [{run["seed"] for run in runs if run["strategy"] == strategy} for strategy in strategies]
    return [run for run in runs if run["seed"] in set.intersection(*seeds)] or runs


def mean_over_scenes(runs: list[Run]) -> float:
    """Mean PSNR; every scene counts alike, whatever its number of runs."""
    scenes = {run["scene"] for run in runs}
    return statistics.mean(statistics.mean(run["psnr"] for run in runs if run["scene"] == name) for name in scenes)


def _summarize(runs: list[Run]) -> str:
    if not runs:
        return "–"
    mean = f"{mean_over_scenes(runs):.2f}"
    return f"{mean}, {count_failures(runs)}" if any(map(failed, runs)) else mean


def _field(runs: list[Run], reference: float | None) -> str:
    """Of one scene's runs, or of all: then the scenes differ, and a deviation would say nothing of the seeds."""
    if not runs:
        return "–"
    text = f"{mean_over_scenes(runs):.2f}"
    if len(runs) > 1 and len({run["scene"] for run in runs}) == 1:
        text += f" ± {statistics.stdev(run['psnr'] for run in runs):.2f}"
    if failures := sum(map(failed, runs)):
        text += f" ✗{failures}/{len(runs)}"
    return text if reference is None else f"{text} <sub>{reference:.2f}</sub>"
