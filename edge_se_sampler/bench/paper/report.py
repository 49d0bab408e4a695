"""README.md and pictures of the paper's experiments."""

from __future__ import annotations

import statistics
from collections.abc import Iterable
from pathlib import Path

from edge_se_sampler.bench.outcomes import FAILURE_RULE, failed
from edge_se_sampler.bench.paper.figures import draw_figures
from edge_se_sampler.bench.paper.published import LABELS, SCENES, published
from edge_se_sampler.bench.paper.trials import PAPER_TABLES, TABLES
from edge_se_sampler.bench.paper.verdicts import MIN_DIFFERENCE, ClaimVerdict, evaluate_claims
from edge_se_sampler.bench.report import decimals, describe_command, fill_template, markdown_table
from edge_se_sampler.bench.runner import Run, read_result
from edge_se_sampler.bench.statistics import format_difference

OTHER_CURES = {
    "Xavier weights, ReLU density": (1, 2),
    "softplus density": (14, 15),
    "torch's initial weights": (7, 8),
    "torch's initial weights, dead networks reinitialised": (17, 18),
}
"""What may keep Random from failing -> its tables, centred and off centre."""
COLUMNS = ["", "difference", "failures", "of the baseline", "pairs compared", "could show", "scenes above 0", "verdict"]


def draw(folder: Path, workplace: Path | None) -> None:
    """Draw the pictures; those with renderings only if the workplace has them."""
    draw_figures(read_result(folder / "result.json")["runs"], (workplace or folder) / "paper" / "views", folder)


def describe(folder: Path) -> str:
    """The README.md of a folder with a result.json and pictures."""
    result = read_result(folder / "result.json")
    runs, claims = result["runs"], evaluate_claims(result["runs"])
    numbers = [number for number in TABLES if any(run["table"] == number for run in runs)]
    tables = [f"**Table {number}: {TABLES[number].title}**\n\n{psnr_table(number, runs)}" for number in numbers]
    summary = [[label, *_psnr_cells(runs, strategy, PAPER_TABLES)] for strategy, label in LABELS.items()]
    cures = [[cure, *_psnr_cells(runs, "vanilla-nerf", numbers)] for cure, numbers in OTHER_CURES.items()]
    return fill_template(
        __file__,
        folder,
        num_runs=len(runs),
        **result["settings"],
        dead=sum(bool(run["dead_at_start"]) for run in runs),
        failure_rule=FAILURE_RULE,
        summary=markdown_table(["", *(table.title for table in PAPER_TABLES.values())], summary),
        claims=markdown_table(["claim", "whose", "verdict", "intervals"], map(_claim_row, claims)),
        other_cures=markdown_table(["Random with", "NeRF, all views, centred", "off centre"], cures),
        margin=MIN_DIFFERENCE,
        comparisons="\n\n".join(map(_describe_claim, claims)),
        tables="\n\n".join(tables),
        reproduce=describe_command(result),
    )


def psnr_table(number: int, runs: list[Run]) -> str:
    """A row for each strategy, a column for each scene that has runs."""
    runs = select_runs(runs, number)
    scenes = [scene for scene in SCENES if any(run["scene"] == scene for run in runs)]
    reference = published(number) if number in PAPER_TABLES else {}
    rows = []
    for strategy, label in LABELS.items():
        if of_strategy := [run for run in runs if run["strategy"] == strategy]:
            cells = [
                format_psnr([run for run in of_strategy if run["scene"] == scene], reference.get((strategy, scene)))
                for scene in scenes
            ]
            average = statistics.mean(reference[strategy, scene] for scene in scenes) if reference else None
            seconds = statistics.median(run["cpu_seconds"] for run in of_strategy)
            rows.append([label, *cells, format_psnr(of_strategy, average), f"{seconds:.1f}"])
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


def _psnr_cells(runs: list[Run], strategy: str, tables: Iterable[int]) -> list[str]:
    """A strategy's mean PSNR and failures in each table."""
    return [format_psnr([run for run in select_runs(runs, n) if run["strategy"] == strategy]) for n in tables]


def _claim_row(entry: ClaimVerdict) -> list[str]:
    known = [row.difference for row in entry.rows]
    above, below = sum((d.low or 0) > 0 for d in known), sum((d.high or 0) < 0 for d in known)
    intervals = f"{above} above, {below} below, of {len(known)}"
    return [entry.claim.text, entry.claim.source, f"**{entry.verdict}**", intervals]


def _describe_claim(entry: ClaimVerdict) -> str:
    rows = [
        [
            row.comparison.label,
            format_difference(row.difference),
            str(row.failures),
            str(row.baseline_failures),
            f"{row.difference.runs} of {row.pairs}",
            decimals(row.difference.detectable),
            f"{row.difference.scenes_better} of {row.difference.scenes}",
            row.verdict,
        ]
        for row in entry.rows
    ]
    title = f"**{entry.claim.text}** ({entry.claim.source}; {entry.claim.kind}): {entry.verdict}"
    return f"{title}\n\n{markdown_table(COLUMNS, rows)}"
