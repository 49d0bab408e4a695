"""The four tables in the paper's form, as Markdown: our mean, deviation and failures, its number small beside them."""

from __future__ import annotations

import statistics
from typing import Any

from edge_se_sampler.bench.paper.cell import PAPERS, TABLES
from edge_se_sampler.bench.paper.published import LABELS, SCENES, STRATEGIES, published


def tables_of(result: dict[str, Any]) -> str:
    """Every table that has a run."""
    parts = [
        "Test PSNR in dB: mean over seeds ± deviation; ✗ failures of runs (no better than the background alone, "
        "or nothing of the object learnt). Small: the paper's, on other data; bricks stands in for its Lego."
    ]
    for number in TABLES:
        runs = [run for run in result["runs"] if run["table"] == number]
        if runs:
            parts.append(f"**Table {number}: {TABLES[number].title}**\n\n{_table(number, runs)}")
    return "\n\n".join(parts) + "\n"


def _table(number: int, runs: list[dict[str, Any]]) -> str:
    scenes = [scene for scene in SCENES if any(run["scene"] == scene for run in runs)]
    theirs = published(number) if number in PAPERS else {}
    lines = ["| | " + " | ".join([*scenes, "mean"]) + " |", "|---" * (len(scenes) + 2) + "|"]
    for strategy, label in zip(STRATEGIES, LABELS, strict=True):
        mine = [run for run in runs if run["strategy"] == strategy]
        if not mine:
            continue
        row = [_entry([run for run in mine if run["scene"] == s], theirs.get((strategy, s))) for s in scenes]
        row.append(_entry(mine, statistics.mean(theirs[strategy, s] for s in scenes) if theirs else None))
        lines.append(f"| {label} | " + " | ".join(row) + " |")
    return "\n".join(lines)


def _entry(runs: list[dict[str, Any]], theirs: float | None) -> str:
    small = "" if theirs is None else f" <sub>{theirs:.2f}</sub>"
    if not runs:
        return "–" + small
    psnrs = [run["psnr"] for run in runs]
    text = f"{statistics.mean(psnrs):.2f}"
    if len(runs) > 1:
        text += f" ± {statistics.stdev(psnrs):.2f}"
    failures = sum(run["outcome"] != "learnt" for run in runs)
    return text + (f" ✗{failures}/{len(runs)}" if failures else "") + small
