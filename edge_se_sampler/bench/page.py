"""Parts of a page that stands alone: tables that scroll, pictures inside, no script, nothing loaded from elsewhere."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

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


def page(title: str, parts: Iterable[str]) -> str:
    """The whole of it."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title, quote=False)}</title><style>{STYLE}</style></head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def grid(head: Sequence[str], rows: Iterable[Sequence[str]], caption: str = "") -> str:
    """A table that scrolls sideways where the screen is narrow."""
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    body = "".join("<tr>" + "".join(f"<td>{field}</td>" for field in row) + "</tr>" for row in rows)
    top = "".join(f"<th>{escape(text)}</th>" for text in head)
    return f'<div class="scroll"><table>{title}<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def figure(path: Path, caption: str) -> str:
    """A PNG file with what it shows."""
    data, caption = base64.b64encode(path.read_bytes()).decode(), escape(caption)
    return (
        f'<figure><div class="scroll"><img alt="{caption}" src="data:image/png;base64,{data}"></div>'
        f'<figcaption class="dim">{caption}</figcaption></figure>'
    )
