"""Matplotlib figures, written as PNG files."""

from __future__ import annotations

import io
from pathlib import Path

from edge_se_sampler.engine.files import write_atomically
from edge_se_sampler.errors import InputError


def require_pyplot():
    """Matplotlib's pyplot with the backend that draws to files; InputError if it is not installed."""
    try:
        import matplotlib
    except ImportError:
        raise InputError("pictures need the [plots] extra: pip install 'edge-se-sampler[plots]'") from None
    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def printable(name: str) -> str:
    """A file's name as text that can be drawn: what is no UTF-8 in it is escaped."""
    return name.encode(errors="backslashreplace").decode()


def style_axes(*axes) -> None:
    for axis in axes:
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)


def save_figure(figure, path: Path) -> None:
    """Write a figure as PNG and close it; InputError if it cannot be written."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    require_pyplot().close(figure)
    write_atomically(path, buffer.getvalue())
