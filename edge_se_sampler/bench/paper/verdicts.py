"""Every claim of the paper, and some of ours, tested by the runs: supported, not supported, or undecided.

A comparison pairs runs of the same scene and seed. What a failure is, `bench.outcomes` says.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Literal, get_args

from edge_se_sampler.bench.outcomes import failed
from edge_se_sampler.bench.paper.published import LABELS
from edge_se_sampler.bench.paper.trials import PAPER_TABLES, Trial, runs_by_trial
from edge_se_sampler.bench.results import Run
from edge_se_sampler.bench.statistics import PairedDifference, paired_difference

MIN_SEEDS = 3
"""Runs of a scene that it takes to say that most of them fail."""
MIN_DIFFERENCE = 0.3
"""dB: a smaller difference does not matter. An undecided claim needs more runs until they could show this one."""

RANDOM, SE, EDGE, EDGE_SE = "vanilla-nerf", "se-nerf", "edge-nerf", "edge-se-nerf"
PRECROP, PRECROP_SE = "precrop-nerf", "precrop-se-nerf"
WITH_SE = {SE: RANDOM, PRECROP_SE: PRECROP, EDGE_SE: EDGE}
EDGE_AGAINST_PRECROP = {EDGE: PRECROP, EDGE_SE: PRECROP_SE}

Kind = Literal["better", "not inferior", "prevents failures"]
Verdict = Literal["not supported", "undecided", "supported", "nothing to compare"]
"""The worst first."""


@dataclass(frozen=True)
class Comparison:
    """A strategy in a table against a baseline, or that difference minus the one in another table."""

    arm: tuple[int, str]
    """Table and strategy."""
    baseline: tuple[int, str]
    minus_table: int | None = None
    measure: Literal["psnr", "edge_band_psnr"] = "psnr"

    @property
    def label(self) -> str:
        strategies = " against ".join(dict.fromkeys(LABELS[strategy] for _, strategy in (self.arm, self.baseline)))
        tables = " against ".join(dict.fromkeys(str(table) for table, _ in (self.arm, self.baseline)))
        minus = "" if self.minus_table is None else f", minus that in table {self.minus_table}"
        return f"{strategies}, table {tables}{minus}" + " (edge band)" * (self.measure == "edge_band_psnr")


@dataclass(frozen=True)
class Claim:
    """Is supported if each of its comparisons is that has anything to compare.

    "better": the interval lies above 0. "not inferior": it lies above -0.3 dB, and there are no more failures.
    "prevents failures": no run fails on a scene where most of the baseline's do; where none of them does, there is
    nothing to compare.
    """

    text: str
    source: str
    kind: Kind
    comparisons: Sequence[Comparison]


@dataclass(frozen=True)
class ComparedRuns:
    """What the runs say of a comparison."""

    comparison: Comparison
    difference: PairedDifference
    """Over the pairs in which not both runs failed."""
    pairs: int
    failures: int
    baseline_failures: int
    verdict: Verdict


@dataclass(frozen=True)
class ClaimVerdict:
    """What the runs say of a claim: of each of its comparisons."""

    claim: Claim
    rows: list[ComparedRuns]

    @property
    def verdict(self) -> Verdict:
        return next(verdict for verdict in get_args(Verdict) if any(row.verdict == verdict for row in self.rows))


def _compare_in(tables: Iterable[int], pairs: dict[str, str], **options: Any) -> list[Comparison]:
    """Every strategy against its baseline in every table."""
    return [Comparison((n, s), (n, baseline), **options) for s, baseline in pairs.items() for n in tables]


def _compare_tables(strategy: str, *tables: tuple[int, int]) -> list[Comparison]:
    """A strategy in a table against itself in another."""
    return [Comparison((table, strategy), (baseline, strategy)) for table, baseline in tables]


CLAIMS = (
    Claim("Where the object is centred, Edge is as stable as Precrop", "sections 4.2.1 and 4.3.1", "not inferior",
          _compare_in((1, 3), EDGE_AGAINST_PRECROP)),
    Claim("Off centre, Edge trains where Precrop fails", "sections 4.2.2 and 4.3.2", "prevents failures",
          _compare_in((2, 4), EDGE_AGAINST_PRECROP)),
    Claim("SE raises PSNR whatever the early phase, at equal steps", "section 4.2.1", "better",
          _compare_in(PAPER_TABLES, WITH_SE)),
    Claim("SE raises PSNR whatever the early phase, at equal time", "ours", "better",
          [Comparison((n + 8, late), (n, early)) for late, early in WITH_SE.items() for n in PAPER_TABLES]),
    Claim("With few views, Edge gains more over Precrop", "section 4.3.1", "better",
          _compare_in((3, 5), {EDGE: PRECROP}, minus_table=1)),
    Claim("With few views, SE gains more", "abstract", "better", _compare_in((3, 5), {EDGE_SE: EDGE}, minus_table=1)),
    Claim("Sobel edges are better than Laplacian ones", "section 4.1.4", "better", _compare_tables(EDGE, (1, 13))),
    Claim("Edge regions get sharper with Edge than with Precrop", "section 5", "better",
          _compare_in((1, 3), {EDGE: PRECROP}, measure="edge_band_psnr")),
    Claim("Precrop fails because of where the object is, not because it is small", "ours", "prevents failures",
          _compare_tables(PRECROP, (16, 2))),
    Claim("A softplus density alone keeps Random from failing", "ours", "prevents failures",
          _compare_tables(RANDOM, (14, 1), (15, 2))),
    Claim("Reinitialising dead networks keeps Random from failing", "ours", "prevents failures",
          _compare_tables(RANDOM, (17, 7), (18, 8))),
)  # fmt: skip


def evaluate_claims(runs: list[Run]) -> list[ClaimVerdict]:
    """What the runs say of every claim for which there are pairs of runs."""
    by_trial, verdicts = runs_by_trial(runs), []
    for claim in CLAIMS:
        compared = [_compare(comparison, claim.kind, by_trial) for comparison in claim.comparisons]
        if rows := [row for row in compared if row.pairs]:
            verdicts.append(ClaimVerdict(claim, rows))
    return verdicts


def _compare(comparison: Comparison, kind: Kind, by_trial: dict[Trial, Run]) -> ComparedRuns:
    arms = [comparison.arm, comparison.baseline]
    if comparison.minus_table is not None:
        arms += [(comparison.minus_table, strategy) for _, strategy in arms]
    pairs = []
    for trial in sorted(by_trial, key=lambda trial: (trial.scene, trial.seed)):
        if (trial.table, trial.strategy) == comparison.arm:
            runs = [by_trial.get(Trial(table, trial.scene, strategy, trial.seed)) for table, strategy in arms]
            if all(run is not None and run[comparison.measure] for run in runs):
                pairs.append(runs)
    failures, baseline_failures = (sum(failed(runs[i]) for runs in pairs) for i in (0, 1))
    # two failed runs show the same background: that says nothing about how good either way of sampling is
    informative = [
        runs for runs in pairs if not any(failed(a) and failed(b) for a, b in zip(runs[::2], runs[1::2], strict=True))
    ]
    signs = (1, -1, -1, 1)
    difference = paired_difference(
        (runs[0]["scene"], sum(sign * run[comparison.measure] for sign, run in zip(signs, runs, strict=False)))
        for runs in informative
    )
    if kind == "prevents failures":
        verdict = _judge_failures(pairs)
    elif not informative:
        verdict = "nothing to compare"
    else:
        verdict = _judge_interval(kind, difference)
        if kind == "not inferior" and failures > baseline_failures and verdict == "supported":
            verdict = "undecided"
    return ComparedRuns(comparison, difference, len(pairs), failures, baseline_failures, verdict)


def _judge_interval(kind: Kind, difference: PairedDifference) -> Verdict:
    if difference.low is None or difference.high is None or difference.detectable is None:
        return "undecided"
    bound = -MIN_DIFFERENCE if kind == "not inferior" else 0.0
    if difference.low > bound:
        return "supported"
    if difference.high <= bound or (kind == "better" and difference.detectable < MIN_DIFFERENCE):
        return "not supported"
    return "undecided"


def _judge_failures(pairs: list[list[Run]]) -> Verdict:
    """On the scenes where most of the baseline's runs fail: does any of the arm's? If none fails, there is
    nothing to prevent."""
    by_scene = groupby(pairs, lambda runs: runs[0]["scene"])
    failures = [[(failed(run), failed(baseline)) for run, baseline, *_ in group] for _, group in by_scene]
    hard = [f for f in failures if len(f) >= MIN_SEEDS and 2 * sum(baseline for _, baseline in f) > len(f)]
    if failures and all(len(f) >= MIN_SEEDS and not any(baseline for _, baseline in f) for f in failures):
        return "nothing to compare"
    if not hard:
        return "undecided"
    return "not supported" if any(arm for outcomes in hard for arm, _ in outcomes) else "supported"
