"""README.md of the small benchmarks: what sampling pixels and scoring them cost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edge_se_sampler.bench.micro.scoring import ERROR_SOURCES
from edge_se_sampler.bench.report import describe_machine, fill_template, markdown_table
from edge_se_sampler.bench.results import read_measured
from edge_se_sampler.data.scene_file import read_json


def describe(folder: Path) -> str:
    """README.md of the benchmarks whose json lies in a folder."""
    paths = [path for path in sorted(folder.glob("*.json")) if read_json(path).object().get("experiment") == "micro"]
    results = [read_measured(path) for path in paths]
    parts: dict[str, Any] = {result["benchmark"]: result for result in results}
    if "samplers" in parts:
        settings = parts["samplers"]["settings"]
        head = (f"{settings['draws']} pixels", f"median of {settings['rounds']} draws")
        times = parts["samplers"]["milliseconds"].items()
        parts["draws"] = markdown_table(head, [(name, f"{value:.2f} ms") for name, value in times])
        parts["strategies"] = _tabulate_strategies(parts["samplers"].get("strategies", {}))
    if "scoring" in parts:
        scored = [result for result in results if result["benchmark"] == "scoring"]
        parts["scoring"] = "\n\n".join(map(_tabulate_scoring, scored))
    origins = [f"- `{result['command']}`, measured on {describe_machine(result['machine'])}" for result in results]
    return fill_template(__file__, folder, **parts, reproduce="\n".join(origins))


def _tabulate_strategies(strategies: dict[str, dict[str, float]]) -> str:
    """Empty where they were not measured: earlier results have none."""
    rows = [(name, f"{x['build_seconds']:.2f} s", f"{x['bytes_per_pixel']:.2f}") for name, x in strategies.items()]
    return markdown_table(("", "tables built in", "bytes a pixel"), rows) if rows else ""


def _tabulate_scoring(result: dict[str, Any]) -> str:
    settings, times, correlation = (result[key] for key in ("settings", "milliseconds", "rank_correlation"))
    rows = []
    for source, label in ERROR_SOURCES.items():
        time, memory = times[source] / times["random"], result["memory_against_random"][source]
        rank = f"{correlation[source]:.2f}" if source in correlation else "1"
        rows.append((label, f"{time:.2f} x", f"{memory:.2f} x", rank))
    table = markdown_table(("squared errors from", "time per step", "peak memory", "rank correlation"), rows)
    return (
        f"Networks of size `{settings['size']}`, scene `{settings['scene']}`, {settings['rays']} pixels per step, "
        f"Random's step {times['random']:.0f} ms, ranked after {settings['iterations']} iterations:\n\n{table}"
    )
