"""What an experiment leaves beside its runs: verdicts in result.json, tables.md, pictures, report.html."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edge_se_sampler.bench.experiment import write_result
from edge_se_sampler.bench.paper.figures import Experiment, draw_figures
from edge_se_sampler.bench.paper.report import report
from edge_se_sampler.bench.paper.scenes import DataOf
from edge_se_sampler.bench.paper.tables import markdown
from edge_se_sampler.bench.paper.trials import Cell
from edge_se_sampler.bench.paper.verdicts import verdicts
from edge_se_sampler.engine.files import write_atomically


def keep_view(output_dir: Path, cell: Cell, run: dict[str, Any]) -> dict[str, Any]:
    """A run without its view, which goes to a file."""
    write_atomically(output_dir / "views" / f"{cell.name}.png", run.pop("view"))
    return run


def write_outputs(result: dict[str, Any], data_of: DataOf, output_dir: Path) -> None:
    """Write what the runs that there are suffice for.

    Raises:
        InputError: a file cannot be written.
    """
    result["verdicts"] = verdicts(result["runs"])
    write_result(output_dir / "result.json", result)
    write_atomically(output_dir / "tables.md", markdown(result["runs"], result["verdicts"]).encode())
    if result["runs"]:
        figures = draw_figures(Experiment(result["runs"], data_of, output_dir / "views"), output_dir)
        write_atomically(output_dir / "report.html", report(result, figures).encode())
