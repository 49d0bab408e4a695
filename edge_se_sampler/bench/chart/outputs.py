"""Files of the chart."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.chart.draw import draw_chart, draw_costs, draw_parts, draw_scenes
from edge_se_sampler.bench.chart.report import report
from edge_se_sampler.bench.chart.summary import front, table
from edge_se_sampler.bench.chart.train import Scale
from edge_se_sampler.bench.experiment import write_result
from edge_se_sampler.engine.figures import save_figure
from edge_se_sampler.engine.files import write_atomically


def write_outputs(result: dict[str, Any], external: Sequence[dict[str, Any]], output_dir: Path) -> None:
    """result.json with the front and the other programs, table.md, pictures and chart.html, of the runs that there are.

    Raises:
        InputError: a file cannot be written, or matplotlib is missing.
    """
    runs, scale = result["runs"], Scale(**result["settings"])
    result["front"], result["external"] = front(runs), list(external)
    write_result(output_dir / "result.json", result)
    if not runs:
        return
    write_atomically(output_dir / "table.md", table(runs, external).encode())
    pictures = {
        "chart": draw_chart(runs, external, scale),
        "parts": draw_parts(runs, scale),
        "costs": draw_costs(runs),
        "scenes": draw_scenes(runs, external, scale),
    }
    for name, picture in pictures.items():
        save_figure(picture, output_dir / f"{name}.png")
    page = report(result, [output_dir / f"{name}.png" for name in pictures])
    write_atomically(output_dir / "chart.html", page.encode())
