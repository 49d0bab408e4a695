"""Every claim of the paper, and some of ours, put to the runs: supported, not supported, or undecided.

A comparison pairs runs of the same scene and seed. What the rules call a failure is in `bench.outcome`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal

from edge_se_sampler.bench.paper.published import LABELS, STRATEGIES
from edge_se_sampler.bench.paper.trials import PAPERS
from edge_se_sampler.bench.statistics import paired_difference

SEEDS = 3
"""Fewer of a scene do not tell that it is hopeless."""
WORTH = 0.3
"""dB: a smaller difference is none; an undecided claim wants more runs until they could have shown this."""
LABEL: dict[str, str] = dict(zip(STRATEGIES, LABELS, strict=True))

Arm = tuple[int, str]  # table, strategy
Kind = Literal["better", "not worse", "rescues"]
Verdict = Literal["supported", "not supported", "undecided", "nothing to compare"]


@dataclass(frozen=True)
class Comparison:
    """`ours` against `theirs`, or that difference against another one."""

    label: str
    ours: Arm
    theirs: Arm
    against: tuple[Arm, Arm] | None = None
    measure: str = "psnr"


@dataclass(frozen=True)
class Claim:
    """Holds if every one of its comparisons does that has anything to compare.

    "better": the interval lies above 0. "not worse": it lies above -0.3 dB, and there are no more failures.
    "rescues": no run fails on a scene where most of the others' do.
    """

    text: str
    source: str
    kind: Kind
    comparisons: tuple[Comparison, ...]


def _in_tables(tables: tuple[int, ...], ours: str, theirs: str, **more: Any) -> tuple[Comparison, ...]:
    return tuple(Comparison(f"{_arms(ours, theirs)}, table {n}", (n, ours), (n, theirs), **more) for n in tables)


def _arms(ours: str, theirs: str) -> str:
    return f"{LABEL[ours]} against {LABEL[theirs]}"


WITH_SE = {"vanilla-nerf": "se-nerf", "precrop-nerf": "precrop-se-nerf", "edge-nerf": "edge-se-nerf"}
EDGE, PRECROP, EDGE_SE = "edge-nerf", "precrop-nerf", "edge-se-nerf"


def _gain(few: int, ours: str, theirs: str) -> Comparison:
    return Comparison(
        f"{_arms(ours, theirs)}: table {few} against table 1", (few, ours), (few, theirs), ((1, ours), (1, theirs))
    )


def _random_with(what: str, cured: int, plain: int) -> Comparison:
    label = f"Random with {what}, table {cured} against {plain}"
    return Comparison(label, (cured, "vanilla-nerf"), (plain, "vanilla-nerf"))


CLAIMS = (
    Claim(
        "Where the object is centred, Edge is as stable as Precrop",
        "sections 4.2.1 and 4.3.1",
        "not worse",
        _in_tables((1, 3), EDGE, PRECROP) + _in_tables((1, 3), EDGE_SE, "precrop-se-nerf"),
    ),
    Claim(
        "Off centre, Edge trains where Precrop fails",
        "sections 4.2.2 and 4.3.2",
        "rescues",
        _in_tables((2, 4), EDGE, PRECROP) + _in_tables((2, 4), EDGE_SE, "precrop-se-nerf"),
    ),
    Claim(
        "SE raises PSNR whatever the early phase, at equal steps",
        "section 4.2.1",
        "better",
        tuple(row for early, late in WITH_SE.items() for row in _in_tables(tuple(PAPERS), late, early)),
    ),
    Claim(
        "SE raises PSNR whatever the early phase, at equal time",
        "ours",
        "better",
        tuple(
            Comparison(f"{_arms(late, early)}, table {n + 8} against {n}", (n + 8, late), (n, early))
            for early, late in WITH_SE.items()
            for n in PAPERS
        ),
    ),
    Claim(
        "With few views, Edge gains more over Precrop",
        "section 4.3.1",
        "better",
        (_gain(3, EDGE, PRECROP), _gain(5, EDGE, PRECROP)),
    ),
    Claim(
        "With few views, SE gains more",
        "abstract",
        "better",
        (_gain(3, EDGE_SE, EDGE), _gain(5, EDGE_SE, EDGE)),
    ),
    Claim(
        "Sobel edges are better than Laplacian ones",
        "section 4.1.4",
        "better",
        (Comparison("Sobel against Laplacian, table 1 against 13", (1, EDGE), (13, EDGE)),),
    ),
    Claim(
        "Edge regions get sharper with Edge than with Precrop",
        "section 5",
        "better",
        _in_tables((1, 3), EDGE, PRECROP, measure="edge_band_psnr"),
    ),
    Claim(
        "It is the place that defeats Precrop, not how small the object is",
        "ours",
        "rescues",
        (Comparison("Precrop in the middle against off centre, table 16 against 2", (16, PRECROP), (2, PRECROP)),),
    ),
    Claim(
        "A softplus density alone cures Random",
        "ours",
        "rescues",
        tuple(_random_with("softplus against ReLU", cured, plain) for cured, plain in ((14, 1), (15, 2))),
    ),
    Claim(
        "Beginning dead networks anew cures Random",
        "ours",
        "rescues",
        tuple(_random_with("dead networks anew against not", cured, plain) for cured, plain in ((17, 7), (18, 8))),
    ),
)


def verdicts(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What the runs say of every claim that they have something to say of.

    Returns:
        text, source, verdict and `comparisons`: label, difference (dB; `PairedDifference`), failures of both
        arms, verdict.
    """
    place = {(run["table"], run["strategy"], run["scene"], run["seed"]): run for run in runs}
    told = []
    for claim in CLAIMS:
        rows = [row for comparison in claim.comparisons for row in _compared(comparison, claim.kind, place)]
        if rows:
            verdict = _all([row["verdict"] for row in rows])
            told.append({"text": claim.text, "source": claim.source, "verdict": verdict, "comparisons": rows})
    return told


def _all(parts: list[Verdict]) -> Verdict:
    parts = [part for part in parts if part != "nothing to compare"] or ["nothing to compare"]
    if "not supported" in parts:
        return "not supported"
    return "undecided" if "undecided" in parts else parts[0]


def _compared(comparison: Comparison, kind: Kind, place: dict[Any, dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The comparison's row, if there are pairs."""
    arms = [comparison.ours, comparison.theirs, *(comparison.against or ())]
    where = sorted((scene, seed) for (table, name, scene, seed) in place if (table, name) == comparison.ours)
    groups = [[place[arm + at] for arm in arms if arm + at in place] for at in where]
    pairs = [pair for pair in groups if len(pair) == len(arms) and all(run[comparison.measure] for run in pair)]
    if not pairs:
        return
    failures = [sum(failed(pair[i]) for pair in pairs) for i in (0, 1)]
    telling = [pair for pair in pairs if not _both_failed(pair)]
    difference = paired_difference([(pair[0]["scene"], _difference(pair, comparison.measure)) for pair in telling])
    if kind == "rescues":
        verdict = _rescued(pairs)
    elif not telling:
        verdict = "nothing to compare"
    else:
        verdict = _judged(kind, difference.low, difference.high, difference.detectable)
        if kind == "not worse" and failures[0] > failures[1]:
            verdict = "undecided" if verdict == "supported" else verdict
    yield {
        "label": comparison.label,
        "measure": comparison.measure,
        **asdict(difference),
        "pairs": len(pairs),
        "failures": failures[0],
        "their_failures": failures[1],
        "verdict": verdict,
    }


def _both_failed(pair: list[dict[str, Any]]) -> bool:
    """Two dead runs show the same background: that says nothing of how good either way of sampling is."""
    return any(failed(ours) and failed(theirs) for ours, theirs in zip(pair[::2], pair[1::2], strict=True))


def _difference(pair: list[dict[str, Any]], measure: str) -> float:
    values = [run[measure] for run in pair]
    return values[0] - values[1] - (values[2] - values[3] if values[2:] else 0.0)


def failed(run: dict[str, Any]) -> bool:
    """Whether a run got nowhere."""
    return run["outcome"] != "learnt"


def _judged(kind: Kind, low: float | None, high: float | None, detectable: float | None) -> Verdict:
    if low is None or high is None or detectable is None:
        return "undecided"
    bound = -WORTH if kind == "not worse" else 0.0
    if low > bound:
        return "supported"
    if high <= bound or (kind == "better" and detectable < WORTH):
        return "not supported"
    return "undecided"


def _rescued(pairs: list[list[dict[str, Any]]]) -> Verdict:
    """On the scenes where most of the others' runs fail: does any of ours?"""
    by_scene: dict[str, list[tuple[bool, bool]]] = {}
    for ours, theirs in pairs:
        by_scene.setdefault(ours["scene"], []).append((failed(ours), failed(theirs)))
    judged = [runs for runs in by_scene.values() if len(runs) >= SEEDS]
    hopeless = [runs for runs in judged if 2 * sum(theirs for _, theirs in runs) > len(runs)]
    if not hopeless:
        return "undecided"
    return "not supported" if any(ours for runs in hopeless for ours, _ in runs) else "supported"
