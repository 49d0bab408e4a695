"""README.md and picture of the test of the adaptive schedule."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edge_se_sampler.bench.outcomes import FAILURE_RULE, failed
from edge_se_sampler.bench.paper.published import SCENES
from edge_se_sampler.bench.paper.trials import TABLES
from edge_se_sampler.bench.report import describe_command, fill_template, markdown_table
from edge_se_sampler.bench.runner import Run, read_result
from edge_se_sampler.bench.schedule.trials import CONFIGURATIONS, SHARES, best_share, psnrs_by_trial, score_shares
from edge_se_sampler.bench.statistics import PairedDifference, format_difference, paired_difference, wilson_interval
from edge_se_sampler.engine.figures import require_pyplot, save_figure, style_axes

MARGIN = 0.2
"""dB: the adaptive schedule is not inferior if its interval stays above minus this."""


@dataclass(frozen=True)
class LengthComparison:
    """The adaptive schedule against the best fixed share of a planned length."""

    iterations: int
    scores: dict[str, float]
    """Fixed share -> mean PSNR on the seeds of selection."""
    best: str
    differences: list[float]
    """Of PSNR, of every scene and seed that is reported."""
    summary: PairedDifference

    @property
    def not_inferior(self) -> bool | None:
        """None: too few runs."""
        return None if self.summary.low is None else self.summary.low > -MARGIN


def draw(folder: Path, workplace: Path | None) -> None:
    """Draw lengths.png, if there are runs for it."""
    if comparisons := compare_lengths(read_result(folder / "result.json")["runs"]):
        save_figure(_draw_lengths(comparisons), folder / "lengths.png")


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
            values = [difference for _, difference in differences]
            comparisons.append(LengthComparison(length, scores, best, values, paired_difference(differences)))
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
        [f"{c.iterations:,}", c.best, format_difference(c.summary), str(c.summary.runs), verdicts[c.not_inferior]]
        for c in comparisons
    ]
    head = ["iterations", "best fixed share", "adaptive against it", "pairs", "not inferior"]
    return {"shares": ", ".join(SHARES), "margin": MARGIN, "comparisons": markdown_table(head, rows)}


def _draw_lengths(comparisons: list[LengthComparison]) -> Any:
    """PSNR by fixed share, and the adaptive schedule against the best one: a color for each planned length, a dot for
    each pair."""
    figure, (left, right) = require_pyplot().subplots(1, 2, figsize=(9.5, 3.4))
    for i, row in enumerate(comparisons):
        color, mean = f"C{i}", row.summary.mean
        reach = 0 if row.summary.high is None else row.summary.high - mean
        below = [row.scores[share] - row.scores[row.best] for share in SHARES]
        left.plot(SHARES, below, "o-", color=color, ms=4, label=f"{row.iterations:,}")
        dots = i + np.linspace(-0.15, 0.15, len(row.differences))
        right.plot(dots, row.differences, ".", color=color, ms=5, alpha=0.6)
        right.errorbar(i + 0.28, mean, reach, fmt="_", color=color, lw=3, ms=12, mew=2)
    left.set(xlabel="fixed share of the iterations", ylabel="PSNR below the best share [dB]")
    left.set_title("Fixed early phase (seeds of selection)", fontsize=10)
    left.legend(title="planned iterations", fontsize=7, title_fontsize=7, frameon=False)
    right.axhline(-MARGIN, color="black", lw=0.8, ls="--")
    right.axhline(0, color="black", lw=0.8)
    right.text(-0.4, -MARGIN, "not inferior above", fontsize=7, va="bottom")
    right.set_xticks(range(len(comparisons)), [f"{row.iterations:,}\nagainst {row.best}" for row in comparisons])
    right.set(xlabel="planned iterations", ylabel="adaptive - best share [dB]")
    right.set_title("Adaptive against the best one (other seeds)", fontsize=10)
    style_axes(left, right)
    figure.tight_layout()
    return figure
