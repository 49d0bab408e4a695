"""README.md of the test of the adaptive schedule."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edge_se_sampler.bench.outcomes import FAILURE_RULE, failed
from edge_se_sampler.bench.paper.published import SCENES
from edge_se_sampler.bench.paper.trials import TABLES
from edge_se_sampler.bench.report import decimals, describe_command, fill_template, markdown_table
from edge_se_sampler.bench.results import Run, read_result
from edge_se_sampler.bench.schedule.trials import CONFIGURATIONS, SHARES, best_share, psnrs_by_trial, score_shares
from edge_se_sampler.bench.statistics import PairedDifference, format_difference, paired_difference, wilson_interval

MARGIN = 0.2
"""dB: the adaptive schedule is not inferior if its interval stays above minus this."""


@dataclass(frozen=True)
class LengthComparison:
    """The adaptive schedule against the best fixed share of a planned length."""

    iterations: int
    scores: dict[str, float]
    """Fixed share -> mean PSNR on the seeds of selection."""
    best: str
    difference: PairedDifference
    """Of PSNR, over the scenes and seeds that are reported."""

    @property
    def not_inferior(self) -> bool | None:
        """None: too few runs."""
        return None if self.difference.low is None else self.difference.low > -MARGIN


def describe(folder: Path) -> str:
    """The README.md of a folder with a result.json."""
    result = read_result(folder / "result.json")
    parts = _describe_failures(result["runs"]) | _describe_lengths(compare_lengths(result["runs"]))
    return fill_template(__file__, folder, **parts, reproduce=describe_command(result))


def pair_failures(runs: list[Run]) -> dict[tuple[int, str, int], tuple[bool, bool]]:
    """(table, scene, seed) -> whether Random failed and whether the adaptive schedule did, where both were trained."""
    failures: dict[str, dict[tuple[int, str, int], bool]] = {"random": {}, "adaptive": {}}
    for run in runs:
        if run["part"] == "failures":
            failures[run["arm"]][run["table"], run["scene"], run["seed"]] = failed(run)
    random, adaptive = failures.values()
    return {key: (random[key], adaptive[key]) for key in sorted(random.keys() & adaptive.keys())}


def compare_lengths(runs: list[Run]) -> list[LengthComparison]:
    """Of every planned length: the share selected on other seeds, and the adaptive schedule's difference from it."""
    comparisons = []
    for length, scores in score_shares(runs).items():
        psnrs, best = psnrs_by_trial(runs, length), best_share(scores)
        differences = [
            (f"{table} {scene}", psnr - psnrs[best, table, scene, seed])
            for (arm, table, scene, seed), psnr in sorted(psnrs.items())
            if arm == "adaptive" and (best, table, scene, seed) in psnrs
        ]
        if differences:
            comparisons.append(LengthComparison(length, scores, best, paired_difference(differences)))
    return comparisons


def _describe_failures(runs: list[Run]) -> dict[str, Any]:
    pairs = pair_failures(runs)
    if not pairs:
        return {}
    random, adaptive = np.sum([*pairs.values()], axis=0)
    low, high = wilson_interval(int(adaptive), len(pairs))
    trained = [run for run in runs if run["part"] == "failures"]
    rows = []
    for table in CONFIGURATIONS:
        by_scene = [[pair for key, pair in pairs.items() if key[:2] == (table, scene)] for scene in SCENES]
        rows.append([TABLES[table].title, *map(_count_failures, by_scene)])
    counts = {"pairs": len(pairs), "random": random, "adaptive": adaptive, "low": low, "high": high}
    return counts | {
        "iterations": trained[0]["iterations"],
        "failure_rule": FAILURE_RULE,
        "reinitialized": sum(run["reinitialized"] > 0 for run in trained),
        "failures": markdown_table(["", *SCENES], rows),
    }


def _count_failures(pairs: list[tuple[bool, bool]]) -> str:
    return f"{' / '.join(str(sum(arm)) for arm in zip(*pairs, strict=True))} of {len(pairs)}" if pairs else "–"


def _describe_lengths(comparisons: list[LengthComparison]) -> dict[str, Any]:
    if not comparisons:
        return {}
    verdicts = {True: "yes", False: "no", None: "too few runs"}
    rows = [
        [
            f"{row.iterations:,}",
            *(decimals(row.scores[share]) for share in SHARES),
            row.best,
            format_difference(row.difference),
            str(row.difference.runs),
            verdicts[row.not_inferior],
        ]
        for row in comparisons
    ]
    head = ["iterations", *SHARES, "best", "adaptive against it", "pairs", "not inferior"]
    return {"margin": MARGIN, "comparisons": markdown_table(head, rows)}
