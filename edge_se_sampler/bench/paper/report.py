"""One page that stands alone: verdicts, pictures, tables, costs and settings of an experiment."""

from __future__ import annotations

import base64
import statistics
from html import escape
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.paper.cell import TABLES
from edge_se_sampler.bench.paper.published import LABELS, STRATEGIES
from edge_se_sampler.bench.paper.tables import LEGEND, VERDICT_LEGEND, Entry, Rows, interval, rows_of
from edge_se_sampler.bench.paper.verdict import failed

CAPTIONS = {
    "sheet": "The first held-out view of every scene as every strategy rendered it, first seed; red: failed.",
    "figure-2": "The paper's figure 2. Precrop's window on a training view, and what it led to; red: failed.",
    "figure-5": "The paper's figure 5. Training loss of Random, Precrop and Edge; every seed is a line.",
    "figure-6": "The paper's figure 6. Error in the edge band, Precrop against Edge.",
}
STYLE = """
:root { color-scheme: light dark; --line: #8884; --dim: #777; --good: #1a7f37; --bad: #cf222e; --open: #9a6700; }
body { font: 16px/1.5 system-ui, sans-serif; margin: 0 auto; padding: 1rem; max-width: 72rem; }
h1 { font-size: 1.6rem; line-height: 1.2 } h2 { margin-top: 2.2rem; font-size: 1.25rem }
.scroll { overflow-x: auto } .dim { color: var(--dim); font-size: .85rem }
table { border-collapse: collapse; font-size: .85rem; font-variant-numeric: tabular-nums; white-space: nowrap }
th, td { padding: .3rem .6rem; text-align: right; border-bottom: 1px solid var(--line) }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: Canvas }
caption { text-align: left; font-weight: 600; padding: .8rem 0 .3rem; white-space: normal }
td small { display: block; color: var(--dim) } .failed { color: var(--bad) }
details { border: 1px solid var(--line); border-radius: .5rem; padding: .5rem .8rem; margin: .5rem 0 }
summary { cursor: pointer } summary b { float: right; margin-left: 1rem }
summary::after { content: ""; display: block; clear: both }
.supported { color: var(--good) } .not-supported { color: var(--bad) } .undecided { color: var(--open) }
figure { margin: 1rem 0 }
figure img { width: 100%; min-width: 42rem; height: auto; background: white; border-radius: .4rem }
"""


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
        *map(_figure, figures),
        "<h2>Tables</h2>",
        f'<p class="dim">{escape(LEGEND)}</p>',
        *map(_table, rows_of(runs)),
        "<h2>What a run costs</h2>",
        _costs(runs),
        *_dead_starts(runs),
        "<h2>Settings</h2>",
        f'<p class="dim">{escape(_settings(result))}</p>',
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>The paper's experiments, remade</title><style>{STYLE}</style></head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


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
        f"{_grid(head, [[escape(text) for text in row] for row in rows])}</details>"
    )


def _grid(head: tuple[str, ...], rows: list[list[str]], caption: str = "") -> str:
    """A table that scrolls sideways where the screen is narrow."""
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    body = "".join("<tr>" + "".join(f"<td>{field}</td>" for field in row) + "</tr>" for row in rows)
    top = "".join(f"<th>{escape(text)}</th>" for text in head)
    return f'<div class="scroll"><table>{title}<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def _figure(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    caption = escape(CAPTIONS[path.stem])
    return (
        f'<figure><div class="scroll"><img alt="{caption}" src="data:image/png;base64,{data}"></div>'
        f'<figcaption class="dim">{caption}</figcaption></figure>'
    )


def _table(table: Rows) -> str:
    rows = [[escape(label), *map(_field, entries)] for label, entries in table.rows]
    return _grid(("", *table.scenes, "mean"), rows, f"Table {table.number}: {table.title}")


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
    return _grid(head, rows, "Median CPU seconds of training; small: iterations")


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
    return [_grid(("", "a network dead at the start", "of them failed", "of the others failed"), rows, "Dead starts")]


def _settings(result: dict[str, Any]) -> str:
    told = [f"{key} {value}" for part in (result["settings"], result["machine"]) for key, value in part.items()]
    return ", ".join(told)
