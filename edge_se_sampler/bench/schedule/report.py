"""README.md and picture of the test of the adaptive schedule."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edge_se_sampler.bench.outcomes import FAILURE_RULE, failed
from edge_se_sampler.bench.paper.published import SCENES
from edge_se_sampler.bench.paper.trials import TABLES
from edge_se_sampler.bench.runner import Run, read_result
from edge_se_sampler.bench.schedule.trials import CONFIGURATIONS, SHARES, best_shares, score_shares, selection_seeds
from edge_se_sampler.bench.statistics import PairedDifference, format_difference, paired_difference, wilson_interval
from edge_se_sampler.bench.tables import describe_command, markdown_table
from edge_se_sampler.engine.figures import require_pyplot, save_figure

MARGIN = 0.2
"""dB: the adaptive schedule is not inferior if its interval stays above minus this."""

QUESTION = """# The adaptive schedule

Edge + SE draws pixels by edge strength at first (the early phase) and by squared error later. The paper ends the early
phase after a tenth of the iterations. Under `schedule adaptive` the sampler decides by the errors of the pixels that
it trains on: edge sampling lasts until the object is learnt and edges no longer find much larger errors than uniform
pixels; it begins again when the object is lost, or edges find larger errors again. It knows no number of iterations,
and does the same in a short and in a long training.

Two questions. Does any training fail under it, where dead networks (no density anywhere, hence no gradient) are
reinitialised too (`--reinit-dead True`)? And is it as good as an early phase whose length was chosen well?"""


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
    """Draw lengths.png, if there are runs for it.

    Raises:
        InputError: the result cannot be read, matplotlib is missing, or the file cannot be written.
    """
    comparisons = compare_lengths(read_result(folder / "result.json")["runs"])
    if comparisons:
        save_figure(_draw_lengths(comparisons), folder / "lengths.png")


def describe(folder: Path) -> str:
    """The README.md of a folder with a result.json.

    Raises:
        InputError: the result cannot be read.
    """
    result = read_result(folder / "result.json")
    runs = result["runs"]
    parts = [QUESTION, *_describe_failures(runs), *_describe_lengths(compare_lengths(runs))]
    if (folder / "lengths.png").exists():
        parts.append("![PSNR by fixed share, and the adaptive schedule against the best one](lengths.png)")
    return "\n\n".join([*parts, "## Reproduce", describe_command(result)]) + "\n"


def pair_failures(runs: list[Run]) -> dict[tuple[int, str, int], tuple[bool, bool]]:
    """(table, scene, seed) -> whether Random failed and whether the adaptive schedule did, where both were trained."""
    outcomes = {
        (run["table"], run["scene"], run["seed"], run["arm"]): failed(run) for run in runs if run["part"] == "failures"
    }
    keys = sorted({key[:3] for key in outcomes})
    return {
        key: (outcomes[(*key, "random")], outcomes[(*key, "adaptive")])
        for key in keys
        if (*key, "random") in outcomes and (*key, "adaptive") in outcomes
    }


def compare_lengths(runs: list[Run]) -> list[LengthComparison]:
    """Of every planned length: the share selected on other seeds, and the adaptive schedule's difference from it."""
    comparisons, best = [], best_shares(runs)
    for length, scores in score_shares(runs).items():
        psnrs = {
            (run["table"], run["scene"], run["seed"], run["arm"]): run["psnr"]
            for run in runs
            if (run["part"], run["iterations"]) == ("lengths", length) and run["seed"] not in selection_seeds(length)
        }
        differences = [
            (f"{table} {scene}", psnr - psnrs[table, scene, seed, best[length]])
            for (table, scene, seed, arm), psnr in sorted(psnrs.items())
            if arm == "adaptive" and (table, scene, seed, best[length]) in psnrs
        ]
        if differences:
            values = [difference for _, difference in differences]
            comparisons.append(LengthComparison(length, scores, best[length], values, paired_difference(differences)))
    return comparisons


def _describe_failures(runs: list[Run]) -> list[str]:
    pairs = pair_failures(runs)
    if not pairs:
        return []
    random, adaptive = (sum(pair[arm] for pair in pairs.values()) for arm in (0, 1))
    low, high = (100 * bound for bound in wilson_interval(adaptive, len(pairs)))
    trained = [run for run in runs if run["part"] == "failures"]
    reinitialized = sum(run["reinitialized"] > 0 for run in trained)
    rows = []
    for table in CONFIGURATIONS:
        row = [TABLES[table].title]
        for scene in SCENES:
            of_both = [pair for key, pair in pairs.items() if key[:2] == (table, scene)]
            counts = [sum(pair[arm] for pair in of_both) for arm in (0, 1)]
            row.append(f"{counts[0]} / {counts[1]} of {len(of_both)}" if of_both else "–")
        rows.append(row)
    return [
        "## Failures",
        f"Each training is paired with one that draws its pixels uniformly (Random) from the same initial weights, "
        f"{trained[0]['iterations']} iterations. {FAILURE_RULE} Of {len(pairs)} pairs Random failed in {random}, the "
        f"adaptive schedule in {adaptive} (95 % Wilson interval of its failure rate: {low:.1f} to {high:.1f} %); in "
        f"{reinitialized} trainings a dead network was reinitialised. Failures of Random / of the adaptive schedule:",
        markdown_table(["", *SCENES], rows),
    ]


def _describe_lengths(comparisons: list[LengthComparison]) -> list[str]:
    if not comparisons:
        return []
    verdicts = {True: "yes", False: "no", None: "too few runs"}
    rows = [
        [
            f"{row.iterations:,}",
            row.best,
            format_difference(row.summary),
            str(row.summary.runs),
            verdicts[row.not_inferior],
        ]
        for row in comparisons
    ]
    longest = all(row.best == SHARES[-1] for row in comparisons)
    return [
        "## Against the best fixed length",
        "For each planned number of iterations, the share of them that an early phase of fixed length should last was "
        f"selected among {', '.join(SHARES)} on seeds that are not reported; then both were trained on others, on two "
        "scenes with the object in the centre and two off centre. PSNR of the adaptive schedule minus that of the best "
        f"fixed share, dB, with the 95 % interval; not inferior where that stays above -{MARGIN}:",
        markdown_table(["iterations", "best fixed share", "adaptive against it", "pairs", "not inferior"], rows),
        "The thresholds of the adaptive schedule were chosen on the first of the seeds of selection. After a first "
        "test one of them was chosen again, on that seed, and everything here was trained again."
        + (" The longest share is the best at every length: edges pay for longer than the paper's tenth." * longest),
    ]


def _draw_lengths(comparisons: list[LengthComparison]) -> Any:
    """PSNR by fixed share, and the adaptive schedule against the best one: a color for each planned length, a dot for
    each pair."""
    figure, (left, right) = require_pyplot().subplots(1, 2, figsize=(9.5, 3.4))
    for i, row in enumerate(comparisons):
        color = f"C{i}"
        below = [row.scores[share] - row.scores[row.best] for share in SHARES]
        left.plot(range(len(SHARES)), below, "o-", color=color, ms=4, label=f"{row.iterations:,}")
        dots = i + np.linspace(-0.15, 0.15, len(row.differences))
        right.plot(dots, row.differences, ".", color=color, ms=5, alpha=0.6)
        if row.summary.low is not None:
            right.vlines(i + 0.28, row.summary.low, row.summary.high, color=color, lw=3)
        right.plot(i + 0.28, row.summary.mean, "_", color=color, ms=12, mew=2)
    left.set_xticks(range(len(SHARES)), SHARES)
    left.set(xlabel="fixed share of the iterations", ylabel="PSNR below the best share [dB]")
    left.set_title("Fixed early phase (seeds of selection)", fontsize=10)
    left.legend(title="planned iterations", fontsize=7, title_fontsize=7, frameon=False)
    right.axhline(-MARGIN, color="black", lw=0.8, ls="--")
    right.axhline(0, color="black", lw=0.8)
    right.text(-0.4, -MARGIN, "not inferior above", fontsize=7, va="bottom")
    right.set_xticks(range(len(comparisons)), [f"{row.iterations:,}\nagainst {row.best}" for row in comparisons])
    right.set(xlabel="planned iterations", ylabel="adaptive - best share [dB]")
    right.set_title("Adaptive against the best one (other seeds)", fontsize=10)
    for axis in (left, right):
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    return figure
