"""The chart as a page that stands alone."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.chart.summary import RECOMMENDED, rows_of, rows_of_others
from edge_se_sampler.bench.chart.variants import GROUPS, VARIANTS
from edge_se_sampler.bench.page import figure, grid, page

TITLE = "NeRF on a plain CPU: speed against accuracy"
CAPTIONS = {
    "chart": "Methods, what scores squared errors, and other programs (dotted): test PSNR against training time.",
    "parts": "lean-nerf with one thing changed at a time.",
    "costs": "The same runs against how often networks were asked, and against memory.",
    "scenes": "Every scene, every seed; a cross: training failed.",
}


def report(result: dict[str, Any], pictures: Sequence[Path]) -> str:
    """The page.

    Args:
        result: with `runs`, `front`, `external`, `settings` and `machine`.
        pictures: PNG files, which it carries inside.
    """
    head, rows = rows_of(result["runs"])
    tables = [grid(head, [[escape(f) for f in row] for row in rows[group]], GROUPS[group]) for group in rows]
    front = [
        [f"{row['seconds']}", escape(VARIANTS[row["best"]].label), f"{row['psnr']:.2f}", _behind(row)]
        for row in result["front"]
    ]
    others = [[escape(field) for field in row] for row in rows_of_others(result["runs"], result["external"])]
    top = ("", "version", "flags", *head[1 : head.index("failed")])
    parts = [
        f"<h1>{TITLE}</h1>",
        f"<p>{len(result['runs'])} trainings, images of {result['settings']['pixels']} pixels a side. Time runs from "
        "reading the data to the end of a step; looking at test views is left out. Every plan is as long as the "
        "chart.</p>",
        *(figure(path, CAPTIONS[path.stem]) for path in pictures),
        "<h2>The front</h2>",
        grid(("seconds", "best", "dB", f"{VARIANTS[RECOMMENDED].label} behind it"), front),
        "<h2>Every variant</h2>",
        *tables,
        *(("<h2>Other programs</h2>", grid(top, others)) if others else ()),
        "<h2>Settings</h2>",
        f'<p class="dim">{escape(json.dumps(result["settings"]))} {escape(json.dumps(result["machine"]))}</p>',
    ]
    return page(TITLE, parts)


def _behind(row: dict[str, Any]) -> str:
    behind = row["recommended_behind"]
    return "–" if behind is None else f"{behind:.2f} dB"
