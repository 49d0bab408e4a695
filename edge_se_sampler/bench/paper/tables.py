"""The tables in the paper's form, and the verdicts, as rows that Markdown and HTML are written from."""

from __future__ import annotations

import statistics
from dataclasses import dataclass
from typing import Any

from edge_se_sampler.bench.paper.published import LABELS, SCENES, STRATEGIES, published
from edge_se_sampler.bench.paper.trials import PAPERS, TABLES
from edge_se_sampler.bench.paper.verdicts import failed

LEGEND = (
    "Test PSNR in dB: mean over the seeds that all strategies have ± deviation; ✗ failures of runs (no better than the "
    "background alone, or nothing of the object learnt). Small: the paper's, on other data; bricks stands in for its "
    "Lego."
)
VERDICT_LEGEND = (
    "Paired differences of runs of the same scene and seed, in dB, with their 95 % interval over seeds, for these "
    "scenes, over the pairs in which not both failed; failures of either side out of all pairs; the smallest true "
    "difference that so many runs find with 80 % power."
)


@dataclass(frozen=True)
class Entry:
    """One field of a table."""

    psnr: float
    deviation: float | None
    failures: int
    runs: int
    theirs: float | None
    """The paper's."""

    @property
    def text(self) -> str:
        """What it says, but for the paper's number."""
        deviation = "" if self.deviation is None else f" ± {self.deviation:.2f}"
        failures = f" ✗{self.failures}/{self.runs}" if self.failures else ""
        return f"{self.psnr:.2f}{deviation}{failures}"


@dataclass(frozen=True)
class Rows:
    """A table: scenes, and of each strategy the label and an entry a scene (None: no run) and of all."""

    number: int
    title: str
    scenes: list[str]
    rows: list[tuple[str, list[Entry | None]]]


def rows_of(runs: list[dict[str, Any]]) -> list[Rows]:
    """Every table that has a run."""
    numbers = [number for number in TABLES if any(run["table"] == number for run in runs)]
    return [_rows(number, alike([run for run in runs if run["table"] == number])) for number in numbers]


def alike(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A table's runs of the seeds that all its strategies have; of an unfinished one that has no such seed, all.

    Seeds that only some have were added for a verdict's sake: in a mean they would compare different seeds.
    """
    seeds = set.intersection(
        *({run["seed"] for run in runs if run["strategy"] == name} for name in {run["strategy"] for run in runs})
    )
    return [run for run in runs if run["seed"] in seeds] or runs


def _rows(number: int, runs: list[dict[str, Any]]) -> Rows:
    scenes = [scene for scene in SCENES if any(run["scene"] == scene for run in runs)]
    theirs = published(number) if number in PAPERS else {}
    rows = []
    for strategy, label in zip(STRATEGIES, LABELS, strict=True):
        mine = [run for run in runs if run["strategy"] == strategy]
        if mine:
            entries = [_entry([run for run in mine if run["scene"] == s], theirs.get((strategy, s))) for s in scenes]
            average = statistics.mean(theirs[strategy, s] for s in scenes) if theirs else None
            rows.append((label, [*entries, _entry(mine, average)]))
    return Rows(number, TABLES[number].title, scenes, rows)


def _entry(runs: list[dict[str, Any]], theirs: float | None) -> Entry | None:
    if not runs:
        return None
    by_scene: dict[str, list[float]] = {}
    for run in runs:
        by_scene.setdefault(run["scene"], []).append(run["psnr"])
    means = [statistics.mean(psnrs) for psnrs in by_scene.values()]
    deviation = statistics.stdev(psnrs) if len(psnrs := [run["psnr"] for run in runs]) > 1 else None
    return Entry(
        statistics.mean(means),
        deviation if len(by_scene) == 1 else None,  # of seeds; scenes differ anyway
        sum(map(failed, runs)),
        len(runs),
        theirs,
    )


def interval(row: dict[str, Any]) -> str:
    """A comparison's mean difference with its interval."""
    if not row["runs"]:
        return "–"
    if row["low"] is None:
        return f"{row['mean']:+.2f}"
    return f"{row['mean']:+.2f} [{row['low']:+.2f}, {row['high']:+.2f}]"


def markdown(runs: list[dict[str, Any]], told: list[dict[str, Any]]) -> str:
    """Tables and verdicts."""
    parts = [LEGEND]
    for table in rows_of(runs):
        lines = ["| | " + " | ".join([*table.scenes, "mean"]) + " |", "|---" * (len(table.scenes) + 2) + "|"]
        lines += [f"| {label} | " + " | ".join(map(_markdown_entry, entries)) + " |" for label, entries in table.rows]
        parts.append(f"**Table {table.number}: {table.title}**\n\n" + "\n".join(lines))
    if told:
        parts.append(f"**Verdicts.** {VERDICT_LEGEND}")
    for claim in told:
        lines = ["| | difference | failures | theirs | pairs, of | could show | scenes for it | |", "|---" * 8 + "|"]
        for row in claim["comparisons"]:
            could = "–" if row["detectable"] is None else f"{row['detectable']:.2f}"
            lines.append(
                f"| {row['label']} | {interval(row)} | {row['failures']} | {row['their_failures']} | "
                f"{row['runs']}, {row['pairs']} | "
                f"{could} | {row['scenes_better']} of {row['scenes']} | {row['verdict']} |"
            )
        parts.append(f"{claim['text']} ({claim['source']}): **{claim['verdict']}**\n\n" + "\n".join(lines))
    return "\n\n".join(parts) + "\n"


def _markdown_entry(entry: Entry | None) -> str:
    if entry is None:
        return "–"
    return entry.text + ("" if entry.theirs is None else f" <sub>{entry.theirs:.2f}</sub>")
