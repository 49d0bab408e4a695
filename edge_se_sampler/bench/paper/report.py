"""One page that stands alone: verdicts, pictures, tables, costs and settings of an experiment."""

from __future__ import annotations

import statistics
from html import escape
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.page import figure, grid, page
from edge_se_sampler.bench.paper.published import LABELS, STRATEGIES
from edge_se_sampler.bench.paper.tables import LEGEND, VERDICT_LEGEND, Entry, Rows, interval, rows_of
from edge_se_sampler.bench.paper.trials import TABLES
from edge_se_sampler.bench.paper.verdicts import failed

CAPTIONS = {
    "sheet": "The first held-out view of every scene as every strategy rendered it, first seed; red: failed.",
    "figure-2": "The paper's figure 2. Precrop's window on a training view, and what it led to; red: failed.",
    "figure-5": "The paper's figure 5. Training loss of Random, Precrop and Edge; every seed is a line.",
    "figure-6": "The paper's figure 6. Error in the edge band, Precrop against Edge.",
}


def report(result: dict[str, Any], figures: list[Path]) -> str:
    """The page.

    Args:
        result: with `runs`, `verdicts`, `settings` and `machine`.
        figures: PNG files, which it carries inside.
    """
    runs = result["runs"]
    seeds = sorted({run["seed"] for run in runs})
    parts = [
        "<h1>Important pixels for NeRF: the paper's experiments, remade</h1>",
        f"<p>{len(runs)} trainings, {len({run['scene'] for run in runs})} scenes, seeds "
        f"{', '.join(map(str, seeds))}; every strategy begins with the same weights. The scenes are made, not NeRF's, "
        "and the networks small: differences between strategies can be compared with the paper's, dB cannot.</p>",
        "<h2>Verdicts</h2>",
        f'<p class="dim">{escape(VERDICT_LEGEND)}</p>',
        *map(_claim, result["verdicts"]),
        "<h2>Pictures</h2>",
        *(figure(path, CAPTIONS[path.stem]) for path in figures),
        "<h2>Tables</h2>",
        f'<p class="dim">{escape(LEGEND)}</p>',
        *map(_table, rows_of(runs)),
        "<h2>What a run costs</h2>",
        _costs(runs),
        *_dead_starts(runs),
        "<h2>Settings</h2>",
        f'<p class="dim">{escape(_settings(result))}</p>',
    ]
    return page("The paper's experiments, remade", parts)


def _claim(claim: dict[str, Any]) -> str:
    head = ("", "difference", "failures", "theirs", "pairs, of", "could show", "scenes for it", "")
    rows = [
        (
            row["label"] + (" (edge band)" if row["measure"] == "edge_band_psnr" else ""),
            interval(row),
            str(row["failures"]),
            str(row["their_failures"]),
            f"{row['runs']}, {row['pairs']}",
            "–" if row["detectable"] is None else f"{row['detectable']:.2f}",
            f"{row['scenes_better']} of {row['scenes']}",
            row["verdict"],
        )
        for row in claim["comparisons"]
    ]
    return (
        f"<details><summary>{escape(claim['text'])} <span class='dim'>({escape(claim['source'])})</span> "
        f"<b class='{claim['verdict'].replace(' ', '-')}'>{claim['verdict']}</b></summary>"
        f"{grid(head, [[escape(text) for text in row] for row in rows])}</details>"
    )


def _table(table: Rows) -> str:
    rows = [[escape(label), *map(_field, entries)] for label, entries in table.rows]
    return grid(("", *table.scenes, "mean"), rows, f"Table {table.number}: {table.title}")


def _field(entry: Entry | None) -> str:
    if entry is None:
        return "–"
    text = f"<span class='failed'>{entry.text}</span>" if entry.failures else entry.text
    return text + ("" if entry.theirs is None else f"<small>{entry.theirs:.2f}</small>")


def _costs(runs: list[dict[str, Any]]) -> str:
    """Median CPU seconds of training, and iterations."""
    numbers = [number for number in TABLES if any(run["table"] == number for run in runs)]
    rows = []
    for strategy, label in zip(STRATEGIES, LABELS, strict=True):
        row = [escape(label)]
        for number in numbers:
            mine = [run for run in runs if (run["table"], run["strategy"]) == (number, strategy)]
            row.append(
                f"{statistics.median(run['cpu_seconds'] for run in mine):.1f}<small>{mine[0]['steps']}</small>"
                if mine
                else "–"
            )
        rows.append(row)
    head = ("", *(f"table {number}" for number in numbers))
    return grid(head, rows, "Median CPU seconds of training; small: iterations")


def _dead_starts(runs: list[dict[str, Any]]) -> list[str]:
    """Of torch's initial weights: networks dead before the first step, which no sampler can help."""
    rows = []
    for number, table in TABLES.items():
        mine = [run for run in runs if run["table"] == number]
        if not mine or table.model.get("initialization") != "torch":
            continue
        for strategy in table.strategies:
            of_strategy = [run for run in mine if run["strategy"] == strategy]
            dead = [run for run in of_strategy if run["dead_at_start"]]
            alive = [run for run in of_strategy if not run["dead_at_start"]]
            rows.append(
                [
                    f"table {number}, {escape(LABELS[STRATEGIES.index(strategy)])}",
                    f"{len(dead)} of {len(of_strategy)}",
                    f"{sum(map(failed, dead))} of {len(dead)}",
                    f"{sum(map(failed, alive))} of {len(alive)}",
                ]
            )
    if not rows:
        return []
    return [grid(("", "a network dead at the start", "of them failed", "of the others failed"), rows, "Dead starts")]


def _settings(result: dict[str, Any]) -> str:
    told = [f"{key} {value}" for part in (result["settings"], result["machine"]) for key, value in part.items()]
    return ", ".join(told)
