"""Every claim of the paper, and some of ours, tested by the runs: supported, not supported, or undecided.

A comparison pairs runs of the same scene and seed. What a failure is, `bench.outcomes` says.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from edge_se_sampler.bench.outcomes import failed
from edge_se_sampler.bench.paper.trials import PAPER_TABLES
from edge_se_sampler.bench.runner import Run
from edge_se_sampler.bench.statistics import PairedDifference, paired_difference
from edge_se_sampler.bench.strategies import LABELS

MIN_SEEDS = 3
"""Runs of a scene that it takes to say that most of them fail."""
MIN_DIFFERENCE = 0.3
"""dB: a smaller difference does not matter. An undecided claim needs more runs until they could show this one."""

RANDOM, SE, EDGE, EDGE_SE = "vanilla-nerf", "se-nerf", "edge-nerf", "edge-se-nerf"
PRECROP, PRECROP_SE = "precrop-nerf", "precrop-se-nerf"
WITH_SE = {RANDOM: SE, PRECROP: PRECROP_SE, EDGE: EDGE_SE}

Arm = tuple[int, str]  # table, strategy
Kind = Literal["better", "not inferior", "prevents failures"]
Verdict = Literal["supported", "not supported", "undecided", "nothing to compare"]


@dataclass(frozen=True)
class Comparison:
    """An arm against a baseline, or that difference minus the difference of a second such pair."""

    label: str
    arm: Arm
    baseline: Arm
    second_pair: tuple[Arm, ...] = ()
    measure: str = "psnr"


@dataclass(frozen=True)
class Claim:
    """Is supported if each of its comparisons is that has anything to compare.

    "better": the interval lies above 0. "not inferior": it lies above -0.3 dB, and there are no more failures.
    "prevents failures": no run fails on a scene where most of the baseline's do.
    """

    text: str
    source: str
    kind: Kind
    comparisons: tuple[Comparison, ...]


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
    """What the runs say of a claim."""

    claim: Claim
    rows: list[ComparedRuns]

    @property
    def verdict(self) -> Verdict:
        """The worst of its comparisons'."""
        verdicts = {row.verdict for row in self.rows}
        ordered: tuple[Verdict, ...] = ("not supported", "undecided", "supported", "nothing to compare")
        return next(verdict for verdict in ordered if verdict in verdicts)


def _against(arm: str, baseline: str) -> str:
    return f"{LABELS[arm]} against {LABELS[baseline]}"


def _in_tables(tables: tuple[int, ...], arm: str, baseline: str, measure: str = "psnr") -> tuple[Comparison, ...]:
    label, note = _against(arm, baseline), " (edge band)" if measure == "edge_band_psnr" else ""
    return tuple(Comparison(f"{label}, table {n}{note}", (n, arm), (n, baseline), measure=measure) for n in tables)


def _gain_of_few_views(table: int, arm: str, baseline: str) -> Comparison:
    label = f"{_against(arm, baseline)}: table {table} against table 1"
    return Comparison(label, (table, arm), (table, baseline), ((1, arm), (1, baseline)))


def _random_with(what: str, table: int, baseline_table: int) -> Comparison:
    label = f"Random with {what}, table {table} against {baseline_table}"
    return Comparison(label, (table, RANDOM), (baseline_table, RANDOM))


CLAIMS = (
    Claim(
        "Where the object is centred, Edge is as stable as Precrop", "sections 4.2.1 and 4.3.1", "not inferior",
        (*_in_tables((1, 3), EDGE, PRECROP), *_in_tables((1, 3), EDGE_SE, PRECROP_SE)),
    ),
    Claim(
        "Off centre, Edge trains where Precrop fails", "sections 4.2.2 and 4.3.2", "prevents failures",
        (*_in_tables((2, 4), EDGE, PRECROP), *_in_tables((2, 4), EDGE_SE, PRECROP_SE)),
    ),
    Claim(
        "SE raises PSNR whatever the early phase, at equal steps", "section 4.2.1", "better",
        tuple(row for early, late in WITH_SE.items() for row in _in_tables(tuple(PAPER_TABLES), late, early)),
    ),
    Claim(
        "SE raises PSNR whatever the early phase, at equal time", "ours", "better",
        tuple(
            Comparison(f"{_against(late, early)}, table {n + 8} against {n}", (n + 8, late), (n, early))
            for early, late in WITH_SE.items()
            for n in PAPER_TABLES
        ),
    ),
    Claim(
        "With few views, Edge gains more over Precrop", "section 4.3.1", "better",
        tuple(_gain_of_few_views(table, EDGE, PRECROP) for table in (3, 5)),
    ),
    Claim(
        "With few views, SE gains more", "abstract", "better",
        tuple(_gain_of_few_views(table, EDGE_SE, EDGE) for table in (3, 5)),
    ),
    Claim(
        "Sobel edges are better than Laplacian ones", "section 4.1.4", "better",
        (Comparison("Sobel against Laplacian, table 1 against 13", (1, EDGE), (13, EDGE)),),
    ),
    Claim(
        "Edge regions get sharper with Edge than with Precrop", "section 5", "better",
        _in_tables((1, 3), EDGE, PRECROP, measure="edge_band_psnr"),
    ),
    Claim(
        "Precrop fails because of where the object is, not because it is small", "ours", "prevents failures",
        (Comparison("Precrop, small and centred against off centre, table 16 against 2", (16, PRECROP), (2, PRECROP)),),
    ),
    Claim(
        "A softplus density alone keeps Random from failing", "ours", "prevents failures",
        tuple(_random_with("softplus against ReLU", *pair) for pair in ((14, 1), (15, 2))),
    ),
    Claim(
        "Reinitialising dead networks keeps Random from failing", "ours", "prevents failures",
        tuple(_random_with("dead networks reinitialised", *pair) for pair in ((17, 7), (18, 8))),
    ),
)  # fmt: skip


def evaluate_claims(runs: list[Run]) -> list[ClaimVerdict]:
    """What the runs say of every claim for which there are pairs of runs."""
    by_key = {(run["table"], run["strategy"], run["scene"], run["seed"]): run for run in runs}
    verdicts = []
    for claim in CLAIMS:
        rows = [row for comparison in claim.comparisons if (row := _compare(comparison, claim.kind, by_key))]
        if rows:
            verdicts.append(ClaimVerdict(claim, rows))
    return verdicts


def _compare(comparison: Comparison, kind: Kind, by_key: dict[Any, Run]) -> ComparedRuns | None:
    arms = (comparison.arm, comparison.baseline, *comparison.second_pair)
    scene_seeds = sorted((scene, seed) for (table, name, scene, seed) in by_key if (table, name) == comparison.arm)
    groups = [[by_key[arm + scene_seed] for arm in arms if arm + scene_seed in by_key] for scene_seed in scene_seeds]
    pairs = [runs for runs in groups if len(runs) == len(arms) and all(run[comparison.measure] for run in runs)]
    if not pairs:
        return None
    failures, baseline_failures = (sum(failed(runs[i]) for runs in pairs) for i in (0, 1))
    informative = [runs for runs in pairs if not _both_failed(runs)]
    difference = paired_difference((runs[0]["scene"], _difference(runs, comparison.measure)) for runs in informative)
    if kind == "prevents failures":
        verdict = _prevented(pairs)
    elif not informative:
        verdict = "nothing to compare"
    else:
        verdict = _judge_interval(kind, difference)
        if kind == "not inferior" and failures > baseline_failures and verdict == "supported":
            verdict = "undecided"
    return ComparedRuns(comparison, difference, len(pairs), failures, baseline_failures, verdict)


def _both_failed(runs: list[Run]) -> bool:
    """Two failed runs show the same background: that says nothing about how good either way of sampling is."""
    return any(failed(run) and failed(baseline) for run, baseline in zip(runs[::2], runs[1::2], strict=True))


def _difference(runs: list[Run], measure: str) -> float:
    values = [run[measure] for run in runs]
    return values[0] - values[1] - (values[2] - values[3] if values[2:] else 0.0)


def _judge_interval(kind: Kind, difference: PairedDifference) -> Verdict:
    if difference.low is None or difference.high is None or difference.detectable is None:
        return "undecided"
    bound = -MIN_DIFFERENCE if kind == "not inferior" else 0.0
    if difference.low > bound:
        return "supported"
    if difference.high <= bound or (kind == "better" and difference.detectable < MIN_DIFFERENCE):
        return "not supported"
    return "undecided"


def _prevented(pairs: list[list[Run]]) -> Verdict:
    """On the scenes where most of the baseline's runs fail: does any of the arm's?"""
    by_scene: dict[str, list[tuple[bool, bool]]] = {}
    for run, baseline in pairs:
        by_scene.setdefault(run["scene"], []).append((failed(run), failed(baseline)))
    hard = [
        outcomes
        for outcomes in by_scene.values()
        if len(outcomes) >= MIN_SEEDS and 2 * sum(baseline for _, baseline in outcomes) > len(outcomes)
    ]
    if not hard:
        return "undecided"
    return "not supported" if any(arm for outcomes in hard for arm, _ in outcomes) else "supported"
